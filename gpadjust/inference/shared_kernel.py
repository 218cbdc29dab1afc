"""Fitting the one kernel of many outputs."""

from __future__ import annotations

import time
import warnings
from copy import deepcopy
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.gp.gaussian import LikelihoodValue, cholesky, nugget
from gpadjust.inference import annealing
from gpadjust.inference.bayes import SampleResult, SamplingWarning, default_num_samples
from gpadjust.inference.optimise import MANY, FitResult, Search, optima, optimise
from gpadjust.inference.priors import LogPriors, register_priors
from gpadjust.inference.proposals import Both, Normal, around_optima
from gpadjust.inference.targets import LogPosterior
from gpadjust.models.parallel_partial import DEGREES, ParallelPartialGP, effective_number

_TOLD = 32  # outputs, evenly spaced, that the kernel is fitted by
_LEAST_HELD = 8  # samples, for the distribution of an output's variance
_STARTS = (8, 128)  # of the search, and how many are screened for them
_DRAWS = 512  # that the sampling begins with
_PARTICLES = 32
_GRADIENTS = 100  # of each particle, at most
_LEAST_POWER = 0.3  # of the way to the posterior, for draws that show it


class _Outputs(NamedTuple):
    """Data of the outputs that the kernel is fitted by.

    Attributes:
        residuals: ``n x M``.
        columns: With unknown constants, ``M x n x k``.
        precision: That of their prior, ``M x k``.
        weight: How much each output counts: neighbours on a smooth curve tell the same.
    """

    residuals: Tensor
    columns: Tensor
    precision: Tensor
    weight: float

    @classmethod
    def of(cls, model: ParallelPartialGP) -> _Outputs:
        """Those of a model, with the effective number of its outputs."""
        m = model.num_outputs
        rows = torch.linspace(0, m - 1, min(m, _TOLD)).round().long()
        each = model.residuals / model.residuals.square().mean(0).sqrt().clamp_min(1e-300)
        columns, precision = model.columns[rows], model.precision[rows]
        return cls(each[:, rows], columns, precision, effective_number(each) / len(rows))

    def of_rows(self, rows: Tensor) -> _Outputs:
        """The same of some rows of the data."""
        return self._replace(residuals=self.residuals[rows], columns=self.columns[:, rows])


class SharedPosterior(LogPosterior):
    r"""The negative log posterior density of the kernel of many outputs.

    With its variance and constants integrated out, an output has a multivariate t density,

    .. math:: -\log p_j = (a + \tfrac n2) \log(a + \tfrac12 S_j) + \tfrac12 \log|K| + \dots

    of the cost :math:`S_j = r_j^T P_j r_j` of its residuals, with a = 1. The sum over outputs has
    the weight of their effective number, the participation ratio of their covariance.

    Args:
        model: The model of the kernel, with ``outputs``.
        rows: As of :class:`Target`.
    """

    def __init__(self, model: Any, rows: Tensor | None = None, *args: Any) -> None:
        super().__init__(model, rows, *args)
        every: _Outputs = model.outputs
        self.outputs = every if rows is None else every.of_rows(rows)

    def _likelihood(
        self, vectors: Tensor, least: Tensor | None, derivatives: bool
    ) -> tuple[LikelihoodValue, Tensor]:
        values = self.parameters.unflatten(vectors)
        _, covariance, _, pull_back, _ = self.distribution(values, derivatives)
        found = self._of_outputs(covariance, least, derivatives)
        if pull_back is None:
            return found, torch.zeros_like(vectors)
        return found, self.parameters.flatten(pull_back(found))

    def _of_outputs(
        self, covariance: Tensor, least: Tensor | None, derivatives: bool
    ) -> LikelihoodValue:
        """Value and derivative by the covariance, ``k x n x n``, which is overwritten."""
        residuals, columns, precision, weight = self.outputs
        (n, m), k = residuals.shape, precision.shape[-1]
        chol, failed = cholesky(covariance)
        white = torch.linalg.solve_triangular(chol, residuals, upper=False)  # K x n x M
        own = torch.linalg.solve_triangular(chol, columns.movedim(0, 1).reshape(n, -1), upper=False)
        own = own.unflatten(-1, (m, k)).movedim(-2, -3)  # K x M x n x k
        gram = own.mT @ own + torch.diag_embed(precision)
        spread = torch.linalg.inv(gram)
        found = spread @ (own.mT @ white.mT.unsqueeze(-1))  # K x M x k x 1
        white = white - (own @ found).squeeze(-1).mT
        square = white.square().sum(-2) + (precision * found.squeeze(-1).square()).sum(-1)
        log_det = 2 * chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
        if self._trend is not None:
            columns_of_trend = self._trend.columns.expand(*chol.shape[:-1], -1)
            across = torch.linalg.solve_triangular(chol, columns_of_trend, upper=False)
            across, triangle = torch.linalg.qr(across)
            log_size = triangle.diagonal(dim1=-1, dim2=-2).abs().log()
            log_det = log_det + 2 * (self._trend.shares * log_size).sum(-1)
        power, rate = 0.5 * (DEGREES + n), 0.5 * (DEGREES + square)
        log_gram = torch.linalg.slogdet(gram).logabsdet - precision.log().sum(-1)
        value = weight * (power * rate.log() + 0.5 * (log_det.unsqueeze(-1) + log_gram)).sum(-1)
        failed = failed | ~value.isfinite()
        value, scale = value.masked_fill(failed, torch.inf), square.mean(-1) / n
        scale = scale if least is None else scale.maximum(least)
        if not derivatives:
            return LikelihoodValue(value, scale)
        alpha = torch.linalg.solve_triangular(chol.mT, white, upper=True)  # K x n x M
        by = m * torch.cholesky_inverse(chol) - (alpha * (power / rate).unsqueeze(-2)) @ alpha.mT
        if k:
            own = torch.linalg.solve_triangular(chol.mT.unsqueeze(-3), own, upper=True)
            by = by - (own @ spread @ own.mT).sum(-3)
        if self._trend is not None:
            across = torch.linalg.solve_triangular(chol.mT, across, upper=True)
            by = by - m * (self._trend.shares * across) @ across.mT
        by = 0.5 * weight * by
        by.diagonal(dim1=-1, dim2=-2).mul_(1 + nugget(n))  # as the nugget is a share of it
        return LikelihoodValue(value, scale, by_covariance=by)


def fit_shared(
    model: ParallelPartialGP,
    search: Search,
    sampled: bool = True,
    num_samples: int | None = None,
    num_draws: int | None = None,
) -> FitResult | SampleResult:
    """Fit the kernel of a :class:`~gpadjust.ParallelPartialGP`, see :func:`~gpadjust.fit`.

    Its posterior is sampled, or brought to its maximum; the model then has variances of its outputs
    for each sample.
    """
    begin = time.perf_counter()
    shared = deepcopy(model.shared)
    shared.release_samples()
    shared.outputs = _Outputs.of(model)
    register_priors(shared)
    target, generator = SharedPosterior(shared), torch.Generator().manual_seed(search.seed)
    parameters, n = target.parameters, target.num_points
    if not sampled:
        centers, values = optima(target, search)
        best = centers[values.argmin(0), 0].unsqueeze(0)
        vector, value, done = optimise(target, best, search.max_iterations)
        model.hold(parameters.to_raw(parameters.unflatten(vector)), generator)
        return FitResult(-value[0, 0], done[0, 0])
    around, _ = around_optima(target, search, _STARTS)
    proposal: Any = around
    if n <= MANY:
        prior = LogPriors(shared, parameters, of_logs=True)
        proposal = Both(Normal(*prior.moments()), around)
    number = num_draws or _DRAWS
    number += number % 2
    gradients = _GRADIENTS * _PARTICLES if n <= MANY else 0
    found = annealing.sample(target, proposal, number, _PARTICLES, gradients, generator)
    held = num_samples or max(default_num_samples(n), _LEAST_HELD)
    rows = torch.linspace(0, len(found.positions) - 1, held).round().long()
    samples = parameters.to_raw(parameters.unflatten(found.positions[rows]))
    model.hold(samples, generator)
    raw = parameters.to_raw(parameters.unflatten(found.positions))
    draws = {r.name.replace("raw_", ""): r.parameter(raw[r.name]) for r in parameters.rows}
    size, good = found.effective_size()[0], found.power[0] >= _LEAST_POWER
    if not good:
        warnings.warn(
            f"The draws of the shared kernel do not show the posterior (effective sample size "
            f"{size:.2g}). Raise num_draws, or give narrower priors.",
            SamplingWarning,
            stacklevel=4,
        )
    seconds = time.perf_counter() - begin
    return SampleResult(size, good, draws, num_samples=held, seconds=seconds)
