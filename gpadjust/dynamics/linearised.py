"""Dynamics near some states: means, slopes and variances of the next ones."""

from __future__ import annotations

from collections.abc import Sequence
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
        gain: The derivatives of the mean by the actions, ``N x state_dim x action_dim``.
    """

    mean: Tensor
    slope: Tensor
    variance: Tensor
    gain: Tensor

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
    with torch.enable_grad():
        given = [part.detach().clone().requires_grad_(True) for part in (states, actions)]
        mean = dynamics.mean_function()(*(part.unsqueeze(0) for part in given)).squeeze(0)
        slope, gain = derivatives(mean, given)
    with torch.no_grad():
        variance = dynamics.predict(states, actions).variance
    return Linearised(mean.detach(), slope, variance, gain)


def derivatives(values: Tensor, given: Sequence[Tensor]) -> list[Tensor]:
    """The derivatives of values ``N x c``, row by row, by each of some ``N x d``: ``N x c x d``."""
    rows = [
        torch.autograd.grad(column.sum(), given, retain_graph=True, materialize_grads=True)
        if column.requires_grad
        else [torch.zeros_like(part) for part in given]
        for column in values.unbind(-1)
    ]
    return [torch.stack(columns, dim=-2) for columns in zip(*rows, strict=True)]
