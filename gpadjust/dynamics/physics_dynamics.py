"""Dynamics that are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.state import PhysicsProbes, check_fingerprint, fingerprint
from gpadjust.dynamics.targets import check_physics, next_values, parts_of, warn_of_differences
from gpadjust.models import Prediction
from gpadjust.physics import Physics
from gpadjust.states import StateSpec


class PhysicsDynamics(Dynamics):
    """The physics alone, without doubt or learning.

    With the true system as physics it is the oracle that bounds what any model can do.

    Args:
        spec: What the entries of states and actions are.
        physics: The next values of the states that are neither exogenous nor previous values,
            from these and the actions: columns ``[states, actions]`` in the order of the spec.

    Raises:
        TypeError: If ``spec`` is no :class:`StateSpec`, or the physics is not callable.
        ValueError: If there are several physics, or one returns the change of the state.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> spec = StateSpec(["x"], ["v"])
        >>> dynamics = PhysicsDynamics(spec, physics=lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> dynamics.sample(one, one)
        tensor([[1.1000]], dtype=torch.float64)
    """

    def __init__(self, spec: StateSpec, physics: Physics | Callable[[Tensor], Tensor]) -> None:
        super().__init__(spec)
        self.physics = check_physics(physics, spec)
        if len(parts_of(self.physics)) > 1:
            raise ValueError(
                "Expected one physics to follow, got "
                f"{', '.join(map(repr, parts_of(self.physics)))}; LearnedDynamics learns their "
                "weights."
            )
        self._probes: PhysicsProbes | None = None
        self._compared = False  # with transitions

    @property
    def is_fitted(self) -> bool:
        """True, as there is nothing to learn."""
        return True

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Learn nothing; the first transitions show whether the physics returns next states.

        Raises:
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree, there are no rows, values are not finite, or states are
                not what the spec says (:meth:`StateSpec.check_transitions`).
        """
        data = self._checked(states, actions, next_states)
        if self._compared:
            return
        columns = self.spec.moving
        change = self._change(data.states, data.actions)
        warn_of_differences(self.physics.name, self.spec, data, columns, change)
        self._compared = True
        if self._probes is None:
            self._probes = PhysicsProbes.of(data.states, data.actions, change, columns)

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """The next states, and zero variance."""
        with torch.no_grad():
            following = self._step(states, actions)
        return Prediction(following, torch.zeros_like(following))

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states."""
        with torch.no_grad():
            return self._step(states, actions)

    def mean_function(self) -> TransitionFunctions:
        """The physics, with gradients as far as it has them."""
        return self._step

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """The physics, whatever the number; the functions are those of :class:`LearnedDynamics`.

        Raises:
            ValueError: If ``num_functions`` is no positive whole number.
        """
        checked_whole("num_functions", num_functions, 1)

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_blocks(states, actions, num_functions)
            return self._step(states, actions)

        return step

    def describe(self) -> dict[str, str]:
        """Each setting of these dynamics as a text."""
        return fingerprint(type(self), self.spec)

    def state_dict(self) -> dict[str, Any]:
        """The settings, and what the physics returned for the first transitions."""
        probes = None if self._probes is None else [tensor.clone() for tensor in self._probes]
        return {"fingerprint": self.describe(), "probes": probes}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Check that the state is of such dynamics; there is nothing learnt.

        The physics is asked about at most three transitions that the state holds.

        Raises:
            TypeError: If it is no dictionary.
            RuntimeError: If it is of dynamics of another class, spec or physics, or damaged.
            PhysicsError: If the physics fails.
        """
        check_fingerprint(state, self.describe())
        given = state.get("probes")
        if given is None:
            return
        moving = self.spec.moving
        probes = PhysicsProbes.checked(given, self.spec, len(moving))
        found = self._change(probes.states, probes.actions)
        probes.check(found, self.physics.name, self.spec, moving)
        self._probes = probes

    def _change(self, states: Tensor, actions: Tensor) -> Tensor:
        """The change of the states that move."""
        with torch.no_grad():
            following = self._step(states, actions)
        return self.spec.change(states, following)[..., self.spec.moving]

    def _step(self, states: Tensor, actions: Tensor) -> Tensor:
        moving = self.spec.moving
        self._check_pair(states, actions)
        actions = actions.expand(*states.shape[:-1], -1)
        following = states.clone()
        following[..., moving] = next_values(
            self.physics, torch.cat([states[..., moving], actions], dim=-1), len(moving)
        )
        return self.spec.remember(following, states, actions)
