"""A few draws of hyper-parameters that predict as all of them do."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.gp.gaussian import cholesky
from gpadjust.inference.targets import LogPosterior

_OF_POSITIONS = 0.3  # weight of the hyper-parameters themselves among what draws represent
_OF_MODELS = 3.0  # weight of which model they are of
_LITTLE = 1e-3  # of the largest weight, of draws that are left out
_NOTHING = 1e-12  # of the targets' mean square, of a variance
_EXCHANGES = 5  # rounds of better draws for the chosen ones


class LeftOut(NamedTuple):
    """Predictions of each observation from the others, at draws of ``B`` outputs.

    Attributes:
        mean: ``N x B x n``, less the observation.
        variance: Of the same shape.
    """

    mean: Tensor
    variance: Tensor

    def of(self, rows: slice) -> LeftOut:
        """Return the predictions by some of the draws."""
        return LeftOut(self.mean[rows], self.variance[rows])

    def mixture(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance, ``B x n``, of the mixture of draws by weights ``N x B``."""
        weights = (weights / weights.sum(0)).unsqueeze(-1)
        mean = (weights * self.mean).sum(0)
        return mean, (weights * (self.variance + (self.mean - mean).square())).sum(0)


@torch.no_grad()
def left_out(target: LogPosterior, vectors: Tensor) -> LeftOut:
    """Predictions at vectors ``N x B x p``."""
    mean, covariance, *_ = target.distribution(target.parameters.unflatten(vectors))
    residual = (target.targets - mean).expand(covariance.shape[:-1])
    observed = ~residual.isnan()
    chol, _ = cholesky(covariance, None if observed.all() else observed)
    precision = torch.cholesky_inverse(chol).diagonal(dim1=-1, dim2=-2)
    alpha = torch.cholesky_solve(residual.nan_to_num(nan=0.0).unsqueeze(-1), chol).squeeze(-1)
    variance, shape = precision.reciprocal(), (*vectors.shape[:2], -1)
    return LeftOut((-alpha * variance).reshape(shape), variance.reshape(shape))


def disagreement(predictions: LeftOut, weights: Tensor, targets: Tensor) -> Tensor:
    """Return the distance of predictions by two halves of the draws, ``B``.

    Half of the root mean square difference of their means, in predicted standard deviations, which
    is the error of the mean of both; the halves are the draws by turns. Standard deviations of a
    millionth of the targets are as good as none, and rows without a target do not count.

    Args:
        predictions: Those of the draws.
        weights: Of the draws, ``N x B``.
        targets: The observations, ``... x n``; NaN where there is none.
    """
    (first, _), (second, _) = (
        predictions.of(slice(i, None, 2)).mixture(weights[i::2]) for i in range(2)
    )
    _, variance = predictions.mixture(weights)
    targets = targets.reshape(-1, targets.shape[-1])
    size = targets.square().nanmean(-1, keepdim=True)
    variance = variance + (_NOTHING * size).clamp_min(torch.finfo(size.dtype).tiny)
    square = (first - second).square() / variance
    return 0.5 * square.where(~targets.isnan(), math.nan).nanmean(-1).sqrt()


@torch.no_grad()
def representative(
    predictions: LeftOut,
    positions: Tensor,
    weights: Tensor,
    number: int,
    which: Tensor | None = None,
) -> Tensor:
    """Numbers of a few draws whose mixture predicts as that of all, ``number x B``, in order.

    Their mean predictions of left-out observations, standard deviations and hyper-parameters are
    to be those of all: greedily chosen, then exchanged one by one.

    Args:
        predictions: Those of the draws.
        positions: Of the draws, ``N x B x p``.
        weights: Of the draws, ``N x B``, which sum to one.
        number: How many.
        which: Numbers of the models that draws are of, ``N``, from 0; as many are chosen of each as
            it has weight. Default: all are of one.
    """
    share = weights.unsqueeze(-1)
    unit = (share * predictions.variance).sum(0).sqrt()
    away = positions - (share * positions).sum(0)
    spread = (share * away.square()).sum(0).sqrt().clamp_min(torch.finfo(away.dtype).tiny)
    parts = [
        predictions.mean / unit,
        predictions.variance.sqrt() / unit,
        _OF_POSITIONS * away / spread,
    ]
    which = weights.new_zeros(len(weights)) if which is None else which
    for model in range(int(which.max())):
        is_own = which.eq(model).to(away)[:, None, None]
        parts.append(_OF_MODELS * is_own.expand_as(away[..., :1]))
    features = torch.cat(
        [(each - (share * each).sum(0)) / math.sqrt(each.shape[-1]) for each in parts], dim=-1
    )
    grams = features.transpose(0, 1) @ features.transpose(0, 1).mT
    columns = zip(grams.nan_to_num(), weights.mT, strict=True)
    return torch.stack([_of_mean_zero(gram, w, number) for gram, w in columns], dim=-1)


def _of_mean_zero(gram: Tensor, weights: Tensor, number: int) -> Tensor:
    """Numbers of elements whose sum is small, by their inner products ``N x N``.

    None of next to no weight, and each once if there are enough.
    """
    size, total = gram.diagonal(), torch.zeros_like(gram[0])
    is_out = weights < _LITTLE * weights.max()
    chosen: list[int] = []

    def best() -> int:
        cost = (size + 2 * total).masked_fill(is_out, math.inf)
        if len(chosen) < int((~is_out).sum()):
            cost[chosen] = math.inf
        return int(cost.argmin())

    for _ in range(number):
        chosen.append(best())
        total = total + gram[chosen[-1]]
    for _ in range(_EXCHANGES):
        before = [*chosen]
        for _ in range(number):  # of the first, which goes to the end
            total = total - gram[chosen.pop(0)]
            chosen.append(best())
            total = total + gram[chosen[-1]]
        if sorted(before) == sorted(chosen):
            break
    return torch.tensor(sorted(chosen), device=gram.device)
