"""The interface of a dynamics model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gpadjust.dynamics.transition_scores import TransitionScores, score_transitions
from gpadjust.dynamics.transitions import Transitions
from gpadjust.models import Prediction
from gpadjust.states import StateSpec
from gpadjust.states.state_spec import check_columns

TransitionFunctions = Callable[[Tensor, Tensor], Tensor]
"""Functions from states and actions, ``k x N x ...``, to next states: a sample of the dynamics."""


class Dynamics(ABC):
    """A distribution of the next state, given a state and an action.

    All tensors are float64 and in the user's units: states ``N x state_dim``, actions
    ``N x action_dim``, see :class:`StateSpec`. Angles need not be wrapped.

    Args:
        spec: What the entries of states and actions are.

    Raises:
        TypeError: If ``spec`` is not a :class:`StateSpec`.
    """

    def __init__(self, spec: StateSpec) -> None:
        if not isinstance(spec, StateSpec):
            raise TypeError(
                f"Expected spec as a StateSpec, such as StateSpec(['x', 'v'], ['force']); found "
                f"{spec!r}."
            )
        self.spec = spec

    @property
    @abstractmethod
    def is_fitted(self) -> bool:
        """Whether it can predict already."""

    @abstractmethod
    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Learn from further transitions, ``N`` rows each."""

    @abstractmethod
    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Mean and variance of the next states, ``N x state_dim`` each, entry by entry."""

    @abstractmethod
    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, ``N x state_dim``, row by row, from PyTorch's generator."""

    @abstractmethod
    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw transition *functions*, so that particles stay consistent along a trajectory.

        Returns:
            A deterministic function of states ``k x N x state_dim`` and actions
            ``k x N x action_dim`` to next states, each of the ``k`` blocks by its own draw.
        """

    def score(self, states: Tensor, actions: Tensor, next_states: Tensor) -> TransitionScores:
        """Judge the predictions by transitions that were not learnt from.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``; NaN where an entry was not measured.

        Raises:
            RuntimeError: If nothing was learnt yet.
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree or values are not finite.
        """
        data = Transitions.checked(self.spec, states, actions, next_states)
        return score_transitions(self.spec, self.predict(data.states, data.actions), data)

    def rehearse(self, states: Tensor, actions: Tensor) -> None:
        """Find what is wrong with the physics before there are transitions, if it can be told.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.

        Raises:
            ValueError: If the physics returns another number of states.
            PhysicsError: If the physics fails.
        """
        if self.is_fitted:
            self.predict(states, actions)

    @abstractmethod
    def describe(self) -> dict[str, str]:
        """What these dynamics are, each setting as a text; of objects, the class."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """All that was learnt, in tensors and plain values; without physics and spec."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same."""

    def _checked(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Transitions:
        """Transitions that are what the spec says."""
        data = Transitions.checked(self.spec, states, actions, next_states)
        self.spec.check_transitions(data.states, data.next_states, data.actions)
        return data

    def _check_pair(self, states: Tensor, actions: Tensor) -> None:
        check_columns(states, self.spec.state_dim, "states")
        check_columns(actions, self.spec.action_dim, "actions")
        if states.dtype != torch.float64:
            raise TypeError(
                f"Expected states in float64, got {states.dtype}; use `states.double()`."
            )
        lead = zip(reversed(actions.shape[:-1]), reversed(states.shape[:-1]), strict=False)
        if actions.dim() > states.dim() or any(own not in (1, other) for own, other in lead):
            raise ValueError(
                "Expected an action for each state, or one for all, got states of shape "
                f"{tuple(states.shape)} and actions of shape {tuple(actions.shape)}."
            )

    def _check_blocks(self, states: Tensor, actions: Tensor, num_functions: int) -> None:
        self._check_pair(states, actions)
        if states.dim() != 3 or len(states) != num_functions:
            raise ValueError(
                f"Expected states of shape {num_functions} x N x {self.spec.state_dim}, a block "
                f"for each function, got {tuple(states.shape)}."
            )
