"""f_p with its parameters fitted as a user would: by least squares of single steps."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor

from gpadjust.dynamics import PhysicsDynamics, Trajectories
from gpadjust.models import Prediction
from paper.real.machines import Machine, Parameters

_ROUNDS = 2


class LeastSquares(PhysicsDynamics):
    """f_p alone, all its parameters fitted to all transitions, none of them below zero.

    What is squared is the error of each state in a step, in units of the state's change at first,
    and then once more in units of its error by then. That error is also taken as the noise.

    Args:
        machine: The machine.
        start: The parameters where the search begins.
    """

    def __init__(self, machine: Machine, start: Parameters) -> None:
        self.machine, self.parameters = machine, dict(start)
        super().__init__(machine.spec, machine.physics(start))
        self._data: Trajectories | None = None
        self._noise = torch.zeros(machine.spec.state_dim, dtype=torch.float64)

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Fit the parameters to these and earlier transitions."""
        data = self._checked(states, actions, next_states)
        data = self._data = data if self._data is None else self._data.append(data)
        rows = torch.cat([data.states, data.actions], dim=-1)
        found = np.array([*self.parameters.values()])

        def errors(values: NDArray[np.float64]) -> Tensor:
            physics = self.machine.physics(dict(zip(self.parameters, values, strict=True)))
            with torch.no_grad():
                return self.spec.change(data.next_states, physics(rows))

        def residuals(values: NDArray[np.float64], scale: Tensor) -> NDArray[np.float64]:
            return (errors(values) / scale).flatten().numpy()

        scale = self.spec.change(data.states, data.next_states).square().mean(0).sqrt()
        for _ in range(_ROUNDS):
            # Scaled by the Jacobian, as some parameters are thousands of times as large as others.
            options = {"bounds": (0, np.inf), "x_scale": "jac", "args": (scale,)}
            found = optimize.least_squares(residuals, found, **options).x
            scale = errors(found).square().mean(0).sqrt()
        self.parameters = dict(zip(self.parameters, found.tolist(), strict=True))
        self.physics = self.machine.physics(self.parameters)
        self._noise = scale.square()

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """The next states, and the variance of the noise."""
        mean = super().predict(states, actions).mean
        return Prediction(mean, self._noise.expand_as(mean))

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states, with noise."""
        following = super().sample(states, actions)
        return following + self._noise.sqrt() * torch.randn_like(following)

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """The mean square of the errors that are left, of each state."""
        return self._noise.expand_as(states)
