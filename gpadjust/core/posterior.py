"""The posterior of a model that holds draws: a mixture of Gaussians, as BoTorch wants it."""

from __future__ import annotations

import torch
from botorch.posteriors.gpytorch import GPyTorchPosterior
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal
from linear_operator import to_linear_operator
from torch import Size, Tensor

from gpadjust.core.gaussian import Marginals


def correlation_root(K: Tensor) -> Tensor:
    """Return a lower root of covariances, with a jitter relative to each variance."""
    # K = D R D, and R = L L^T: D L is the root.
    sd = K.diagonal(dim1=-1, dim2=-2).clamp_min(1e-300).sqrt()
    R = K / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    eye = torch.eye(K.shape[-1]).to(K)
    for jitter in (1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0):
        root, info = torch.linalg.cholesky_ex((R + jitter * eye) / (1 + jitter))
        if not info.any():
            break
    return root * sd.unsqueeze(-1)


class _Normal(MultivariateNormal):
    """GPyTorch's distribution, with variances below its least one, too."""

    @property
    def variance(self) -> Tensor:
        """The variances."""
        return self.lazy_covariance_matrix.diagonal(dim1=-1, dim2=-2)


class _MultitaskNormal(MultitaskMultivariateNormal, _Normal):
    """The same of several outputs."""


class MixturePosterior(GPyTorchPosterior):
    """A mixture of ``S`` equally likely Gaussians, each of independent outputs.

    Their means are ``... x S x m x q``, their covariances ``... x S x m x q x q``. To BoTorch it is
    one posterior over ``... x q x m``, without a dimension for the draws. A sample is exactly of
    one component, which one further base sample picks. The Gaussian ``distribution`` has the joint
    mean and covariance.
    """

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        shape = torch.broadcast_shapes(mean.shape, covariance.shape[:-1])
        mean, covariance = mean.expand(shape), covariance.expand(*shape, shape[-1])
        self.gaussians = (mean, covariance)
        # The mean of the covariances, and the covariance of the means.
        center = mean.mean(-3)
        away = (mean - center.unsqueeze(-3)).flatten(-2)  # ... x S x m q
        between = away.mT @ away / away.shape[-2]
        # Blocks of the outputs, ... x m x q x m x q, on the diagonal of ... x m q x m q.
        K = torch.diag_embed(covariance.mean(-4).movedim(-3, -1), dim1=-4, dim2=-2)
        # Without a factor until one is read.
        lazy = to_linear_operator(K.flatten(-2).flatten(-3, -2) + between)
        if center.shape[-2] == 1:
            super().__init__(_Normal(center.squeeze(-2), lazy))
        else:
            super().__init__(_MultitaskNormal(center.mT, lazy, interleaved=False))

    @property
    def base_sample_shape(self) -> Size:
        """``... x q m``, and of several components one more, which picks the component."""
        mean, _ = self.gaussians
        S, m, q = mean.shape[-3:]
        size = q * m
        if S > 1:
            size += 1
        return Size([*mean.shape[:-3], size])

    @property
    def marginals(self) -> Marginals:
        """The mixtures at each point by itself."""
        mean, K = self.gaussians
        return Marginals(mean.mT, K.diagonal(dim1=-1, dim2=-2).mT)

    @property
    def variance(self) -> Tensor:
        """The variances, ``... x q x m``, without a lower bound."""
        return self.marginals.prediction.variance

    @property
    def covariance_matrix(self) -> Tensor:
        """The covariances of the points, and outputs if there are several, of the mixture."""
        return self.distribution.covariance_matrix

    @property
    def batch_range(self) -> tuple[int, int]:
        """The batch dimensions of base samples."""
        return 0, -1

    def rsample(self, sample_shape: Size | None = None) -> Tensor:
        """Return samples ``sample_shape x ... x q x m``, with a graph."""
        shape = Size([1]) if sample_shape is None else sample_shape
        mean, _ = self.gaussians
        base = torch.randn(*shape, *self.base_sample_shape, dtype=mean.dtype, device=mean.device)
        return self.rsample_from_base_samples(shape, base)

    def rsample_from_base_samples(self, sample_shape: Size, base_samples: Tensor) -> Tensor:
        """Return samples made of N(0, 1) base samples, ``sample_shape x base_sample_shape``."""
        mean, K = self.gaussians
        S, m, q = mean.shape[-3:]
        shape = (*sample_shape, *mean.shape[:-3])
        base = base_samples.expand(*shape, -1)
        which = (torch.special.ndtr(base[..., -1].detach()) * S).long().clamp(0, S - 1)
        z = base[..., : q * m].reshape(*shape, q, m).mT
        # Components in front, batches behind samples: pick without expanding the roots.
        flat_mean = mean.reshape(-1, S, m, q)
        flat_root = correlation_root(K).reshape(-1, S, m, q, q)
        which = which.reshape(-1, len(flat_mean))
        z = z.reshape(-1, len(flat_mean), m, q)
        rows = torch.arange(len(flat_mean), device=which.device).expand_as(which)
        samples = flat_mean[rows, which] + _products(flat_root, z, rows, which)  # mu + L z
        return samples.reshape(*shape, m, q).mT

    def quantile(self, value: Tensor) -> Tensor:
        """Return quantiles ``... x q x m`` of the mixture, with several levels in front."""
        quantiles = [self.marginals.quantile(level) for level in value.flatten().tolist()]
        return torch.stack(quantiles).squeeze(0)

    def density(self, value: Tensor) -> Tensor:
        """Return the density of each output at each point, at values ``... x q x m``."""
        return self.marginals.log_density(value.expand(self.mean.shape)).exp()

    def scalarized(self, weights: Tensor, offset: float = 0.0) -> MixturePosterior:
        """Return the posterior of a weighted sum of the outputs, plus an offset."""
        mean, K = self.gaussians
        m = mean.shape[-2]
        if weights.shape != (m,):
            raise ValueError(f"Expected weights of {m} outputs; found {tuple(weights.shape)}.")
        w = weights.to(mean).unsqueeze(-1)
        # sum_j w_j y_j has the variance sum_j w_j^2 K_j.
        total = (w * mean).sum(-2, keepdim=True) + offset
        return MixturePosterior(total, (w.square().unsqueeze(-1) * K).sum(-3, keepdim=True))


def _products(root: Tensor, z: Tensor, rows: Tensor, which: Tensor) -> Tensor:
    """Return the picked roots ``b x S x m x q x q`` times ``N x b x m x q``."""
    if root.shape[-1] == 1:
        return root[rows, which].squeeze(-1) * z
    products = torch.zeros_like(z)
    for s in range(root.shape[1]):
        is_picked = which == s
        if is_picked.any():
            samples, batches = is_picked.nonzero().unbind(-1)
            part = (root[batches, s] @ z[is_picked].unsqueeze(-1)).squeeze(-1)
            products = products.index_put((samples, batches), part)
    return products
