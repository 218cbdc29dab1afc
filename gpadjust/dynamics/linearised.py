"""Dynamics near some states: means, slopes and variances of the next ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.base import Dynamics


class Linearised(NamedTuple):
    """Next states near ``N`` states and actions."""

    mean: Tensor  # N x state_dim; of angles, not wrapped
    slope: Tensor  # derivatives of the mean by the states, N x state_dim x state_dim
    variance: Tensor  # predicted, with the noise, N x state_dim
    gain: Tensor  # derivatives of the mean by the actions, N x state_dim x action_dim

    def carry(self, covariance: Tensor) -> Tensor:
        """Return covariances of the next states, from those of the states."""
        carried = self.slope @ covariance @ self.slope.mT + torch.diag_embed(self.variance)
        return (carried + carried.mT) / 2


def linearised(dynamics: Dynamics, states: Tensor, actions: Tensor) -> Linearised:
    """Linearise the mean of fitted dynamics by its gradients, at ``N`` rows."""
    with torch.enable_grad():
        at = [part.detach().clone().requires_grad_(True) for part in (states, actions)]
        mean = dynamics.mean_function()(*(part.unsqueeze(0) for part in at)).squeeze(0)
        slope, gain = derivatives(mean, at)
    with torch.no_grad():
        variance = dynamics.predict(states, actions).variance
    return Linearised(mean.detach(), slope, variance, gain)


def derivatives(values: Tensor, by: Sequence[Tensor]) -> list[Tensor]:
    """Return derivatives ``N x c x d`` of values, row by row, by each of some ``N x d``."""
    rows = [
        torch.autograd.grad(column.sum(), by, retain_graph=True, materialize_grads=True)
        if column.requires_grad
        else [torch.zeros_like(part) for part in by]
        for column in values.unbind(-1)
    ]
    return [torch.stack(columns, dim=-2) for columns in zip(*rows, strict=True)]
