"""Ranking of structures by their predictions of an output."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.validation.leave_one_out import LeaveOneOut

SURE = 2.0  # standard errors that a difference takes to be real
ENOUGH = 8  # observations of different inputs, for a difference to be shown
_LEAST = 1e-6  # nats; less is rounding
_WORST = -1e6  # nats; a density of zero would make others' differences infinite


class Candidate(NamedTuple):
    """Quality of the predictions of an output's left-out observations by a structure.

    Attributes:
        structure: Its name.
        elpd: Expected log predictive density, the sum over the observations, in nats.
        elpd_diff: That less the best structure's; 0 for the best.
        se_diff: The standard error of this difference.
        weight: Its weight in the stacked model.
        rmse: Root mean square error, relative to the standard deviation of the observations.
        coverage: Share of the observations within their 95 % intervals.
    """

    structure: str
    elpd: float
    elpd_diff: float
    se_diff: float
    weight: float
    rmse: float
    coverage: float


def ranking(
    left_out: Mapping[str, LeaveOneOut], output: int, weights: Mapping[str, float], best: Tensor
) -> list[Candidate]:
    """Return the structures for one output, best first.

    Args:
        left_out: The predictions by the names of the structures.
        output: Which output.
        weights: The weights by these names; 0 where there is none.
        best: The densities that others are compared with, see :func:`best_of`.
    """
    each = zip(left_out.items(), densities(left_out, output).unbind(-1), strict=True)
    rows = []
    for (name, loo), density in each:
        scores, spread = loo.score(), spread_of(loo.Y[:, output])
        rmse, coverage = scores.rmse[output].item(), scores.coverage[output].item()
        apart = difference(density, best)
        elpd, weight = density.sum().item(), weights.get(name, 0.0)
        rows.append(Candidate(name, elpd, *apart, weight, rmse / spread, coverage))
    return sorted(rows, key=lambda row: -row.elpd)


def best_of(left_out: Mapping[str, LeaveOneOut], output: int) -> Tensor:
    """Return the log densities of an output's observations by the structure of highest elpd."""
    density = densities(left_out, output)
    return density[:, int(density.sum(0).argmax())]


def spread_of(y: Tensor) -> float:
    """Return the standard deviation of observations, NaN left out; 1 if all are equal."""
    return float(y[~y.isnan()].std()) or 1.0


def densities(left_out: Mapping[str, LeaveOneOut], output: int) -> Tensor:
    """Return the log densities of an output's observations by each structure, ``n x K``.

    Observations of the same inputs are taken together, ``n`` are different inputs: repeated ones
    are no further evidence of where a structure is right, but would seem to be.
    """
    found = torch.stack([loo.log_density[:, output] for loo in left_out.values()], -1)
    (first, *_) = left_out.values()
    seen = ~first.Y[:, output].isnan()
    each = found[seen].nan_to_num(nan=_WORST, neginf=_WORST).clamp_min(_WORST)
    distinct, group = first.X[seen].unique(dim=0, return_inverse=True)
    if len(distinct) == len(each):
        return each  # in the order of the observations
    return each.new_zeros(len(distinct), each.shape[-1]).index_add(0, group, each)


def difference(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Return the difference of two elpd, and its standard error (Vehtari et al. 2017, eq. 24)."""
    each = first - second
    return each.sum().item(), math.sqrt(len(each)) * each.std(correction=0).item()


def sign_of(value: float, error: float) -> int:
    """Return the sign that a difference is shown to have, or 0."""
    if abs(value) <= max(SURE * error, _LEAST):
        return 0
    return 1 if value > 0 else -1
