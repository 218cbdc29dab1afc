"""The posterior of weighted sums by their values at inducing points."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gpadjust.core.data import appended
from gpadjust.core.gaussian import Conditioning, factor
from gpadjust.core.terms import WeightedSum
from gpadjust.core.unknowns import standard_normal
from gpadjust.many.bound import Sums, at_points, blocks


class SparseConditioning(Conditioning):
    r"""The posterior of weighted sums, given many observations of one sum, by inducing values u.

    A basis E whitens their prior and makes the information of the rows diagonal,
    :math:`E K E^T = I` and :math:`E K_{uf} W K_{fu} E^T = D`. With :math:`e = E k(Z, x)`, means are
    :math:`\bar f + e^T (I + D)^{-1} E K_{uf} W r` and variances
    :math:`k(x, x) - e^T D (I + D)^{-1} e`.

    The points are rows ``m x M`` of the total. Prior, noise and rest are variances of the observed
    sum, of the noise, and of the sum that is noise to the inducing values, at all rows.
    """

    def __init__(
        self, total: WeightedSum, points: Tensor, prior: Tensor, noise: Tensor, rest: Tensor,
        targets: Tensor,
    ) -> None:  # fmt: skip
        self.total, self.prior, self.targets, self.rest = total, prior, targets, rest
        self.num_rows = targets.shape[-1]
        shape = torch.broadcast_shapes(prior.shape, noise.shape, targets.shape)
        self.noise = noise.expand(shape)
        is_observed = ~targets.isnan()
        self.weight = (is_observed / (noise + rest)).expand(shape)
        self.residual = ((targets - total.mean).nan_to_num() * is_observed).expand(shape)
        self.chol, square, cross = Sums.over_rows(total, points, self.residual, self.weight)
        if not self.chol.isfinite().all():
            raise ValueError(
                "Expected kernel parameters at which covariances of inducing values have a "
                "Cholesky factor; found others. Fit the model again, with fewer inducing points."
            )
        # L^-1 K_uf W K_fu L^-T = Q D Q^T, so that E = Q^T L^-1
        self.gain, vectors = torch.linalg.eigh(square)
        self.gain = self.gain.clamp_min(0.0)  # D
        self.basis = torch.linalg.solve_triangular(self.chol.mT, vectors, upper=True).mT
        # (I + D)^-1 E K_uf W r
        self.white_mean = (vectors.mT @ cross.unsqueeze(-1)).squeeze(-1) / (1 + self.gain)
        self.alpha = (self.basis.mT @ self.white_mean.unsqueeze(-1)).squeeze(-1)
        self.inverse = (self.gain / (1 + self.gain)).sqrt().unsqueeze(-1) * self.basis
        self.train = at_points(total, points)
        self.observed = torch.ones_like(self.train.mean, dtype=torch.bool)

    def bound(self) -> Tensor:
        """Return the lower bound of the log likelihood, ``S x m``; see :func:`~.bound`."""
        sizes = (2 * math.pi / self.weight).log().masked_fill(self.weight == 0, 0.0).sum(-1)
        misfits = (self.weight * (self.residual.square() + self.prior - self.rest)).sum(-1)
        by_points = (1 + self.gain).log() - self.gain - (1 + self.gain) * self.white_mean.square()
        return -0.5 * (sizes + misfits + by_points.sum(-1))

    def inverse_factor(self) -> Tensor:
        """Return F, with variances k(x, x) - |F k|^2 by covariances k with u."""
        return self.inverse

    def update(self, prior: Tensor, generator: torch.Generator) -> Tensor:
        """Return weights that move inducing values of the prior to values of the posterior."""
        noise = standard_normal(prior.shape, generator, prior)
        # E u ~ N(white mean, (I + D)^-1)
        white = (self.basis @ (prior - self.train.mean).unsqueeze(-1)).squeeze(-1)
        move = self.white_mean + (1 + self.gain).rsqrt() * noise - white
        return (self.basis.mT @ move.unsqueeze(-1)).squeeze(-1)

    def leverage(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means, variances given the inducing values, and variances h by these, at rows."""
        parts = []
        for rows in blocks(self.targets.shape[-1], self.chol):
            e = self.basis @ self.train.cross(self.total.of_rows(rows))
            mean = self.total.mean[..., rows] + (self.white_mean.unsqueeze(-2) @ e).squeeze(-2)
            squares = e.square()
            h = (squares / (1 + self.gain).unsqueeze(-1)).sum(-2)
            parts.append((mean, h, squares.sum(-2)))
        mean, h, explained = (torch.cat(part, -1) for part in zip(*parts, strict=True))
        return mean, (self.prior - explained).clamp_min(0.0), h

    def left_out(self) -> tuple[Tensor, Tensor]:
        """Return means and variances of each observation given all others, noise included."""
        # In the linear model of the inducing values a row has a variance h and a leverage H = w h.
        # Without the row, the residual is (y - m) / (1 - H) and the variance h / (1 - H).
        mean, conditional, h = self.leverage()
        free = (1 - self.weight * h).clamp_min(1e-9)  # 1 - H
        variance = conditional + h / free + self.noise
        left_out_mean = self.targets - (self.targets - mean) / free
        return left_out_mean, variance.masked_fill(self.targets.isnan(), torch.nan)


class LaterConditioning(Conditioning):
    """An old posterior by inducing values, given further observations exactly.

    The late rows are observations of a Gaussian process with the old posterior as its prior.
    """

    def __init__(
        self,
        old: SparseConditioning | LaterConditioning,
        late: WeightedSum,
        noise: Tensor,
        targets: Tensor,
    ) -> None:
        self.old = old
        self.train = joined(old.train, late)
        self.num_rows: int = old.num_rows + targets.shape[-1]
        K = late.cross(late)
        observed = ~targets.isnan()
        while observed.dim() > K.dim() - 1 and bool((observed == observed[0]).all()):
            observed = observed[0]  # fantasies of the same points share a factor
        K21 = late.cross(old.train) * observed.unsqueeze(-1) * old.observed.unsqueeze(-2)
        # The covariance of the late rows given the old ones is K - B B^T + noise = R R^T.
        B = old.white(K21)
        noise = noise.expand(torch.broadcast_shapes(noise.shape, K.shape[:-1]))
        self.root = factor(K - B @ B.mT, noise, observed)
        *lead, _, k = self.root.shape
        # The inverse factor [[F, 0], [-R^-1 B F, R^-1]].
        upper = old.inverse_factor().expand(*lead, -1, -1)
        right = torch.cat([-B @ upper, torch.eye(k).to(K).expand(*lead, k, k)], -1)
        self.below = torch.linalg.solve_triangular(self.root, right, upper=False)
        zero = upper.new_zeros(*upper.shape[:-1], k)
        self.inverse = torch.cat([torch.cat([upper, zero], -1), self.below], -2)
        self.chol = self.inverse  # callers read its size
        self.noise, self.targets = noise, targets
        self.is_late = observed
        self.K21 = K21
        mean = late.mean + (K21 @ old.alpha.unsqueeze(-1)).squeeze(-1)
        self.alpha = self.later(old.alpha, targets - mean)
        self.observed = appended(old.observed, observed, -1)

    def inverse_factor(self) -> Tensor:
        """Return F, with variances :math:`k(x, x) - |F k|^2` by covariances k with all rows."""
        return self.inverse

    def later(self, weights: Tensor, residual: Tensor) -> Tensor:
        """Return weights ``... x M`` of the old rows, and of late rows by their residuals."""
        residual = (residual.nan_to_num() * self.is_late).unsqueeze(-1)
        white = torch.linalg.solve_triangular(self.root, residual, upper=False)
        added = (self.below.mT @ white).squeeze(-1)
        lead = torch.broadcast_shapes(added.shape[:-1], weights.shape[:-1])
        old = torch.nn.functional.pad(weights.expand(*lead, -1), (0, residual.shape[-2]))
        return old + added

    def update(self, prior: Tensor, generator: torch.Generator) -> Tensor:
        """Return weights that move functions from the prior onto the observations."""
        M = self.K21.shape[-1]
        old = self.old.update(prior[..., :M], generator)
        value = prior[..., M:] + (self.K21 @ old.unsqueeze(-1)).squeeze(-1)
        noise = self.noise.sqrt() * standard_normal(value.shape, generator, prior)
        return self.later(old, self.targets - value - noise)

    def left_out(self) -> tuple[Tensor, Tensor]:
        """Raise an error: the formula does not cover the rows of the fit."""
        number = self.targets.shape[-1]
        message = (
            f"Expected no observations since the fit for left-out predictions; found {number}."
        )
        raise NotImplementedError(f"{message} Build a model of all data and fit it.")


def joined(old: WeightedSum, late: WeightedSum) -> WeightedSum:
    """Return a sum at the places of two; further terms of the late one have no weight before."""
    zero = torch.zeros_like(old.mean)
    weights = {n: appended(old.weights.get(n, zero), w, -1) for n, w in late.weights.items()}
    mean = appended(old.mean, late.mean, -1)
    return WeightedSum(late.terms, late.values, appended(old.x, late.x), mean, weights)
