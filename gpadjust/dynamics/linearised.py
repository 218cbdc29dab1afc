"""Dynamics near some states: means, slopes and variances of the next states."""

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
    variance: Tensor  # of the prediction, with noise, N x state_dim
    gain: Tensor  # derivatives of the mean by the actions, N x state_dim x action_dim

    def carry(self, covariance: Tensor) -> Tensor:
        """Return covariances of the next states, by the covariances of the states."""
        # F P F^T + Q, symmetric despite rounding
        carried = self.slope @ covariance @ self.slope.mT + torch.diag_embed(self.variance)
        return (carried + carried.mT) / 2


def linearised(dynamics: Dynamics, states: Tensor, actions: Tensor) -> Linearised:
    """Linearise the mean of fitted dynamics by its gradients, at ``N`` rows."""
    with torch.enable_grad():
        leaves = [part.detach().clone().requires_grad_(True) for part in (states, actions)]
        mean = dynamics.mean_function()(*(leaf.unsqueeze(0) for leaf in leaves)).squeeze(0)
        slope, gain = derivatives(mean, leaves)
    with torch.no_grad():
        variance = dynamics.predict(states, actions).variance
    return Linearised(mean.detach(), slope, variance, gain)


def derivatives(values: Tensor, by: Sequence[Tensor]) -> list[Tensor]:
    """Return derivatives ``N x c x d`` of values ``N x c`` by tensors ``N x d``, for each row."""
    rows: list[Sequence[Tensor]] = []
    for column in values.unbind(-1):
        slopes: Sequence[Tensor] = [torch.zeros_like(part) for part in by]
        if column.requires_grad:  # no row depends on another: the sum has the slopes of each row
            total = column.sum()
            slopes = torch.autograd.grad(total, by, retain_graph=True, materialize_grads=True)
        rows.append(slopes)
    return [torch.stack(columns, dim=-2) for columns in zip(*rows, strict=True)]
