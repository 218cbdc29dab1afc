"""Points that are chosen without a model."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

NEAR = 0.01  # of the bounds' widths: closer than this is the same point


def sobol_points(bounds: Tensor, q: int, known: Tensor, seed: int) -> Tensor:
    """The next points of a scrambled Sobol sequence that are not known yet.

    Args:
        bounds: Bounds of the inputs, ``2 x d``.
        q: Number of points.
        known: Points that are not wanted again, ``n x d``.
        seed: Seed of the scrambling.

    Returns:
        The points, ``q x d``.
    """
    engine = SobolEngine(bounds.shape[-1], scramble=True, seed=seed)
    drawn = engine.draw(len(known) + q, dtype=torch.float64)
    points = bounds[0] + (bounds[1] - bounds[0]) * drawn
    return points[~among(points, known)][:q]


def among(points: Tensor, others: Tensor) -> Tensor:
    """Whether each of ``n x d`` points is one of the others, ``n``."""
    return (points.unsqueeze(-2) == others).all(-1).any(-1)


def distances(points: Tensor, others: Tensor, bounds: Tensor) -> Tensor:
    """Distances of ``n x d`` points from others, the largest over the inputs: ``n x k``.

    They are in units of the bounds' widths.
    """
    gaps = (points.unsqueeze(-2) - others).abs() / (bounds[1] - bounds[0])
    return gaps.amax(-1)
