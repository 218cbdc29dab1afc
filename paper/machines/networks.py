"""Networks that adjust f_p, as dynamics."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from gpadjust.core import Prediction
from gpadjust.dynamics import Dynamics, PhysicsDynamics, Trajectories, TransitionFunctions
from gpadjust.physics import Physics
from gpadjust.states import StateSpec

_HIDDEN = 32
_RATE, _DECAY = 5e-3, 0.1  # of Adam
_LOOK = 10  # steps of training between two looks at the rows that are held out


class Networks(nn.Module):
    """Networks of two hidden layers side by side, ``k x N x inputs`` to ``k x N x outputs``."""

    def __init__(self, number: int, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        pairs = [*pairwise((inputs, hidden, hidden, outputs))]
        self.weights = nn.ParameterList(
            torch.randn(number, a, b, dtype=torch.float64) / a**0.5 for a, b in pairs
        )
        self.biases = nn.ParameterList(
            torch.zeros(number, 1, b, dtype=torch.float64) for _, b in pairs
        )

    def forward(self, x: Tensor, which: Any = slice(None)) -> Tensor:
        """Evaluate some of them, each at rows of its own."""
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias[which], x, weight[which])
            x = nn.functional.silu(x) if i < len(self.weights) - 1 else x
        return x


class NetworkDynamics(Dynamics):
    """Networks that predict what f_p lacks of the change of the state.

    They are trained from new weights at each update, full batch, by Adam with weight decay. Each
    learns from all transitions but its fold, and keeps the weights with which it was best there;
    the mean square of the errors there is the noise. A sampled function is one of the networks (as
    in MBPO: Janner et al. 2019).

    Args:
        spec: What the entries of states are.
        physics: f_p.
        number: How many networks, of two hidden layers of 32.
        steps: The most steps of Adam.
        seed: Of samples and weights.
    """

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics,
        *,
        number: int = 10,
        steps: int = 1500,
        seed: int = 0,
    ) -> None:
        super().__init__(spec)
        self.known = PhysicsDynamics(spec, physics)
        self.number, self.steps, self.seed = number, steps, seed
        self._read = [i for i, name in enumerate(spec.states) if name not in spec.exogenous]
        self._data: Trajectories | None = None
        self._networks: Networks | None = None

    @property
    def is_fitted(self) -> bool:
        """True once there were transitions."""
        return self._networks is not None

    def physics_alone(self) -> Dynamics:
        """Return the dynamics before any transitions."""
        return self.known

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Train on these and earlier transitions."""
        data = self._checked(states, actions, next_states)
        data = self._data = data if self._data is None else self._data.append(data)
        X, n = self._inputs(data.states, data.actions), len(data.states)
        rest = self.spec.change(data.states, data.next_states)[:, self.spec.predicted]
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            rest = rest - self._physics(data.states, data.actions)
            self._units = X.mean(0), X.std(0).clamp_min(1e-6)
            self._shift, self._scale = rest.mean(0), rest.std(0).clamp_min(1e-9)
            networks = Networks(self.number, X.shape[-1], _HIDDEN, rest.shape[-1])
            fold = torch.randperm(n) % self.number
            shares = (fold != torch.arange(self.number)[:, None]).to(X)
        error = self._train(networks, X, (rest - self._shift) / self._scale, shares)
        self._noise = error * self._scale.square()
        self._networks = networks.requires_grad_(False)

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Return the mean over the networks; the variance over them, and that of the noise."""
        each = self._of_all(states, actions)
        return Prediction(each.mean(0), each.var(0) + self.noise_variance(states, actions))

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Return networks, in a random order."""
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        order = torch.randperm(self.number, generator=generator)
        taken = order[torch.arange(num_functions) % self.number]
        return lambda states, actions: self._each(states, actions, taken)

    def mean_function(self) -> TransitionFunctions:
        """Return the mean of all networks."""

        def step(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            every = states.flatten(0, -2).expand(self.number, -1, -1)
            return self._each(every, actions.flatten(0, -2), slice(None)).mean(0).view_as(states)

        return step

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the mean square of the errors at the rows that were held out."""
        return self.spec.complete_variance(self._noise.expand(*states.shape[:-1], -1))

    def _train(self, networks: Networks, X: Tensor, Y: Tensor, shares: Tensor) -> Tensor:
        """Train all networks at once; return the mean square of the errors, held out."""
        Z, held_out = self._normalized(X).expand(self.number, -1, -1), shares == 0
        optimizer = torch.optim.AdamW(networks.parameters(), lr=_RATE, weight_decay=_DECAY)
        lowest = torch.full((self.number,), torch.inf, dtype=torch.float64)
        errors = torch.zeros_like(Y)
        kept = [weight.detach().clone() for weight in networks.parameters()]
        for step in range(self.steps + 1):
            squares = (networks(Z) - Y).square()
            if step % _LOOK == 0:
                found = squares.detach()
                by_fold = (found.mean(-1) * held_out).sum(1) / held_out.sum(1)
                better = by_fold < lowest
                lowest = torch.where(better, by_fold, lowest)
                for old, weight in zip(kept, networks.parameters(), strict=True):
                    old[better] = weight.detach()[better]
                rows = (held_out & better[:, None]).any(0)
                errors[rows] = (found * held_out[..., None]).sum(0)[rows]
            loss = (squares.mean(-1) * shares).sum() / len(X)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            for old, weight in zip(kept, networks.parameters(), strict=True):
                weight.copy_(old)
        return errors.mean(0)

    def _inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return states but exogenous ones, with sine and cosine of angles, and actions."""
        columns = []
        for i in self._read:
            x = states[..., i]
            columns += [x.sin(), x.cos()] if i in self.spec.angle_columns else [x]
        return torch.cat([torch.stack(columns, -1), actions.expand(*states.shape[:-1], -1)], -1)

    def _normalized(self, X: Tensor) -> Tensor:
        mean, sd = self._units
        return (X - mean) / sd

    def _physics(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the change of the predicted states by f_p, ``... x m``."""
        actions = actions.expand(*states.shape[:-1], -1)
        following = self.known.mean_function()(states, actions)
        return self.spec.change(states, following)[..., self.spec.predicted]

    def _of_all(self, states: Tensor, actions: Tensor) -> Tensor:
        with torch.no_grad():
            return self._each(states.expand(self.number, *states.shape), actions, slice(None))

    def _each(self, states: Tensor, actions: Tensor, which: Any) -> Tensor:
        """Return next states ``k x N x state_dim`` by some of the networks."""
        assert self._networks is not None, "asked before"
        rest = self._networks(self._normalized(self._inputs(states, actions)), which)
        change = self._physics(states, actions) + self._shift + self._scale * rest
        return self.spec.complete(states, actions, states[..., self.spec.predicted] + change)
