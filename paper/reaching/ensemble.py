"""What f_p lacks, learnt by an ensemble of networks."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from gpadjust.dynamics import Dynamics, PhysicsDynamics, Trajectories
from gpadjust.dynamics.base import TransitionFunctions
from gpadjust.dynamics.targets import TargetPhysics, Targets
from gpadjust.models import Prediction
from gpadjust.physics import Physics
from gpadjust.states import StateSpec


class Networks(nn.Module):
    """Networks of two hidden layers side by side, ``k x N x inputs`` to ``k x N x outputs``."""

    def __init__(self, number: int, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        sizes = (inputs, hidden, hidden, outputs)
        pairs = [*pairwise(sizes)]
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


class ResidualEnsemble(Dynamics):
    """f_p plus networks that learn the rest of the change, each from a bootstrap sample.

    They are trained from new weights after each trial, full batch, by Adam with weight decay. A
    sampled function is one of them (as in MBPO: Janner et al. 2019).

    Args:
        spec: What the entries of states are.
        physics: f_p.
        number: How many networks.
        hidden: Their width.
        steps: Steps of Adam.
        rate: Its learning rate.
        decay: Its weight decay.
    """

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics,
        *,
        number: int = 6,
        hidden: int = 64,
        steps: int = 800,
        rate: float = 3e-3,
        decay: float = 1e-2,
    ) -> None:
        super().__init__(spec)
        self.targets = Targets(spec, "difference")
        self.known = PhysicsDynamics(spec, physics)
        self.physics = TargetPhysics(physics, self.targets)
        self.number, self.hidden = number, hidden
        self.steps, self.rate, self.decay = steps, rate, decay
        self._data: Trajectories | None = None
        self._networks: Networks | None = None

    @property
    def is_fitted(self) -> bool:
        """Whether it has learnt."""
        return self._networks is not None

    def before_data(self) -> Dynamics:
        """Itself, once it has learnt; f_p before."""
        return self if self.is_fitted else self.known

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Train on these and earlier transitions."""
        data = self._checked(states, actions, next_states)
        data = self._data = data if self._data is None else self._data.append(data)
        X = self.targets.inputs(data.states, data.actions)
        with torch.no_grad():
            rest = self.targets.encode(data.states, data.next_states) - self.physics(X)
        self._inputs = X.mean(0), X.std(0).clamp_min(1e-6)
        self._scale = rest.std(0).clamp_min(1e-9)
        self._shift = rest.mean(0)
        n = len(X)
        drawn = torch.randint(n, (self.number, n))
        Z, Y = self._normalized(X)[drawn], ((rest - self._shift) / self._scale)[drawn]
        networks = Networks(self.number, X.shape[-1], self.hidden, Y.shape[-1])
        optimizer = torch.optim.AdamW(networks.parameters(), lr=self.rate, weight_decay=self.decay)
        for _ in range(self.steps):
            loss = (networks(Z) - Y).square().mean((1, 2)).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        self._networks = networks.requires_grad_(False)

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Mean and variance over the networks."""
        with torch.no_grad():
            each = self._each(states.expand(self.number, *states.shape), actions, slice(None))
        return Prediction(each.mean(0), each.var(0))

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """By a network for each row."""
        with torch.no_grad():
            each = self._each(states.expand(self.number, *states.shape), actions, slice(None))
        return each[torch.randint(self.number, (len(states),)), torch.arange(len(states))]

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Networks, in a random order."""
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        order = torch.randperm(self.number, generator=generator)
        taken = order[torch.arange(num_functions) % self.number]

        def step(states: Tensor, actions: Tensor) -> Tensor:
            return self._each(states, actions, taken)

        return step

    def mean_function(self) -> TransitionFunctions:
        """The mean of all networks."""

        def step(states: Tensor, actions: Tensor) -> Tensor:
            flat, taken = states.flatten(0, -2), actions.expand(*states.shape[:-1], -1)
            every = flat.expand(self.number, *flat.shape)
            return self._each(every, taken.flatten(0, -2), slice(None)).mean(0).view_as(states)

        return step

    def describe(self) -> dict[str, str]:
        """What it is."""
        return {"class": type(self).__name__, "physics": self.physics.name}

    def state_dict(self) -> dict[str, Any]:
        """Nothing: runs are not interrupted within a trial."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing, as above."""
        raise NotImplementedError

    def _normalized(self, X: Tensor) -> Tensor:
        mean, sd = self._inputs
        return (X - mean) / sd

    def _each(self, states: Tensor, actions: Tensor, which: Any) -> Tensor:
        """Next states ``k x N x state_dim`` by some of the networks."""
        assert self._networks is not None, "asked before"
        X = self.targets.inputs(states, actions.expand(*states.shape[:-1], -1))
        rest = self._networks(self._normalized(X), which)
        change = self.physics(X) + self._shift + self._scale * rest
        return self.spec.complete(states, actions, self.targets.decode(states, change))
