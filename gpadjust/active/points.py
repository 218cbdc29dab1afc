"""The next points: of a design, or with the highest value of an acquisition function."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch
from botorch.acquisition import AcquisitionFunction, OneShotAcquisitionFunction
from botorch.exceptions.errors import UnsupportedError
from botorch.optim import optimize_acqf
from botorch.utils.sampling import draw_sobol_samples
from torch import Tensor
from torch.quasirandom import SobolEngine

NEAR = 0.01  # of the bounds' widths: closer points count as the same
_LIMITS = (
    "inequality_constraints",
    "equality_constraints",
    "nonlinear_inequality_constraints",
    "fixed_features",
)
_OTHERS = 256  # random points, of which the best replaces one too close to others


def sobol_points(bounds: Tensor, q: int, earlier: Tensor, seed: int) -> Tensor:
    """Return the next points of a scrambled Sobol sequence without earlier ones, ``q x d``."""
    engine = SobolEngine(bounds.shape[-1], scramble=True, seed=seed)
    # The earlier points may be those of the sequence, or any others.
    unit = engine.draw(len(earlier) + q, dtype=torch.float64)
    points = bounds[0] + (bounds[1] - bounds[0]) * unit
    return points[~among(points, earlier)][:q]


def limits_among(options: dict[str, Any]) -> list[str]:
    """Return the names of options of ``optimize_acqf`` that random points do not keep."""
    return [name for name in _LIMITS if options.get(name)]


def among(points: Tensor, others: Tensor) -> Tensor:
    """Return a mask of points ``n x d`` that are among the others, ``n``."""
    return (points.unsqueeze(-2) == others).all(-1).any(-1)


def distances(points: Tensor, others: Tensor, bounds: Tensor) -> Tensor:
    """Return distances of points ``n x d`` from others, ``n x k``, in the bounds' widths."""
    # max_i |x_i - x'_i| / (b_i - a_i)
    gaps = (points.unsqueeze(-2) - others).abs() / (bounds[1] - bounds[0])
    return gaps.amax(-1)


def best_points(
    acquisition: AcquisitionFunction, collection: Any, q: int, options: dict[str, Any]
) -> Tensor:
    """Return points of a maximum of an acquisition function, ``q x d``, by ``optimize_acqf``.

    Failed points count as pending, so that their neighbourhood has no value, and no point is near
    one, except with constraints among the options.
    """
    # A line search that rounding errors end has converged: a second try is not needed.
    defaults = {"num_restarts": 8, "raw_samples": 128, "retry_on_optimization_warning": False}
    bounds, failed = collection.bounds, collection.failed_X
    others = torch.cat([collection.pending, failed])
    with taken_as_pending(acquisition, others) as has_pending:
        # A function without X_pending would return pending points again.
        avoided = others
        if has_pending:
            avoided = failed
        points, _ = optimize_acqf(acquisition, bounds, q=q, **{**defaults, **options})
        points = points.detach()
        if limits_among(options):  # a random place may be outside
            return points
        for i in range(q):
            if (distances(points[i : i + 1], avoided, bounds) < NEAR).any():
                points[i] = _elsewhere(acquisition, points, i, avoided, bounds)
    return points


@contextmanager
def taken_as_pending(acquisition: AcquisitionFunction, points: Tensor) -> Iterator[bool]:
    """Add pending points to an acquisition function for a while; yield whether it takes any."""
    before = getattr(acquisition, "X_pending", None)
    pending = points if before is None else torch.cat([before, points])
    has_pending = False
    if len(points):
        with suppress(UnsupportedError):
            acquisition.set_X_pending(pending)
            has_pending = True
    try:
        yield has_pending
    finally:
        if has_pending:
            acquisition.set_X_pending(before)


def _elsewhere(
    acquisition: AcquisitionFunction, points: Tensor, i: int, avoided: Tensor, bounds: Tensor
) -> Tensor:
    """Return the best place for the i-th point among random ones away from others."""
    seed = int(torch.randint(2**31, (1,)))
    places = draw_sobol_samples(bounds, n=_OTHERS, q=1, seed=seed).squeeze(-2)
    places = places[(distances(places, avoided, bounds) >= NEAR).all(-1)]
    if not len(places):
        return points[i]
    if isinstance(acquisition, OneShotAcquisitionFunction):
        return places[0]  # its value at a point is an optimisation in itself
    # The value of the batch with each place for the i-th point.
    batches = points.repeat(len(places), 1, 1)
    batches[:, i] = places
    with torch.no_grad():
        return places[acquisition(batches).argmax()]
