"""Posteriors whose variances and joint samples are right at any size of the targets."""

from __future__ import annotations

import math
from typing import Any

import torch
from botorch.posteriors import GPyTorchPosterior, Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal
from linear_operator import to_dense
from linear_operator.operators import (
    BlockDiagLinearOperator,
    DenseLinearOperator,
    TriangularLinearOperator,
)
from torch import Size, Tensor

_JITTER = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)  # of correlations


class PosteriorCovariance(DenseLinearOperator):
    """A covariance that is factorised as a correlation, so that its size makes no difference.

    GPyTorch adds an absolute jitter (1e-8) to what has no Cholesky factor, which joint posteriors
    of smooth functions do not have: larger than the variances themselves where these are small.
    Here the jitter is relative to each variance, which stays as it is.
    """

    def _cholesky(self, upper: bool = False) -> TriangularLinearOperator:
        root = correlation_root(self.tensor)
        return TriangularLinearOperator(root.mT if upper else root, upper=upper)


def correlation_root(covariance: Tensor) -> Tensor:
    """A lower triangular root of covariances ``... x q x q``, whose diagonals it keeps."""
    variance = covariance.diagonal(dim1=-1, dim2=-2)
    known = variance <= 0
    sd = variance.where(~known, torch.ones_like(variance)).sqrt()
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    identity = torch.eye(covariance.shape[-1], dtype=sd.dtype, device=sd.device)
    if known.any():
        pairs = known.unsqueeze(-1) | known.unsqueeze(-2)
        correlation = torch.where(pairs, identity, correlation)
    jitter = torch.full_like(sd[..., :1, None], _JITTER[0])
    for larger in (*_JITTER[1:], None):
        root, info = torch.linalg.cholesky_ex((correlation + jitter * identity) / (1 + jitter))
        if larger is None or not info.any():
            break
        jitter = torch.where((info > 0)[..., None, None], larger, jitter)
    return root * sd.masked_fill(known, 0.0).unsqueeze(-1)


class ScaleFreeNormal(MultivariateNormal):
    """GPyTorch's distribution, without its least variance (1e-10) and the warning of it."""

    @property
    def variance(self) -> Tensor:
        """The variances, in the shape of the mean."""
        variance = self.lazy_covariance_matrix.diagonal(dim1=-1, dim2=-2).clamp_min(0.0)
        return variance.reshape(variance.shape[:-1] + self._event_shape)


class ScaleFreeMultitaskNormal(MultitaskMultivariateNormal, ScaleFreeNormal):
    """The same of several outputs."""


class ScaleFreePosterior(GPyTorchPosterior):
    """A posterior whose variances and draws are right at any size."""

    @classmethod
    def of_outputs(cls, mean: Tensor, covariance: Tensor, has_outputs: bool) -> ScaleFreePosterior:
        """Return a posterior of independent outputs, of moments ``... x (m) x q (x q)``."""
        operator = PosteriorCovariance(covariance)
        if not has_outputs:
            return cls(ScaleFreeNormal(mean, operator))
        blocks = BlockDiagLinearOperator(operator, block_dim=-3)
        return cls(ScaleFreeMultitaskNormal(mean.mT, blocks, interleaved=False))

    @classmethod
    def transformed(cls, posterior: Posterior) -> Posterior:
        """The posterior that a posterior transform made, free of scale again."""
        if type(posterior) is not GPyTorchPosterior:
            return posterior
        old = posterior.distribution
        covariance = PosteriorCovariance(to_dense(old.lazy_covariance_matrix))
        if isinstance(old, MultitaskMultivariateNormal):
            return cls(ScaleFreeMultitaskNormal(old.mean, covariance, False, old._interleaved))
        return cls(ScaleFreeNormal(old.mean, covariance))


class HyperparameterMixture(GaussianMixturePosterior):
    """BoTorch's posterior of a fully Bayesian model, right at any size of the targets.

    To BoTorch its moments and draws are those of the components, ``batch_shape x S x q x m``;
    ``mixture_mean``, ``mixture_variance``, ``mixture_covariance_matrix`` and ``quantile`` are those
    of the mixture.

    Args:
        components: The posterior of a model that holds samples, with their dimension third from
            the right.
    """

    def __init__(self, components: GPyTorchPosterior) -> None:
        super().__init__(components.distribution)
        self.components = components

    @property
    def mixture_variance(self) -> Tensor:
        """The variance of the mixture, ``batch_shape x q x m``."""
        return mixture_moments(self._mean, self._variance)[1]

    @property
    def mixture_covariance_matrix(self) -> Tensor:
        """The covariance of the mixture, ``batch_shape x (m q) x (m q)``: output by output."""
        mean: Tensor = self.distribution.loc  # ... x S x (m q)
        deviation = mean - mean.mean(-2, keepdim=True)
        spread = deviation.mT @ deviation / mean.shape[-2]
        return self.distribution.covariance_matrix.mean(-3) + spread

    def quantile(self, value: Tensor) -> Tensor:
        """The mixture's quantiles at ``b`` levels or one, ``(b) x batch_shape x q x m``."""
        if value.numel() > 1:
            return torch.stack([self.quantile(level) for level in value])
        level = float(value)
        if not 0 < level < 1:
            raise ValueError(f"Expected levels of quantiles between 0 and 1, got {level:.3g}.")
        return mixture_quantile(self._mean, self._variance, level)


class MarginalMixture(HyperparameterMixture):
    """A mixture whose moments, densities and draws are those of the whole throughout.

    Shapes are ``batch_shape x q x m``, without the dimension of the components.
    """

    mean = HyperparameterMixture.mixture_mean
    variance = HyperparameterMixture.mixture_variance
    covariance_matrix = HyperparameterMixture.mixture_covariance_matrix

    def log_prob(self, value: Tensor) -> Tensor:
        """The joint log density of values at all points and outputs, ``... x q x m``: ``...``."""
        away = value.mT.flatten(-2).unsqueeze(-2) - self.distribution.loc  # ... x S x (m q)
        root = correlation_root(self.distribution.covariance_matrix)
        white = torch.linalg.solve_triangular(root, away.unsqueeze(-1), upper=False).squeeze(-1)
        log_size = root.diagonal(dim1=-1, dim2=-2).log() + 0.5 * math.log(2 * math.pi)
        each = -(0.5 * white.square() + log_size).sum(-1)
        return each.logsumexp(-1) - math.log(each.shape[-1])

    def entropy(self) -> Tensor:
        """Raise an error: that of a mixture has no closed form."""
        raise NotImplementedError(
            "The entropy of a mixture has no closed form; `mixed=False` has that of each sample."
        )

    def density(self, value: Tensor) -> Tensor:
        """The probability density at values ``b``, ``(b) x batch_shape x q x m``."""
        return self.components.density(value).mean(MCMC_DIM)

    def rsample(self, sample_shape: Size | None = None) -> Tensor:
        """Draws, ``sample_shape x batch_shape x q x m``, each from a component at random."""
        drawn = self.components.rsample(sample_shape)
        shape = (*drawn.shape[:MCMC_DIM], 1, 1, 1)
        which = torch.randint(drawn.shape[MCMC_DIM], shape, device=drawn.device)
        return _taken(drawn, which)

    def rsample_from_base_samples(self, sample_shape: Size, base_samples: Tensor) -> Tensor:
        """Draws for BoTorch's samplers, from one component after the other."""
        drawn = self.components.rsample_from_base_samples(sample_shape, base_samples)
        which = torch.arange(sample_shape.numel(), device=drawn.device) % drawn.shape[MCMC_DIM]
        return _taken(drawn, which.reshape(*sample_shape, *[1] * (drawn.dim() - len(sample_shape))))

    def _extended_shape(self, sample_shape: Size = Size()) -> Size:  # noqa: B008
        return sample_shape + self.mean.shape


def _taken(drawn: Tensor, which: Tensor) -> Tensor:
    """One component of each of the draws ``... x S x q x m``."""
    which = which.expand(*drawn.shape[:MCMC_DIM], 1, *drawn.shape[MCMC_DIM + 1 :])
    return drawn.gather(MCMC_DIM, which).squeeze(MCMC_DIM)


def mixture_moments(mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance ``... x q x m`` of mixtures of components ``... x S x q x m``."""
    if mean.shape[MCMC_DIM] == 1:
        return mean.squeeze(MCMC_DIM), variance.squeeze(MCMC_DIM)
    # Not as a difference of second moments, which cancels.
    spread = (mean - mean.mean(MCMC_DIM, keepdim=True)).square().mean(MCMC_DIM)
    return mean.mean(MCMC_DIM), variance.mean(MCMC_DIM) + spread


def mixture_quantile(mean: Tensor, variance: Tensor, level: float, link: Any = None) -> Tensor:
    """The quantile ``... x q x m`` of mixtures of Gaussians ``... x S x q x m``, by bisection.

    With a link it is that of values whose links are such mixtures.
    """
    sd = variance.sqrt()
    z = math.sqrt(2) * float(torch.erfinv(torch.tensor(2 * level - 1, dtype=torch.float64)))
    ends = mean + z * sd if link is None else link.inverse(mean + z * sd)
    low, high = ends.amin(MCMC_DIM), ends.amax(MCMC_DIM)
    for _ in range(60 if mean.shape[MCMC_DIM] > 1 else 0):
        middle = (low + high) / 2
        each = middle.unsqueeze(MCMC_DIM).expand_as(mean)
        each = each if link is None else link.value(each)
        below = torch.special.ndtr((each - mean) / sd).mean(MCMC_DIM) < level
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return (low + high) / 2
