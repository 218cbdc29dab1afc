"""Dynamics that are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.state_spec import StateSpec, check_columns
from gpadjust.models.prediction import Prediction
from gpadjust.physics import ODEPhysics, Physics, as_physics


class PhysicsDynamics(Dynamics):
    """The physics alone, without doubt or learning.

    With the true system as physics it is the oracle that bounds what any model can do.

    Args:
        spec: What the entries of states and actions are.
        physics: The next values of the states that are not exogenous, from these and the actions:
            columns ``[states, actions]`` in the order of the spec.

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
        self.physics = check_physics(physics)

    @property
    def is_fitted(self) -> bool:
        """True: there is nothing to learn."""
        return True

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Do nothing."""

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """The next states, and zero variance."""
        following = self._step(states, actions)
        return Prediction(following, torch.zeros_like(following))

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states."""
        return self._step(states, actions)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """The physics, whatever the number."""
        return self._step

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""

    def _step(self, states: Tensor, actions: Tensor) -> Tensor:
        moving = self.spec.moving
        check_columns(states, self.spec.state_dim, "states")
        check_columns(actions, self.spec.action_dim, "actions")
        following = states.clone()
        with torch.no_grad():
            following[..., moving] = next_values(
                self.physics, torch.cat([states[..., moving], actions], dim=-1), len(moving)
            )
        return following


def check_physics(physics: Physics | Callable[[Tensor], Tensor]) -> Physics:
    """A physics of next states, from what the user gave."""
    physics = as_physics(physics)
    if isinstance(physics, ODEPhysics) and physics.difference:
        raise ValueError(
            f"Physics {physics.name!r} returns the change of the state (difference=True), but "
            "dynamics take the next state from it; build it with difference=False."
        )
    return physics


def next_values(physics: Physics, inputs: Tensor, num_states: int) -> Tensor:
    """What the physics says, ``... x num_states``, from ``... x (num_states + a)``."""
    Y = physics(inputs if inputs.dim() > 1 else inputs.unsqueeze(0))
    if Y.shape[-1] != num_states:
        raise ValueError(
            f"Expected physics {physics.name!r} to return the next values of the {num_states} "
            f"states that are not exogenous, got {Y.shape[-1]} columns."
        )
    return Y
