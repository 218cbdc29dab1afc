"""Noise with heavy tails: each observation may be an outlier."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.gp.noise import RowNoise, RowSource

SHARE = 0.02
"""Prior probability of an outlier."""
_SIZES = math.log(1e3)  # range of the logarithm of an outlier's standard deviation
_NEAR = 3.0  # standard deviations, nearer than which outliers are no more likely than there
_SUSPECT = 0.9  # of the largest of n standard normal numbers, for a row to be tried
_PATIENCE = 3  # sets of outliers that are tried after the best one
_MOST = 1 / 3  # of the observations are outliers
_FAR = 1e4  # times its squared residual is the variance of an outlier in a fit


class HeavyTails(RowSource):
    r"""Outliers among the observations: their noise is larger by any factor.

    An observation is an outlier with the probability :math:`\pi = 0.02`; the logarithm of the
    standard deviation of its error is then uniform over three decades, which makes the density of
    a residual r from what the others say :math:`1 / (2 |r| \log 10^3)`. Which rows are, is searched
    greedily, as in relevance pursuit (Ament et al. 2024): the rows with the largest left-out
    residuals are taken out, hyper-parameters fitted again, and of all sets so found the likeliest
    is kept. After a fit those of its outliers are taken in again that are likelier none.
    """

    has_outliers = True

    def __init__(self) -> None:
        self._tried: list[tuple[Tensor, Tensor]] = []  # log densities, and masks of the outliers

    @torch.no_grad()
    def refine(self, model: Any, rows: RowNoise) -> bool:
        """Try other outliers; in the end, take the likeliest of all that were tried."""
        found, n = _LeftOut.of(model), model.train_targets.shape[-1]
        outlying, odds = rows.outlying, found.log_odds()
        exchanged = (found.tails() - found.density_in_fit) * outlying
        self._tried.append((model.log_evidence()[1] + exchanged.sum(-1), outlying))
        values, sets = (torch.stack(each) for each in zip(*self._tried, strict=True))
        best = values.argmax(0)
        z = (found.residual.abs() / found.variance.sqrt()).masked_fill(outlying, 0.0)
        suspect = z > _SUSPECT * math.sqrt(2 * math.log(n))
        number = (
            1 + ((odds > 0) & suspect).sum(-1, keepdim=True) // 4
        )  # neighbours of one may seem so
        first = z.argsort(-1, descending=True).argsort(-1) < number
        following = (outlying & (odds > 0)) | (suspect & first)
        again = (sets == following).all(-1).any(0)
        many = following.sum(-1) > _MOST * n
        done = again | many | (len(values) - best > _PATIENCE)
        if done.all():
            chosen = sets.gather(0, best[None, ..., None].expand(1, *sets.shape[1:]))[0]
        else:
            chosen = torch.where(done.unsqueeze(-1), outlying, following)
        # Not a multiple of the noise, which the likelihood would make small for their sake.
        rows.errors = chosen * _FAR * (found.residual.square() + found.noise)
        return not bool(done.all())

    @torch.no_grad()
    def confirm(self, model: Any, rows: RowNoise) -> bool:
        """Take rows in again that are likelier no outliers, by all samples."""
        wrong = rows.outlying & (probabilities(model) < 0.5)
        rows.errors = rows.errors.masked_fill(wrong, 0.0)
        return bool(wrong.any())


class _LeftOut(NamedTuple):
    """Training targets less their predictions by all others, ``(S) x (m) x n``.

    Attributes:
        residual: The differences; zero where there is no target.
        variance: Their variances, if they are no outliers.
        noise: The part of the noise in these.
        density_in_fit: Their log densities with the noise that rows have in the fit.
        is_mixture: Whether there are several samples.
    """

    residual: Tensor
    variance: Tensor
    noise: Tensor
    density_in_fit: Tensor
    is_mixture: bool

    @classmethod
    def of(cls, model: Any) -> _LeftOut:
        mean, variance = model.left_out()
        variance = variance.nan_to_num(nan=1.0)
        residual = (model.train_targets - mean).nan_to_num(nan=0.0)
        noise = model.noise.at(model.train_inputs[0]).expand(mean.shape)
        in_fit = variance + model.noise.of_rows(noise) - noise
        return cls(
            residual, variance, noise, _normal(residual, in_fit), model.num_samples is not None
        )

    def tails(self) -> Tensor:
        """Log densities of the residuals of outliers, with their share."""
        return _tails(self.residual, self.variance)

    def log_odds(self) -> Tensor:
        """Logarithms of the odds of being an outlier, ``(m) x n``; of samples, by their mixture."""
        normal, tails = _normal(self.residual, self.variance) + math.log1p(-SHARE), self.tails()
        if self.is_mixture:
            normal, tails = normal.logsumexp(0), tails.logsumexp(0)
        return tails - normal


def _normal(residual: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (residual.square() / variance + (2 * math.pi * variance).log())


def _tails(residual: Tensor, variance: Tensor) -> Tensor:
    far = residual.abs().maximum(_NEAR * variance.sqrt())
    return math.log(SHARE) - (2 * _SIZES * far).log()


def with_tails(log_density: Tensor, residual: Tensor, variance: Tensor) -> Tensor:
    """Log densities of observations of which each may be an outlier, of those if none is."""
    return torch.logaddexp(log_density + math.log1p(-SHARE), _tails(residual, variance))


@torch.no_grad()
def probabilities(model: Any) -> Tensor:
    """The probability of each training target to be an outlier, given all others, ``(m) x n``.

    Of a model that holds samples, by the mixture of what they predict. The model is in eval mode.
    """
    return _LeftOut.of(model).log_odds().sigmoid()
