"""Posteriors whose variances and joint samples are right however small they are."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from botorch.posteriors import GPyTorchPosterior, Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal
from gpytorch.settings import min_variance
from linear_operator import to_dense
from linear_operator.operators import (
    BlockDiagLinearOperator,
    DenseLinearOperator,
    LinearOperator,
    TriangularLinearOperator,
)
from torch import Tensor

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


class ScaleFreePosterior(GPyTorchPosterior):
    """A posterior whose variances have no absolute minimum, as GPyTorch's have (1e-10)."""

    @property
    def variance(self) -> Tensor:
        """The posterior variance, ``batch_shape x q x m``."""
        return _variance(self.distribution)

    @classmethod
    def of_outputs(cls, mean: Tensor, covariance: Tensor, has_outputs: bool) -> ScaleFreePosterior:
        """Of independent outputs: moments ``... x (m) x q`` and ``... x (m) x q x q``."""
        operator = PosteriorCovariance(covariance)
        if not has_outputs:
            return cls(MultivariateNormal(mean, operator))
        blocks = BlockDiagLinearOperator(operator, block_dim=-3)
        return cls(MultitaskMultivariateNormal(mean.mT, blocks, interleaved=False))

    @classmethod
    def transformed(cls, posterior: Posterior) -> Posterior:
        """What a posterior transform made, free of scale again."""
        if type(posterior) is not GPyTorchPosterior:
            return posterior
        old = posterior.distribution
        if isinstance(old, MultitaskMultivariateNormal):
            return cls(old)
        covariance = PosteriorCovariance(to_dense(old.lazy_covariance_matrix))
        return cls(MultivariateNormal(old.mean, covariance))


class HyperparameterMixture(GaussianMixturePosterior):
    """BoTorch's posterior of a fully Bayesian model, with variances right however small.

    Its moments are those of the components, ``batch_shape x S x q x m``; ``mixture_mean``,
    ``mixture_variance`` and ``quantile`` are those of the mixture, ``batch_shape x q x m``.

    Args:
        components: The posterior of a model that holds samples, with their dimension third from
            the right.
    """

    def __init__(self, components: GPyTorchPosterior) -> None:
        with min_variance(double_value=0.0):
            super().__init__(components.distribution)
        self._variance = components.variance

    @property
    def mixture_variance(self) -> Tensor:
        """The variance of the mixture, ``batch_shape x q x m``."""
        return mixture_moments(self._mean, self._variance)[1]


def mixture_moments(mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance ``... x q x m`` of mixtures of components ``... x S x q x m``."""
    # Not as a difference of second moments, which cancels.
    spread = (mean - mean.mean(MCMC_DIM, keepdim=True)).square().mean(MCMC_DIM)
    return mean.mean(MCMC_DIM), variance.mean(MCMC_DIM) + spread


def mixture_quantile(mean: Tensor, variance: Tensor, level: float) -> Tensor:
    """The quantile ``... x q x m`` of mixtures of Gaussians ``... x S x q x m``, by bisection."""
    sd = variance.sqrt()
    z = math.sqrt(2) * float(torch.erfinv(torch.tensor(2 * level - 1, dtype=torch.float64)))
    low, high = (mean + z * sd).amin(MCMC_DIM), (mean + z * sd).amax(MCMC_DIM)
    for _ in range(60 if mean.shape[MCMC_DIM] > 1 else 0):
        middle = (low + high) / 2
        below = torch.special.ndtr((middle.unsqueeze(MCMC_DIM) - mean) / sd).mean(MCMC_DIM) < level
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return (low + high) / 2


def mixture_interval(
    components: Callable[[], tuple[Tensor, Tensor]], level: float
) -> tuple[Tensor, Tensor]:
    """Lower and upper ends of the central intervals of mixtures, ``... x q x m`` each."""
    if not isinstance(level, float) or not 0 < level < 1:
        raise ValueError(f"Expected level as a number between 0 and 1, got {level!r}.")
    parts = components()
    return mixture_quantile(*parts, (1 - level) / 2), mixture_quantile(*parts, (1 + level) / 2)


def _variance(distribution: MultivariateNormal) -> Tensor:
    covariance: LinearOperator = distribution.lazy_covariance_matrix
    variance = covariance.diagonal(dim1=-1, dim2=-2).clamp_min(0.0)
    if not isinstance(distribution, MultitaskMultivariateNormal):
        return variance.unsqueeze(-1)
    q, m = distribution.event_shape
    if distribution._interleaved:
        return variance.unflatten(-1, (q, m))
    return variance.unflatten(-1, (m, q)).mT
