"""The points to measure next: of a design, or of the highest acquisition value."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from botorch.acquisition import AcquisitionFunction, OneShotAcquisitionFunction
from botorch.exceptions.errors import UnsupportedError
from botorch.optim import optimize_acqf
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor
from torch.quasirandom import SobolEngine

NEAR = 0.01  # of the bounds' widths: closer than this is the same point
_OTHERS = 256  # points among which the best is taken in its place


def sobol_points(bounds: Tensor, q: int, known: Tensor, seed: int) -> Tensor:
    """Return the next points of a scrambled Sobol sequence that are not known yet.

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
    """Mark each of ``n x d`` points that is one of the others, ``n``."""
    return (points.unsqueeze(-2) == others).all(-1).any(-1)


def distances(points: Tensor, others: Tensor, bounds: Tensor) -> Tensor:
    """Return distances of ``n x d`` points from others, the largest over the inputs: ``n x k``.

    They are in units of the bounds' widths.
    """
    gaps = (points.unsqueeze(-2) - others).abs() / (bounds[1] - bounds[0])
    return gaps.amax(-1)


def best_points(
    acquisition: AcquisitionFunction,
    bounds: Tensor,
    q: int,
    pending: Tensor,
    failed: Tensor,
    options: dict[str, Any],
) -> Tensor:
    """Maximise an acquisition function.

    Args:
        acquisition: The acquisition function.
        bounds: Bounds of the inputs, ``2 x d``.
        q: Number of points.
        pending: Points that are being measured, ``k x d``.
        failed: Points where measuring failed, ``l x d``. They are taken as pending, so that the
            function sees no more use in them, and none of the points is near one of them.
        options: Arguments of ``optimize_acqf`` other than those above.

    Returns:
        The points, ``q x d``.
    """
    # A line search that rounding errors end has converged: no second try is needed.
    defaults = {"num_restarts": 8, "raw_samples": 128, "retry_on_optimization_warning": False}
    taken = torch.cat([pending, failed])
    with taken_as_pending(acquisition, taken) as counts:
        away = failed if counts else taken  # others are to be kept from by hand
        points, _ = optimize_acqf(acquisition, bounds, q=q, **{**defaults, **options})
        points = points.detach()
        for i in range(q):
            if _near(points[i : i + 1], away, bounds).any():
                points[i] = _elsewhere(acquisition, points, i, away, bounds)
    return points


@contextmanager
def taken_as_pending(acquisition: AcquisitionFunction, points: Tensor) -> Iterator[bool]:
    """Let an acquisition function count on pending points beside its own, if it does so at all.

    It has its own alone again at the end. The value is whether it counts on them.
    """
    own, counts = getattr(acquisition, "X_pending", None), bool(len(points))
    if counts:
        try:
            acquisition.set_X_pending(points if own is None else torch.cat([own, points]))
        except UnsupportedError:
            counts = False
    try:
        yield counts
    finally:
        if counts:
            acquisition.set_X_pending(own)


def _near(points: Tensor, others: Tensor, bounds: Tensor) -> Tensor:
    """Mark each of ``n x d`` points near one of the others, ``n``."""
    return (distances(points, others, bounds) < NEAR).any(-1)


def _elsewhere(
    acquisition: AcquisitionFunction, points: Tensor, i: int, away: Tensor, bounds: Tensor
) -> Tensor:
    """Return the best place for the i-th point among random ones that are not near others."""
    seed = int(torch.randint(2**31, (1,)))
    drawn = draw_sobol_samples(bounds, n=_OTHERS, q=1, seed=seed).squeeze(-2)
    drawn = drawn[~_near(drawn, away, bounds)]
    if not len(drawn):
        return points[i]
    if isinstance(acquisition, OneShotAcquisitionFunction):
        return drawn[0]  # its value at a point is an optimisation in itself
    batches = points.repeat(len(drawn), 1, 1)
    batches[:, i] = drawn
    with torch.no_grad():
        return drawn[acquisition(batches).argmax()]
