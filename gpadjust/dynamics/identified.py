"""Dynamics that a log has identified: a physics with a posterior of its parameters."""

from __future__ import annotations

from copy import deepcopy
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.core import Prediction
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.least_squares import StepErrors
from gpadjust.dynamics.physics_dynamics import next_values
from gpadjust.dynamics.state import check_numbers, fingerprint, loading
from gpadjust.physics import Physics
from gpadjust.physics.parameters import PhysicsParameters, even_normal
from gpadjust.states import StateSpec

_DRAWS = 32  # of the parameters, for the variance of a prediction
_ROUNDS = 5  # of the Gauss-Newton method


class IdentifiedDynamics(Dynamics):
    """A physics of which each sampled function has parameters drawn from their posterior.

    :func:`~gpadjust.records.identify` returns them, as ``found.dynamics``.

    Args:
        spec: The names and kinds of states and actions.
        physics: The next states.
        parameters: The posterior of its unknown parameters.
        noise: Standard deviations of the errors of measured states, ``state_dim``.
        process_noise: The same of what a step adds to the physics.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import IdentifiedDynamics, StateSpec
        >>> from gpadjust.physics import FormulaPhysics, PhysicsParameters, Unknown
        >>> unknowns = {"drag": Unknown(0.2, factor=2.0)}
        >>> physics = FormulaPhysics("(1 - drag) * v + force", ["v", "force"], unknowns=unknowns)
        >>> parameters = PhysicsParameters(unknowns, [torch.tensor([0.25, 0.35]).double()])
        >>> noises = torch.full((2, 1), 0.01, dtype=torch.float64)
        >>> dynamics = IdentifiedDynamics(StateSpec(["v"], ["force"]), physics, parameters, *noises)
        >>> dynamics.predict(torch.ones(1, 1).double(), torch.zeros(1, 1).double()).mean
        tensor([[0.7042]], dtype=torch.float64)
    """

    is_fitted = True

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics,
        parameters: PhysicsParameters,
        noise: Tensor,
        process_noise: Tensor,
    ) -> None:
        super().__init__(spec)
        self.physics = physics
        self.physics_parameters = parameters
        self.noise = noise
        self.process_noise = process_noise

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        r"""Learn the parameters further, from transitions whose states were measured.

        The posterior so far is the prior, :math:`N(m, P)` in coordinates. With errors e of single
        steps, their slopes J and variances S, which are those of process and sensor noise or, if
        they are larger, of the errors themselves, Gauss and Newton's steps lead to

        .. math:: \min_z e(z)^T S^{-1} e(z) + (z - m)^T P^{-1} (z - m), \quad
                  P' = (P^{-1} + J^T S^{-1} J)^{-1}.
        """
        data = self._checked(states, actions, next_states)
        unknowns = self.physics.unknowns
        if not unknowns:
            return
        # The prior N(m, P): mean and precision of the draws, in coordinates.
        draws = self.physics_parameters.coordinates
        z = mean = draws.mean(0)
        prior_precision = torch.linalg.inv(draws.mT.cov().reshape(len(z), len(z)))
        precision = prior_precision
        errors = StepErrors(self.physics, self.spec, data)
        # Both measured states of a step have the noise of the sensor: S >= q^2 + 2 r^2.
        least_variances = (self.process_noise**2 + 2 * self.noise**2)[self.spec.moving]
        for _ in range(_ROUNDS):
            e = errors.evaluate(z)
            sd = errors.variances(e).maximum(least_variances).sqrt().unsqueeze(-1)
            e = (e / sd).flatten()
            J = (errors.slopes(z) / sd).flatten(1)
            # z <- z - (P^-1 + J^T S^-1 J)^-1 (J^T S^-1 e + P^-1 (z - m))
            precision = prior_precision + J @ J.mT
            z = z - torch.linalg.solve(precision, J @ e + prior_precision @ (z - mean))
        # Draws of N(z, P'), with P' = L^-T L^-1 of the Cholesky factor L of its inverse.
        L = torch.linalg.cholesky(precision)
        spread = even_normal(len(draws), len(z), seed=0) @ L.inverse()
        self.physics_parameters = PhysicsParameters(
            unknowns, unknowns.to_values(z + spread).unbind(-1)
        )

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Return the next states by the parameters' center; variances by 32 draws and noise."""
        draws = self.physics_parameters.draws[:_DRAWS]
        rows = states.expand(len(draws), *[1] * (2 - states.dim()), *states.shape)
        values = draws.view(len(draws), *[1] * (rows.dim() - 3), -1)
        with torch.no_grad():
            mean = self._follow(states, actions, self.physics_parameters.center)
            paths = self._follow(rows, actions, values)
            # The mean square of the changes from the center's path, of angles the shorter way.
            changes = self.spec.change(mean.expand_as(paths), paths)
            variance = changes.square().mean(0).view_as(mean)
        return Prediction(mean, variance + self.noise_variance(states, actions))

    def mean_function(self) -> TransitionFunctions:
        """Return the physics with the parameters' center, with gradients as far as it has them."""
        return partial(self._follow, values=self.physics_parameters.center)

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the variance of process noise."""
        return self.process_noise.square().expand_as(states)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Return the physics with draws of the parameters, the same ones for the same seed."""
        checked_whole("num_functions", num_functions, 1)
        generator = torch.Generator().manual_seed(0 if seed is None else seed)
        draws = self.physics_parameters.draws
        order = torch.randperm(len(draws), generator=generator)
        values = draws[order[torch.arange(num_functions) % len(draws)]]
        return partial(self._follow, values=values)

    def physics_alone(self) -> Dynamics:
        """Return these dynamics."""
        return self

    def describe(self) -> dict[str, str]:
        """Return the settings, each as a text."""
        unknowns = {name: repr(u) for name, u in self.physics.unknowns.declared.items()}
        # The name of a formula is its text.
        return fingerprint(type(self), self.spec, physics=self.physics.name, unknowns=unknowns)

    def state_dict(self) -> dict[str, Any]:
        """Return settings, draws of the parameters and noises."""
        draws = self.physics_parameters.draws
        noises = {"noise": self.noise, "process_noise": self.process_noise}
        return deepcopy({"fingerprint": self.describe(), "draws": draws, **noises})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a result of :meth:`state_dict`; errors as of :class:`LearnedDynamics`."""
        with loading(state, self.describe()) as copy:
            del copy["fingerprint"]
            check_numbers(copy)
            draws = copy["draws"].unbind(-1)
            parameters = PhysicsParameters(self.physics.unknowns, draws)
            self.noise = copy["noise"]
            self.process_noise = copy["process_noise"]
        self.physics_parameters = parameters

    def _follow(self, states: Tensor, actions: Tensor, values: Tensor) -> Tensor:
        return next_values(self.physics, self.spec, states, actions, values)
