"""Networks as dynamics, alone or beside f_p."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, Trajectories, TransitionFunctions
from gpadjust.dynamics.targets import TargetPhysics, Targets
from gpadjust.models import Prediction
from gpadjust.physics import Physics
from gpadjust.states import StateSpec
from paper.reaching.ensemble import Networks

_LOOK = 10  # steps of training between two looks at what is held out


class NetworkDynamics(Dynamics):
    """Networks that say the change of the state, or what f_p lacks of it.

    As many as there are folds; each learns from all transitions but its fold, by Adam with weight
    decay, and has the weights with which it was best there. The mean square of the errors there is
    taken as the noise. A sampled function is one of the networks.

    Args:
        spec: What the entries of states are.
        physics: f_p; None for networks alone.
        folds: How many.
        hidden: The width of both hidden layers.
        steps: The most steps of Adam.
        rate: Its learning rate.
        decay: Its weight decay.
        seed: Of folds and weights.
    """

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics | None = None,
        *,
        folds: int = 10,
        hidden: int = 32,
        steps: int = 1500,
        rate: float = 5e-3,
        decay: float = 0.1,
        seed: int = 0,
    ) -> None:
        super().__init__(spec)
        self.targets = Targets(spec, "difference")
        self.physics = None if physics is None else TargetPhysics(physics, self.targets)
        self.folds, self.hidden, self.steps = folds, hidden, steps
        self.rate, self.decay, self.seed = rate, decay, seed
        self._data: Trajectories | None = None
        self._networks: Networks | None = None

    @property
    def is_fitted(self) -> bool:
        """Whether it has learnt."""
        return self._networks is not None

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Train on these and earlier transitions."""
        data = self._checked(states, actions, next_states)
        data = self._data = data if self._data is None else self._data.append(data)
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            X = self._inputs(data.states, data.actions)
            rest = self.targets.encode(data.states, data.next_states)
            rest = rest - self._known(data.states, data.actions)
            self._units = X.mean(0), X.std(0).clamp_min(1e-6)
            self._shift, self._scale = rest.mean(0), rest.std(0).clamp_min(1e-9)
            networks = Networks(self.folds, X.shape[-1], self.hidden, rest.shape[-1])
            held_out = torch.randperm(len(X)) % self.folds == torch.arange(self.folds)[:, None]
        error = self._train(networks, X, (rest - self._shift) / self._scale, held_out)
        self._noise = error * self._scale.square()
        self._networks = networks.requires_grad_(False)

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Mean over the networks; variance over them, and that of the noise."""
        with torch.no_grad():
            each = self._each(states.expand(self.folds, *states.shape), actions, slice(None))
        noise = self.spec.complete_variance(self._noise.expand(len(states), -1))
        return Prediction(each.mean(0), each.var(0) + noise)

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """By a network for each row, and noise."""
        with torch.no_grad():
            each = self._each(states.expand(self.folds, *states.shape), actions, slice(None))
        following = each[torch.randint(self.folds, (len(states),)), torch.arange(len(states))]
        noise = self.noise_variance(states, actions)
        return following + noise.sqrt() * torch.randn_like(following)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Networks, in a random order."""
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        order = torch.randperm(self.folds, generator=generator)
        taken = order[torch.arange(num_functions) % self.folds]
        return lambda states, actions: self._each(states, actions, taken)

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """The mean square of the errors at what is held out."""
        return self.spec.complete_variance(self._noise.expand(*states.shape[:-1], -1))

    def describe(self) -> dict[str, str]:
        """What it is."""
        return {"class": type(self).__name__}

    def state_dict(self) -> dict[str, Any]:
        """Nothing: runs are short."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing, as above."""
        raise NotImplementedError

    def _train(self, networks: Networks, X: Tensor, Y: Tensor, held_out: Tensor) -> Tensor:
        """Train all networks at once; return the mean square of the errors, held out."""
        Z = self._normalized(X).expand(self.folds, -1, -1)
        optimizer = torch.optim.AdamW(networks.parameters(), lr=self.rate, weight_decay=self.decay)
        lowest = torch.full((self.folds,), torch.inf, dtype=torch.float64)
        errors = torch.zeros_like(Y)
        kept = [weight.detach().clone() for weight in networks.parameters()]
        for step in range(self.steps + 1):
            squares = (networks(Z) - Y).square()
            if step % _LOOK == 0:
                known = squares.detach()
                by_fold = (known.mean(-1) * held_out).sum(1) / held_out.sum(1)
                better = by_fold < lowest
                lowest = torch.where(better, by_fold, lowest)
                for old, weight in zip(kept, networks.parameters(), strict=True):
                    old[better] = weight.detach()[better]
                rows = (held_out & better[:, None]).any(0)
                errors[rows] = (known * held_out[..., None]).sum(0)[rows]
            loss = (squares.mean(-1) * ~held_out).sum() / len(X)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            for old, weight in zip(kept, networks.parameters(), strict=True):
                weight.copy_(old)
        return errors.mean(0)

    def _inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        observed = self.spec.observe(states)
        return torch.cat([observed, actions.expand(*states.shape[:-1], -1)], dim=-1)

    def _normalized(self, X: Tensor) -> Tensor:
        mean, sd = self._units
        return (X - mean) / sd

    def _known(self, states: Tensor, actions: Tensor) -> Tensor:
        """What f_p says of the targets, ``... x m``; 0 without it."""
        if self.physics is None:
            return torch.zeros((), dtype=torch.float64)
        actions = actions.expand(*states.shape[:-1], -1)
        known: Tensor = self.physics(self.targets.inputs(states, actions))
        return known

    def _each(self, states: Tensor, actions: Tensor, which: Any) -> Tensor:
        """Next states ``k x N x state_dim`` by some of the networks."""
        assert self._networks is not None, "asked before"
        rest = self._networks(self._normalized(self._inputs(states, actions)), which)
        change = self._known(states, actions) + self._shift + self._scale * rest
        return self.spec.complete(states, actions, self.targets.decode(states, change))
