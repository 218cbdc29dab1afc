"""What a Gaussian process says of the next state."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.state_spec import StateSpec, check_columns
from gpadjust.dynamics.transition_physics import Target, TransitionTargets
from gpadjust.dynamics.transition_scores import TransitionScores, score_transitions
from gpadjust.dynamics.transitions import Transitions
from gpadjust.models import ExactGPBase, Prediction


class ModelDynamics(Dynamics):
    """The base of dynamics that predict by a Gaussian process of this library.

    How it comes by its model is up to :class:`~gpadjust.dynamics.LearnedDynamics`.

    Args:
        spec: What the entries of states and actions are.
        target: What the model's outputs stand for; see
            :class:`~gpadjust.dynamics.CKADynamics`.
    """

    def __init__(self, spec: StateSpec, target: Target) -> None:
        super().__init__(spec)
        self.targets = TransitionTargets(spec, target)

    @property
    @abstractmethod
    def model(self) -> ExactGPBase:
        """The model, whose targets are what ``target`` says of the predicted states."""

    def predict(
        self, states: Tensor, actions: Tensor, *, observation_noise: bool = True
    ) -> Prediction:
        """Mean and variance of the next states, entry by entry.

        Args:
            states: ``... x state_dim``.
            actions: ``... x action_dim``.
            observation_noise: Whether the variance includes the noise that was learnt, by which
                next states scatter about the mean.

        Returns:
            ``... x state_dim`` each; of an angle, not wrapped.

        Raises:
            RuntimeError: If nothing was learnt yet.
            PhysicsError: If the physics fails.
        """
        following, variance = self._predict(states, actions, observation_noise)
        return Prediction(
            self.spec.complete(states, actions, following), self.spec.complete_variance(variance)
        )

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, noise included, row by row, from PyTorch's generator."""
        mean, variance = self._predict(states, actions, True)
        return self.spec.complete(states, actions, mean + variance.sqrt() * torch.randn_like(mean))

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw transition functions from the posterior; without noise.

        Args:
            num_functions: Number ``k`` of functions.
            seed: Seed of the draw. Default: go on with PyTorch's generator.

        Returns:
            A function of states ``k x N x state_dim`` and actions ``k x N x action_dim`` to next
            states. Later updates leave it as it is.

        Raises:
            RuntimeError: If nothing was learnt yet.
        """
        functions: Any = self.model.sample_functions(num_functions, seed)

        @torch.no_grad()
        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_pair(states, actions)
            if states.dim() != 3 or len(states) != num_functions:
                raise ValueError(
                    f"Expected states of shape {num_functions} x N x {self.spec.state_dim}, a "
                    f"block for each function, got {tuple(states.shape)}."
                )
            values = functions.each(self.targets.inputs(states, actions))
            return self.spec.complete(states, actions, self.targets.decode(states, values))

        return step

    def score(self, states: Tensor, actions: Tensor, next_states: Tensor) -> TransitionScores:
        """Judge the predictions by transitions that were not learnt from.

        Raises:
            RuntimeError: If nothing was learnt yet.
            TypeError: As :meth:`fit`.
            ValueError: As :meth:`fit`; one row will do.
        """
        data = Transitions.checked(self.spec, states, actions, next_states)
        return score_transitions(self.spec, self.predict(data.states, data.actions), data)

    def _predict(
        self, states: Tensor, actions: Tensor, observation_noise: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean and variance of the predicted states, ``... x len(spec.predicted)``."""
        self._check_pair(states, actions)
        X = self.targets.inputs(states, actions)
        with torch.no_grad():
            flat = X.reshape(-1, X.shape[-1])
            mean, variance = self.model.predict(flat, observation_noise=observation_noise)
        mean, variance = (t.reshape(*X.shape[:-1], t.shape[-1]) for t in (mean, variance))
        return self.targets.decode(states, mean), variance

    def _check_pair(self, states: Tensor, actions: Tensor) -> None:
        check_columns(states, self.spec.state_dim, "states")
        check_columns(actions, self.spec.action_dim, "actions")
