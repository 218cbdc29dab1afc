"""Ranking of structures by their predictions of an output, and weights for a mixture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from botorch.models.transforms.outcome import nanstd
from torch import Tensor

from gpadjust.validation.leave_one_out import LeaveOneOut

_BOOTSTRAPS = 200
_STEPS = 300
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
    left_out: dict[str, LeaveOneOut], output: int, prior: Sequence[float] | None = None
) -> list[Candidate]:
    """The structures for one output, best first; ``prior`` as in ``stacking_weights``."""
    density = densities(left_out, output)
    weights = stacking_weights(density, prior).tolist()
    order = density.sum(0).argsort(descending=True, stable=True).tolist()
    names, best = [*left_out], density[:, order[0]]
    return [
        _row(names[k], left_out[names[k]], output, density[:, k], best, weights[k]) for k in order
    ]


def beside(
    alone: dict[str, LeaveOneOut], left_out: dict[str, LeaveOneOut], output: int
) -> list[Candidate]:
    """Rows of what is no candidate, beside the best structure for one output."""
    density = densities(left_out, output)
    best = density[:, int(density.sum(0).argmax())]
    each = densities(alone, output).unbind(-1)
    rows = zip(alone.items(), each, strict=True)
    return [_row(name, loo, output, own, best, 0.0) for (name, loo), own in rows]


def _row(
    name: str, loo: LeaveOneOut, output: int, density: Tensor, best: Tensor, weight: float
) -> Candidate:
    scores = loo.score()
    spread = float(nanstd(loo.Y[:, output : output + 1], dim=0))
    return Candidate(
        name,
        density.sum().item(),
        *difference(density, best),
        weight,
        scores.rmse[output].item() / (spread if spread > 0 else 1.0),
        scores.coverage[output].item(),
    )


def densities(left_out: dict[str, LeaveOneOut], output: int) -> Tensor:
    """The log predictive densities of an output's observations by each structure, ``n x K``.

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
    """The difference of two elpd, and its standard error (Vehtari et al. 2017, eq. 24)."""
    each = first - second
    return each.sum().item(), math.sqrt(len(each)) * each.std(correction=0).item()


def sign_of(value: float, error: float) -> int:
    """The sign that a difference is shown to have, or 0."""
    shown = abs(value) > max(SURE * error, _LEAST)
    return 0 if not shown else 1 if value > 0 else -1


def stacking_weights(
    density: Tensor, prior: Sequence[float] | None = None, seed: int = 0
) -> Tensor:
    r"""Weights of structures whose mixture predicts left-out observations best, ``K``.

    .. math:: w = E_\alpha \arg\max_w \sum_i n \alpha_i \log \sum_k w_k \exp(\ell_{ik})
        + \sum_k c_k \log w_k, \quad \alpha \sim Dirichlet(1, \dots, 1)

    (Yao et al. 2018, eq. 4). The Bayesian bootstrap over the observations (Rubin 1981) keeps few of
    them from being too sure, and so does what is known beforehand, the numbers c.

    Args:
        density: Log predictive densities of left-out observations, ``n x K``.
        prior: Observations that the weight of each structure counts for beforehand, ``K``.
            Default: none.
        seed: Of the bootstrap.
    """
    n, K = density.shape
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(_BOOTSTRAPS, n, generator=generator, dtype=torch.float64)
    share = -torch.log1p(-drawn)  # exponential
    share = (share / share.sum(-1, keepdim=True)).to(density)
    known = density.new_tensor([0.0] * K if prior is None else [*prior]) / n
    likelihood = (density - density.amax(-1, keepdim=True)).exp()
    weights = density.new_full((_BOOTSTRAPS, K), 1 / K)
    for _ in range(_STEPS):  # expectation maximisation, which keeps to the simplex
        found = weights * ((share / (weights @ likelihood.mT)) @ likelihood)
        weights = (found + known) / (1 + known.sum())
    return weights.mean(0)
