"""Which structure predicts an output best, how sure that is, and weights to stack them by."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from botorch.models.transforms.outcome import nanstd
from torch import Tensor

from gpadjust.validation.leave_one_out import LeaveOneOut

_BOOTSTRAPS = 1000
_WORST = -1e6  # nats; a density of zero would make others' differences infinite


class Candidate(NamedTuple):
    """How well a structure predicts an output's left-out observations, in the user's units.

    Attributes:
        structure: Its name.
        elpd: Expected log predictive density, the sum over the observations, in nats.
        elpd_diff: That less the best structure's; 0 for the best.
        se_diff: The standard error of this difference.
        weight: Its weight in the stacked model, by pseudo-BMA+.
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


def ranking(left_out: dict[str, LeaveOneOut], output: int) -> list[Candidate]:
    """The structures for one output, best first.

    Args:
        left_out: The leave-one-out predictions of each structure.
        output: The number of the output.
    """
    density = densities(left_out, output)
    weights = pseudo_bma_weights(density).tolist()
    order = density.sum(0).argsort(descending=True, stable=True).tolist()
    names, rows = [*left_out], []
    for k in order:
        loo = left_out[names[k]]
        elpd_diff, se_diff = difference(density[:, k], density[:, order[0]])
        spread = float(nanstd(loo.Y[:, output : output + 1], dim=0))
        rows.append(
            Candidate(
                names[k],
                density[:, k].sum().item(),
                elpd_diff,
                se_diff,
                weights[k],
                loo.rmse[output].item() / (spread if spread > 0 else 1.0),
                loo.coverage()[output].item(),
            )
        )
    return rows


def densities(left_out: dict[str, LeaveOneOut], output: int) -> Tensor:
    """The log predictive densities of an output's observations by each structure, ``n x K``."""
    found = torch.stack([loo.log_density[:, output] for loo in left_out.values()], -1)
    (first, *_) = left_out.values()
    seen = ~first.Y[:, output].isnan()
    return found[seen].nan_to_num(nan=_WORST, neginf=_WORST).clamp_min(_WORST)


def difference(first: Tensor, second: Tensor) -> tuple[float, float]:
    """The difference of two elpd, and its standard error (Vehtari et al. 2017, eq. 24)."""
    each = first - second
    return each.sum().item(), math.sqrt(len(each)) * each.std(correction=0).item()


def pseudo_bma_weights(density: Tensor, seed: int = 0) -> Tensor:
    r"""Weights of structures by pseudo-BMA+ (Yao et al. 2018, sec. 3.4), ``K``.

    .. math:: w_k = E_\alpha \frac{\exp(n \sum_i \alpha_i \ell_{ik})}
        {\sum_j \exp(n \sum_i \alpha_i \ell_{ij})}, \quad \alpha \sim Dirichlet(1, \dots, 1)

    The Bayesian bootstrap over the observations keeps few of them from being too sure.

    Args:
        density: Log predictive densities of left-out observations, ``n x K``.
        seed: Of the bootstrap.
    """
    n = len(density)
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(_BOOTSTRAPS, n, generator=generator, dtype=torch.float64)
    share = -torch.log1p(-drawn)  # exponential
    share = (share / share.sum(-1, keepdim=True)).to(density)
    return (n * share @ density).softmax(-1).mean(0)
