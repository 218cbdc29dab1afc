"""Dynamics near some states: means, slopes and variances of the next ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.base import Dynamics


class Linearised(NamedTuple):
    """Next states near ``N`` states and actions.

    Args:
        mean: Their mean at these, ``N x state_dim``; of angles, not wrapped.
        slope: Its derivatives by the states, ``N x state_dim x state_dim``.
        variance: The predicted variance there, with the noise, ``N x state_dim``.
    """

    mean: Tensor
    slope: Tensor
    variance: Tensor

    def carry(self, covariance: Tensor) -> Tensor:
        """Covariances of the next states, from ``N x state_dim x state_dim`` of the states."""
        carried = self.slope @ covariance @ self.slope.mT + torch.diag_embed(self.variance)
        return (carried + carried.mT) / 2


def linearised(dynamics: Dynamics, states: Tensor, actions: Tensor) -> Linearised:
    """Linearise the mean of dynamics by its gradients.

    Args:
        dynamics: The dynamics; they must be fitted.
        states: ``N x state_dim``.
        actions: ``N x action_dim``.

    Raises:
        RuntimeError: If the dynamics have learnt nothing yet.
        PhysicsError: If the physics fails.
    """

    def mean(at: Tensor) -> Tensor:
        return dynamics.mean_function()(at.unsqueeze(0), actions.unsqueeze(0)).squeeze(0)

    values, slope = with_slope(mean, states)
    with torch.no_grad():
        variance = dynamics.predict(states, actions).variance
    return Linearised(values, slope, variance)


def with_slope(function: Callable[[Tensor], Tensor], states: Tensor) -> tuple[Tensor, Tensor]:
    """Values ``N x m`` at states ``N x state_dim``, row by row, and their derivatives by these.

    The derivatives are ``N x m x state_dim``.
    """
    with torch.enable_grad():
        at = states.detach().clone().requires_grad_(True)
        values = function(at)
        rows = [
            torch.autograd.grad(column.sum(), at, retain_graph=True, materialize_grads=True)[0]
            if column.requires_grad
            else torch.zeros_like(at)
            for column in values.unbind(-1)
        ]
    return values.detach(), torch.stack(rows, dim=-2)
