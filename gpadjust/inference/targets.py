"""Functions of vectors of a model's parameters, which fits minimise or sample."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, Self

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from torch import Tensor

from gpadjust.gp.gaussian import (
    LikelihoodValue,
    Trend,
    cholesky,
    least_squares,
    negative_log_likelihood,
    nugget,
)
from gpadjust.gp.noise import Noise
from gpadjust.inference.distributions import (
    ByModules,
    MarginalizedParameters,
    StationaryTerms,
    stationary_terms,
)
from gpadjust.inference.priors import LogPriors
from gpadjust.inference.vectors import Parameters
from gpadjust.models import TermsGP
from gpadjust.physics import PhysicsError

_LEAST = 3  # observations, for a constant to be vague
_FEW_INPUTS = 3  # up to which a linear trend is, too
_FEWER_INPUTS = 2  # up to which a quadratic one is in part
_QUADRATIC = 0.75  # of the cost of its size, which does not count
_AT_ONCE = 2**18  # numbers in the covariances of a batch; larger ones make memory the bottleneck
_FAR = 300.0  # from zero, of a logarithm
_VAGUE = 1e4  # the prior variance of an unknown constant mean, in squared standard errors


class Target:
    r"""The negative log marginal likelihood, less registered log priors, of hyper-parameters.

    .. math:: \tfrac12 (y - m)^T K^{-1} (y - m) + \tfrac12 \log|K| + \tfrac n2 \log 2\pi

    It takes a model as it is, with unknown constants integrated over their priors. It is evaluated
    at ``k`` vectors of all ``B`` problems in one batch
    (:class:`~gpadjust.inference.vectors.Parameters`); where outputs share parameters, one vector
    after the other.

    Args:
        model: The model; it is put in train mode.
        rows: The observations that count, numbers of rows. Default: all.
        marginalized: What unknown parameters of the physics add to mean and covariance, if they
            are integrated out.

    Attributes:
        parameters: The vectors and their bounds.
        targets: The observations, ``... x n``, and ``num_points`` their number ``n``.
        distribution: Theirs.
        concentrated: Whether the overall scale of all variances is at its optimum.
    """

    random_means: ClassVar[bool] = True
    of_logs: ClassVar[bool] = False

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        rows: Tensor | None = None,
        marginalized: MarginalizedParameters | None = None,
    ) -> None:
        model.train()
        self.model, self.parameters = model, Parameters(model)
        kept = slice(None) if rows is None else rows
        self.targets = model.train_targets[..., kept]
        self.num_points = self.targets.shape[-1]
        self._of_all, self._added = marginalized, self.targets.new_zeros(())
        if marginalized is not None:
            self.targets = self.targets - marginalized.mean[..., kept]
            self._added = marginalized.covariance[..., kept, :][..., kept]
        with torch.no_grad():
            inputs = model.transform_inputs(model.train_inputs[0])[..., kept, :]
        self._raw_inputs = model.train_inputs[0][..., kept, :]
        noise = Noise(model.likelihood).known
        noise = None if noise is None else Noise(model.likelihood).of_rows(noise)[..., kept]
        inputs = self._raw_inputs if self.parameters.learns_inputs else inputs
        args = (model, self.parameters, inputs, noise, self.random_means, kept)
        found = stationary_terms(*args) if self.parameters.is_batched else None
        self.distribution: StationaryTerms | ByModules = found or ByModules(*args)
        vague = self.of_logs and marginalized is None
        self._trend = _trends(model, self._raw_inputs, self.targets) if vague else None
        self._log_priors: LogPriors | None = None
        if self.of_logs or next(iter(model.named_priors()), None) is not None:
            self._log_priors = LogPriors(model, self.parameters, self.of_logs)
        # Targets that are met exactly would have no variance at all: their rounding errors have.
        square = self.targets.square().nanmean(-1)
        square = square.where(square > 0, torch.ones_like(square))
        self._rounding = torch.finfo(square.dtype).eps ** 2 * square
        self.concentrated = False

    def of_rows(self, rows: Tensor) -> Self:
        """The same of some of the observations, numbers of rows."""
        return type(self)(self.model, rows, self._of_all)

    @torch.no_grad()
    def assign(self, vector: Tensor) -> None:
        """Give the model a vector, ``B x p``, at its best scale, and its constant means."""
        if self.concentrated:
            vector = self.at_best_scale(vector.unsqueeze(0))[0][0]
        self.parameters.assign(vector)
        values = {n: v[0] for n, v in self.parameters.unflatten(vector.unsqueeze(0)).items()}
        mean, covariance, basis, *_ = self.distribution(values)
        if basis is None:
            return
        covariance = covariance + self._added
        shift, vague = _constant_means(self.targets - mean, covariance, basis)
        terms = [term for term in self.model.covar_module.terms if term.learns_mean]
        for i, term in enumerate(terms):
            term.mean.add_(shift[..., i : i + 1])
            term.mean_variance.copy_(vague[..., i : i + 1])

    def __call__(self, vectors: Tensor) -> Tensor:
        """The value at ``vectors`` (``k x B x p``), ``k x B``.

        It is infinite where the covariance has no Cholesky factor.
        """
        return self._in_chunks(lambda part: self._evaluate(part, derivatives=False), vectors)[0]

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """The value and its gradient, ``k x B`` and ``k x B x p``.

        The gradient is zero where the value is infinite.
        """
        return self._in_chunks(lambda part: self._evaluate(part, derivatives=True), vectors)

    def log_likelihood(self, vectors: Tensor) -> Tensor:
        """The log likelihood at ``vectors`` (``k x B x p``) without priors, ``k x B``."""
        log_prior = 0.0 if self._log_priors is None else self._log_priors(vectors)[0]
        return -self(vectors) - log_prior

    @torch.no_grad()
    def at_best_scale(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        r"""Multiply all variances by the factor that maximises the likelihood.

        With :math:`c K` in place of :math:`K` it is :math:`(y - m)^T K^{-1} (y - m) / n`, or what
        brings the noise to its bound.

        Args:
            vectors: ``k x B x p``.

        Returns:
            The vectors, moved into the bounds, and the value there, ``k x B``.
        """
        if not self.parameters.is_batched:
            return vectors, self(vectors)

        def likelihood(part: Tensor) -> tuple[Tensor, Tensor]:
            found, _ = self._likelihood(part, self._least_scale(part), derivatives=False)
            return found.value.reshape(len(part), -1), found.scale.reshape(len(part), -1)

        values, scale = self._in_chunks(likelihood, vectors)
        usable = scale.isfinite() & (scale > 0)
        shift = scale.where(usable, torch.ones_like(scale)).log().unsqueeze(-1)
        moved = self.parameters.clipped(vectors + self.parameters.variances * shift)
        return moved, values if self.concentrated else self(moved)

    def _in_chunks(
        self, function: Callable[[Tensor], tuple[Tensor, Tensor]], vectors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Evaluate a function of vectors in parts that fit in memory.

        Where problems share parameters, as the physics learns, it is one vector after the other.
        """
        size = self.parameters.num_problems * self.targets.shape[-1] ** 2
        at_once = max(1, _AT_ONCE // size) if self.parameters.is_batched else 1
        first, second = zip(*(function(part) for part in vectors.split(at_once)), strict=True)
        return torch.cat(first), torch.cat(second)

    @torch.no_grad()
    def _evaluate(self, vectors: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
        """The value and its gradient (zero if not asked for)."""
        least = self._least_scale(vectors) if self.concentrated else None
        try:
            found, gradient = self._likelihood(vectors, least, derivatives)
        except PhysicsError:
            # Parameters that the physics cannot run with are a bad vector, not the end of a fit.
            return vectors.new_full(vectors.shape[:-1], math.inf), torch.zeros_like(vectors)
        # Outputs that share parameters are independent given these.
        value = found.value.reshape(*vectors.shape[:-1], -1).sum(-1)
        if found.by_least_scale is not None:
            # The least scale is that of the least noise, in inverse proportion to the noise.
            by_least = found.by_least_scale.reshape(*value.shape, 1)
            gradient = gradient - self.parameters.noise * by_least
        if self._log_priors is not None:
            log_prior, by_prior = self._log_priors(vectors)
            value, gradient = value - log_prior, gradient - by_prior
        # NaN and minus infinity are what only failures give.
        value = value.nan_to_num(math.inf, math.inf, math.inf)
        good = (value.isfinite() & gradient.isfinite().all(-1)).unsqueeze(-1)
        return value, torch.where(good, gradient, torch.zeros_like(gradient))

    def _likelihood(
        self, vectors: Tensor, least: Tensor | None, derivatives: bool
    ) -> tuple[LikelihoodValue, Tensor]:
        """The likelihood, and its gradient at a fixed scale (zero if not asked for)."""
        values = self.parameters.unflatten(vectors)
        if not self.parameters.is_batched:
            values = {name: value[0] for name, value in values.items()}
        mean, covariance, basis, pull_back = self.distribution(values, derivatives)
        covariance = covariance if self._of_all is None else covariance + self._added
        residual = (self.targets - mean).expand(covariance.shape[:-1])
        found = negative_log_likelihood(
            residual, covariance, basis, least, derivatives, self._trend
        )
        if pull_back is None:
            return found, torch.zeros_like(vectors)
        return found, self.parameters.flatten(pull_back(found))

    def _least_scale(self, vectors: Tensor) -> Tensor:
        """The factor of all variances that brings the noise to its bound, ``k x batch_shape``."""
        least = ((self.parameters.lower - vectors).exp() * self.parameters.noise).sum(-1)
        least = least.maximum(self._rounding.reshape(-1))
        return least.reshape(len(vectors), *self.parameters.batch_shape)


class LogLikelihood(Target):
    """The negative log likelihood that ``"map"`` brings to its minimum.

    Unknown constants are at their generalised least squares estimate. Where all variances are
    learnt without priors, their overall scale is *concentrated* out: it is at its optimum, in
    closed form, as far as the noise keeps to its least value. The arguments are those of
    :class:`Target`.
    """

    random_means = False

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.concentrated = self._is_homogeneous()

    @torch.no_grad()
    def _is_homogeneous(self) -> bool:
        """True if a factor of all variances scales the covariance, and no prior depends on it."""
        parameters = self.parameters
        one_noise = bool((parameters.noise.sum(-1) == 1).all())
        alone = self._log_priors is None and self._of_all is None
        if not (parameters.is_batched and one_noise and alone):
            return False
        vector = parameters.current()
        one = self.distribution(parameters.unflatten(vector))
        two = self.distribution(parameters.unflatten(vector + parameters.variances * math.log(2)))
        off = (two.covariance - 2 * one.covariance).abs().amax((-1, -2))
        close = bool((off <= 1e-9 * one.covariance.abs().amax((-1, -2))).all())
        return close and torch.allclose(two.mean, one.mean, rtol=1e-9, atol=1e-12)


class LogPosterior(Target):
    """The negative log posterior density of vectors, which is what full Bayes samples.

    Priors are densities of the logarithms of lengthscales and variances, and the model is at its
    own scale. All sizes of a constant and a linear trend in the observations cost the same, as far
    as there are enough of them: a factor of the prior, such that the size of a trend says nothing
    of how smooth a function is. A model is else the less likely, the larger the functions that its
    prior allows beside the one that is seen, which speaks against all that are nearly polynomial.
    Where a physics has unknown parameters, a trend is what these explain, and not vague. The
    arguments are those of :class:`Target`.
    """

    of_logs = True

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._is_log = self.parameters.mask(lambda row: row.is_log).bool()

    def _evaluate(self, vectors: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
        # Moves that fail go far: numbers of these logarithms would be zero, or infinite.
        near = vectors.clamp(-_FAR, _FAR).where(self._is_log, vectors)
        value, gradient = super()._evaluate(near, derivatives)
        allowed = self.parameters.is_allowed(vectors) & (near == vectors).all(-1)
        return value.where(allowed, math.inf), gradient


def _constant_means(residual: Tensor, covariance: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Generalised least squares of unknown constant means, and vague prior variances around them.

    Args:
        residual: Targets less the rest of their mean, ``... x n``; NaN where there is none.
        covariance: Their covariance, ``... x n x n``; it is overwritten.
        basis: The bases of the means, ``... x n x q``.
    """
    observed = ~residual.isnan()
    chol, _ = cholesky(covariance, None if observed.all() else observed)
    basis = (basis * observed.unsqueeze(-1)).expand(*chol.shape[:-1], -1)
    means, errors = least_squares(chol, residual.nan_to_num(nan=0.0), basis)
    vague = _VAGUE * errors.diagonal(dim1=-1, dim2=-2)
    # A wider prior would drown the smallest pivot in rounding errors.
    pivot = chol.diagonal(dim1=-1, dim2=-2).amin(-1, keepdim=True).square()
    size = basis.square().amax(-2).clamp_min(torch.finfo(chol.dtype).tiny)
    return means, vague.minimum(pivot / (nugget(chol.shape[-1]) * size))


def _trends(
    model: BatchedMultiOutputGPyTorchModel, inputs: Tensor, targets: Tensor
) -> Trend | None:
    """The trends of all groups of observations that have their own, or None."""
    if not isinstance(model, TermsGP):
        return _trend(inputs, targets)
    inputs, groups = model.trend_inputs(inputs)
    each = [
        _trend(inputs, targets.where(rows > 0, math.nan))
        for rows in groups.expand(*targets.shape, -1).unbind(-1)
    ]
    found = [trend for trend in each if trend is not None]
    if not found:
        return None
    return Trend(*(torch.cat(parts, dim=-1) for parts in zip(*found, strict=True)))


def _trend(inputs: Tensor, targets: Tensor) -> Trend | None:
    """A constant and, of few inputs, a linear and a quadratic trend, orthogonal; or None."""
    observed = (~targets.isnan()).unsqueeze(-1)
    n, d = int(observed.sum(-2).min()), inputs.shape[-1]
    if n < _LEAST:
        return None
    one = observed.to(inputs)
    if d > _FEW_INPUTS or n < 2 * (d + 1):
        return Trend(one, torch.ones(1).to(inputs))
    count = one.sum(-2, keepdim=True)
    away = (inputs - (inputs * one).sum(-2, keepdim=True) / count) * one
    spread = (away.square().sum(-2, keepdim=True) / count).sqrt()
    rounding = 8 * n * torch.finfo(inputs.dtype).eps * inputs.abs().amax(-2, keepdim=True)
    away = torch.where(spread > rounding, away / spread, torch.zeros_like(away))
    linear = torch.cat([one / count.sqrt(), _span(away)], dim=-1)
    columns, num_linear = linear, linear.shape[-1]
    if d <= _FEWER_INPUTS and n >= (d + 1) * (d + 2):  # twice the number of the coefficients
        i, j = torch.triu_indices(num_linear - 1, num_linear - 1) + 1
        squares = linear[..., i] * linear[..., j] * count
        columns = torch.cat([linear, _span(squares - linear @ (linear.mT @ squares))], dim=-1)
    shares = torch.full_like(columns[(0,) * (columns.dim() - 1)], _QUADRATIC)
    shares[:num_linear] = 1.0
    return Trend(columns * math.sqrt(n), shares)


def _span(columns: Tensor) -> Tensor:
    """An orthonormal basis of what columns ``... x n x q`` span; of all of a batch as many."""
    directions, sizes, _ = torch.linalg.svd(columns, full_matrices=False)
    # Inputs that do not vary, or only together, have no slopes of their own.
    rank = int((sizes > 1e-6 * math.sqrt(columns.shape[-2])).sum(-1).amin())
    return directions[..., :rank]
