"""Scores of Gaussian predictions."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def rmse(mean: Tensor, y: Tensor) -> Tensor:
    """Root mean square error over the points.

    Args:
        mean: Predicted means, ``... x n x m``.
        y: True values, of the same shape.

    Returns:
        ``... x m``, in the units of ``y``.
    """
    return (mean - y).square().mean(-2).sqrt()


def nlpd(mean: Tensor, variance: Tensor, y: Tensor) -> Tensor:
    """Mean negative log predictive density over the points; lower is better.

    Args:
        mean: Predicted means, ``... x n x m``.
        variance: Predicted variances, of the same shape.
        y: True values, of the same shape.

    Returns:
        ``... x m``, in nats.
    """
    return -torch.distributions.Normal(mean, variance.sqrt()).log_prob(y).mean(-2)


def crps(mean: Tensor, variance: Tensor, y: Tensor) -> Tensor:
    """Mean continuous ranked probability score over the points; lower is better.

    In closed form for a normal prediction (Gneiting and Raftery 2007, eq. 21).

    Args:
        mean: Predicted means, ``... x n x m``.
        variance: Predicted variances, of the same shape.
        y: True values, of the same shape.

    Returns:
        ``... x m``, in the units of ``y``.
    """
    sd = variance.sqrt()
    z = (y - mean) / sd
    normal = torch.distributions.Normal(torch.zeros_like(z), torch.ones_like(z))
    density = normal.log_prob(z).exp()
    score = sd * (z * (2 * normal.cdf(z) - 1) + 2 * density - 1 / math.sqrt(math.pi))
    return score.mean(-2)


def coverage(mean: Tensor, variance: Tensor, y: Tensor, level: float = 0.95) -> Tensor:
    """Share of the points that lie within the central interval of a given level.

    Args:
        mean: Predicted means, ``... x n x m``.
        variance: Predicted variances, of the same shape.
        y: True values, of the same shape.
        level: Nominal coverage, between 0 and 1.

    Returns:
        ``... x m``, between 0 and 1; calibrated predictions have it near ``level``.
    """
    if not 0 < level < 1:
        raise ValueError(f"Expected level between 0 and 1, got {level}.")
    half = math.sqrt(2) * torch.erfinv(torch.tensor(level, dtype=mean.dtype))
    return ((y - mean).abs() <= half * variance.sqrt()).to(mean.dtype).mean(-2)
