"""Gaussian processes as linear algebra: likelihood, conditioning and predictions."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core.terms import WeightedSum
from gpadjust.core.unknowns import Values, standard_normal

_EPS = torch.finfo(torch.float64).eps
_NOISY = 1e-8  # share of the largest variance given earlier rows above which L^-1 is exact


def add_noise(K: Tensor, noise: Tensor) -> Tensor:
    """Return covariances ``... x n x n`` plus variances ``... x n`` (or 1) on the diagonal."""
    if noise.dim() >= K.dim() or noise.shape[:-1] != K.shape[:-2]:
        shape = torch.broadcast_shapes(noise.shape, K.shape[:-1])
        K = K.expand(*shape, shape[-1])
    K = K.clone()
    K.diagonal(dim1=-1, dim2=-2).add_(noise)
    return K


def factor(K: Tensor, noise: Tensor, observed: Tensor) -> Tensor:
    """Return Cholesky factors of covariances ``... x n x n`` with noise ``... x n`` (or 1).

    Targets that are not ``observed`` (``... x n``) are independent of everything. The nugget is
    some rounding errors of each variance, more where a matrix is not positive definite; the factor
    is NaN where it never is.
    """
    if not observed.all():
        K = K * (observed.unsqueeze(-1) & observed.unsqueeze(-2))
        noise = noise * observed + (~observed).to(K)
    diagonal = K.diagonal(dim1=-1, dim2=-2) + noise
    least = 1e-10 * diagonal.mean(-1, keepdim=True)
    nugget = max(100, K.shape[-1]) * _EPS * diagonal.maximum(least)
    for _ in range(6):
        chol, info = torch.linalg.cholesky_ex(add_noise(K, noise + nugget))
        if not info.any():
            return chol
        nugget = nugget * (1 + 9 * (info > 0).to(K).unsqueeze(-1))
    return chol.masked_fill((info > 0)[..., None, None], math.nan)


class Likelihood(NamedTuple):
    """A log likelihood and its derivatives."""

    value: Tensor  # ...
    by_mean: Tensor  # ... x n
    by_covariance: Tensor  # ... x n x n


def log_likelihood(
    residual: Tensor, K: Tensor, noise: Tensor, observed: Tensor, with_gradient: bool = True
) -> Likelihood:
    r"""Return log N(r | 0, K + noise) and its derivatives (that by K is K if not asked for).

    With :math:`\alpha = K^{-1} r` (Rasmussen and Williams 2006, algorithm 2.1 and eq. 5.9)

    .. math::
        -\tfrac12 r^T \alpha - \tfrac12 \log |K| - \tfrac{n}{2} \log 2 \pi, \quad
        \partial / \partial K = \tfrac12 (\alpha \alpha^T - K^{-1}).
    """
    chol = factor(K, noise, observed)
    alpha = torch.cholesky_solve(residual.unsqueeze(-1), chol)
    log_det = chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)  # log |K| / 2
    quadratic = (residual.unsqueeze(-1) * alpha).sum((-1, -2))
    # -r^T alpha / 2 - log |K| / 2 - n log(2 pi) / 2
    value = -0.5 * quadratic - log_det - 0.5 * observed.sum(-1) * math.log(2 * math.pi)
    if not with_gradient:
        return Likelihood(value, alpha.squeeze(-1), K)
    # (alpha alpha^T - K^-1) / 2
    D = torch.cholesky_inverse(chol).mul_(-0.5)
    D = torch.baddbmm(*(v.flatten(0, -3) for v in (D, alpha, alpha.mT)), alpha=0.5).reshape(D.shape)
    if not observed.all():
        D = D * (observed.unsqueeze(-1) & observed.unsqueeze(-2))
    return Likelihood(value, alpha.squeeze(-1), D)


class SumLikelihood(NamedTuple):
    """The log likelihood of observations of a weighted sum, ``S x m``, and its derivatives."""

    value: Tensor
    by: Values  # by numbers of kernels, and by the weights of terms at the inputs
    by_mean: Tensor  # S x m x n
    by_variance: Tensor  # by the variances of the noise, S x m x n


def sum_likelihood(
    train: WeightedSum, residual: Tensor, noise: Tensor, observed: Tensor, with_gradient: bool
) -> SumLikelihood:
    """Return the likelihood of residuals ``S x m x n`` of a sum; 0 where not observed."""
    if not with_gradient:
        K = train.cross(train).expand(*residual.shape, residual.shape[-1])
        value = log_likelihood(residual, K, noise, observed, False).value
        return SumLikelihood(value, {}, residual, residual)
    K, pull_back = train.with_pull_back()
    K = K.expand(*residual.shape, residual.shape[-1])
    value, by_mean, D = log_likelihood(residual, K, noise, observed)
    return SumLikelihood(value, pull_back(D), by_mean, D.diagonal(dim1=-1, dim2=-2))


class Conditioning:
    r"""The posterior of weighted sums, given noisy observations of one.

    Args:
        train: The observed sum at the training inputs.
        noise: The variances of the observations, ``... x S x m x n`` (or 1).
        targets: The observations, ``... x 1 x m x n``; NaN where one is missing. All of their
            further leading dimensions share the factor of the covariance.
        old: The conditioning on the first rows, of which the factor is used again.

    Attributes:
        alpha: :math:`K^{-1} (y - \bar f)`, ``... x S x m x n``.
    """

    chol: Tensor
    is_noisy = True
    """Whether predictions are products with the inverse factor."""

    def __init__(
        self, train: WeightedSum, noise: Tensor, targets: Tensor, old: Conditioning | None = None
    ) -> None:
        self.train = train
        self.targets = targets
        late, batch = train, torch.Size()
        if old is not None:
            late = train.of_rows(slice(old.chol.shape[-1], None))
            batch = old.chol.shape[:-2]
        K = late.cross(late)
        lead = torch.broadcast_shapes(K.shape[:-2], noise.shape[:-1], batch)
        self.noise = noise.expand(*lead, train.x.shape[-2])
        observed = ~targets.isnan()
        # Fantasies of the same points share a factor, if the same ones are missing.
        while observed.dim() > self.noise.dim() and bool((observed == observed[0]).all()):
            observed = observed[0]
        self.observed = observed
        self._inverse: Tensor | None = None
        if old is None:
            self.chol = factor(K, self.noise, observed)
        else:
            self.chol, self._inverse = self._appended(old, late.cross(old.train), K)
        pivots = self.chol.diagonal(dim1=-1, dim2=-2).square()
        self.is_noisy = bool(pivots.min() > _NOISY * pivots.max())
        self.alpha = self.solve((targets - train.mean).nan_to_num() * observed)

    def _appended(
        self, old: Conditioning, K21: Tensor, K22: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        r"""Return the factor of old and further rows, and its inverse with noise.

        .. math::
            L = \begin{pmatrix} L_1 & 0 \\ B & L_2 \end{pmatrix}, \quad B^T = L_1^{-1} K_{12},
            \quad L_2 L_2^T = K_{22} - B B^T, \quad
            L^{-1} = \begin{pmatrix} L_1^{-1} & 0 \\ -L_2^{-1} B L_1^{-1} & L_2^{-1} \end{pmatrix}.
        """
        n = old.chol.shape[-1]
        lead = torch.broadcast_shapes(self.noise.shape[:-1], self.observed.shape[:-1])
        observed = self.observed[..., n:]
        K21 = (K21 * observed.unsqueeze(-1) * old.observed.unsqueeze(-2)).expand(*lead, -1, n)
        B = old.white(K21)
        late_noise = self.noise[..., n:]
        # The nugget of the new rows is that of their own variances.
        variance = K22.diagonal(dim1=-1, dim2=-2) + late_noise
        late_noise = late_noise + max(100, self.noise.shape[-1]) * _EPS * variance
        L2 = factor(K22 - B @ B.mT, late_noise, observed)
        L2 = L2.expand(*lead, *L2.shape[-2:])
        chol = _lower(old.chol.expand(*lead, n, n), B, L2)
        if not old.is_noisy:
            return chol, None
        inverse1 = old.inverse_factor().expand(*lead, n, n)
        inverse2 = _inverse(L2)
        return chol, _lower(inverse1, -inverse2 @ B @ inverse1, inverse2)

    def solve(self, residual: Tensor) -> Tensor:
        """Return :math:`K^{-1} r` for residuals ``... x n``."""
        if residual.dim() > self.chol.dim() - 1:  # fantasies, which share one factor
            extra = residual.dim() - self.chol.dim() + 1
            flat = residual.flatten(0, extra - 1).movedim(0, -1)
            flat = torch.cholesky_solve(flat, self.chol).movedim(-1, 0)
            return flat.reshape(*residual.shape[:extra], *flat.shape[1:])
        return torch.cholesky_solve(residual.unsqueeze(-1), self.chol).squeeze(-1)

    def inverse_factor(self) -> Tensor:
        """Return :math:`L^{-1}`, computed once, so that predictions are products."""
        if self._inverse is None:
            self._inverse = _inverse(self.chol)
        return self._inverse

    def white(self, cross: Tensor) -> Tensor:
        """Return :math:`k L^{-T}`: a product, or without noise a solve, which is more exact."""
        if self.is_noisy:
            return cross @ self.inverse_factor().mT
        return torch.linalg.solve_triangular(self.chol, cross.mT, upper=False).mT

    def mean(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        r"""Return means :math:`\bar f + k \alpha`, and covariances k with the training inputs."""
        cross = sought.cross(self.train)
        if not self.observed.all():
            cross = cross * self.observed.unsqueeze(-2)
        # f + k alpha
        return sought.mean + (cross @ self.alpha.unsqueeze(-1)).squeeze(-1), cross

    def mean_alone(self, sought: WeightedSum) -> Tensor:
        """Return means without k, which takes half the time."""
        alpha = (self.alpha * self.observed).unsqueeze(-1)
        return sought.mean + sought.cross_times(self.train, alpha).squeeze(-1)

    def moments(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and variances at each point, ``... x S x m x q``."""
        mean, cross = self.mean(sought)
        white = self.white(cross)
        prior = sought.variance()
        # k(x, x) - |k L^-T|^2, not below the rounding errors of the difference
        variance = prior - white.square().sum(-1)
        return mean, variance.maximum(4 * self.chol.shape[-1] * _EPS * prior)

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means ``... x S x m x q``, and covariances ``... x S x m x q x q``."""
        mean, cross = self.mean(sought)
        white = self.white(cross)
        prior = sought.cross(sought)
        # k(x, x') - k(x, X) K^-1 k(X, x')
        K = prior - white @ white.mT
        least = 4 * self.chol.shape[-1] * _EPS * prior.diagonal(dim1=-1, dim2=-2)
        raised = (least - K.diagonal(dim1=-1, dim2=-2)).clamp_min(0.0)
        return mean, add_noise(K, raised)

    def update(self, prior: Tensor, generator: torch.Generator) -> Tensor:
        """Return the weights v of k by which functions from the prior, at X, meet the data."""
        # v = K^-1 (y - f(X) - epsilon); the nugget of the factor is noise, too.
        total = self.chol.square().sum(-1) - self.train.variance()
        sd = total.maximum(self.noise).sqrt()
        noise = sd * standard_normal(prior.shape, generator, prior)
        return self.solve((self.targets - prior - noise).nan_to_num() * self.observed)

    def left_out(self) -> tuple[Tensor, Tensor]:
        r"""Return means and variances of each observation given all others, noise included.

        .. math:: y_i - \alpha_i / [K^{-1}]_{ii}, \quad 1 / [K^{-1}]_{ii}

        (Rasmussen and Williams 2006, eqs. 5.10 to 5.12).
        """
        precision = self.inverse_factor().square().sum(-2)  # [K^-1]_ii
        variance = precision.reciprocal().masked_fill(~self.observed, math.nan)
        return self.targets - self.alpha * variance, variance


def _inverse(L: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(L, torch.eye(L.shape[-1]).to(L), upper=False)


def _lower(A: Tensor, B: Tensor, C: Tensor) -> Tensor:
    """Return the lower triangular matrix of blocks A, B and C."""
    zero = A.new_zeros(*A.shape[:-1], C.shape[-1])
    return torch.cat([torch.cat([A, zero], -1), torch.cat([B, C], -1)], -2)


# Mixtures of Gaussians.

DRAWS = -3  # the dimension of draws in ... x S x q x m


class Prediction(NamedTuple):
    """Predictions of single points, in the units of the targets."""

    mean: Tensor  # ... x q x m
    variance: Tensor


class Marginals(NamedTuple):
    """Mixtures of equally likely Gaussians at single points."""

    means: Tensor  # of the components, ... x S x q x m
    variances: Tensor

    @property
    def prediction(self) -> Prediction:
        """The mean and variance of the mixtures, ``... x q x m``."""
        if self.means.shape[DRAWS] == 1:
            return Prediction(self.means.squeeze(DRAWS), self.variances.squeeze(DRAWS))
        center = self.means.mean(DRAWS)
        # The variance of the means, and the mean of the variances.
        between = (self.means - center.unsqueeze(DRAWS)).square().mean(DRAWS)
        return Prediction(center, self.variances.mean(DRAWS) + between)

    def quantile(self, level: float) -> Tensor:
        r"""Return the quantiles ``... x q x m`` of a level, by bisection.

        Their gradient is that of :math:`F(q) = p`: :math:`dq = -dF / F'(q)`.
        """
        ends = self.means + torch.special.ndtri(torch.tensor(level).to(self.means)) * self._sd
        if self.means.shape[DRAWS] == 1:
            return ends.squeeze(DRAWS)
        with torch.no_grad():
            low, high = ends.amin(DRAWS), ends.amax(DRAWS)
            for _ in range(50):
                middle = (low + high) / 2
                is_below = self.probability(middle) < level
                low = torch.where(is_below, middle, low)
                high = torch.where(is_below, high, middle)
            middle = (low + high) / 2
        if not ends.requires_grad:
            return middle
        # q - (F(q) - p) / F'(q), of which the value is q
        below = self.probability(middle)
        slope = self.log_density(middle).exp().detach()
        return middle - (below - below.detach()) / slope.clamp_min(1e-300)

    def probability(self, Y: Tensor) -> Tensor:
        """Return the probability of values below ``Y``, ``... x q x m``."""
        # mean_s Phi((y - mu_s) / sd_s)
        return torch.special.ndtr((Y.unsqueeze(DRAWS) - self.means) / self._sd).mean(DRAWS)

    def log_density(self, Y: Tensor) -> Tensor:
        """Return the log density at values ``Y``, ``... x q x m``; NaN where they are."""
        # log mean_s N(y | mu_s, sd_s^2)
        z = (Y.unsqueeze(DRAWS) - self.means) / self._sd
        log_densities = -0.5 * z.square() - self._sd.log() - 0.5 * math.log(2 * math.pi)
        return log_densities.logsumexp(DRAWS) - math.log(self.means.shape[DRAWS])

    @property
    def _sd(self) -> Tensor:
        return self.variances.sqrt().clamp_min(1e-300)
