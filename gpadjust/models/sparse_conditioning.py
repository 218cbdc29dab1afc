"""Posterior of a sum of terms by its values at inducing points."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.gp import SumOfTerms, WeightedSum
from gpadjust.gp.gaussian import cholesky
from gpadjust.models.exact_conditioning import (
    batched_solve,
    conditional_covariance,
    least_variance,
)

INDUCING_NUGGET = 1e-8
"""The nugget of inducing values, relative to their mean variance.

Many observations weigh heavily: their covariances with the inducing values, whose rounding errors
are divided by the nugget, are summed over all of them.
"""


def inducing_root(covariance: Tensor) -> Tensor:
    """The Cholesky factor of a covariance of inducing values, ``... x M x M``, and their nugget."""
    size = covariance.diagonal(dim1=-1, dim2=-2).mean(-1, keepdim=True)
    nugget = torch.diag_embed((INDUCING_NUGGET * size).expand(covariance.shape[:-1]))
    return cholesky(covariance + nugget)[0]


class SparseConditioning:
    r"""Posterior of a sum of terms by its values at ``M`` inducing points (Titsias 2009).

    With their prior covariance :math:`K = L L^T` and mean m, the values are :math:`m + L v` with
    :math:`v \sim N(\mu, C C^T)`. Where A is the covariance of what is predicted with them and
    :math:`a = A L^{-T}`, means are the prior's and :math:`a \mu`, covariances the prior's less
    :math:`a a^T - (a C)(a C)^T`. Terms that the sum at the points has not are as they were.

    The points are ``... x M x (d + k)``; ``mean`` and ``root`` are :math:`\mu` and C.
    """

    def __init__(self, points: Tensor, mean: Tensor, root: Tensor, kernel: SumOfTerms) -> None:
        self.train_inputs = [points]
        self._mean, self._root = mean.unsqueeze(-1), root
        with torch.no_grad():
            self._train = kernel.at(points)
            self._chol = inducing_root(self._train.covariance())
            self.mean_cache = self._solve(self._mean).squeeze(-1)  # the weights of the mean

    def mean(self, sought: WeightedSum, cross: Tensor | None = None) -> Tensor:
        """Posterior means of a weighted sum, ``... x q``."""
        cross = sought.cross(self._train, is_data=True) if cross is None else cross
        return sought.mean() + (cross @ self.mean_cache.unsqueeze(-1)).squeeze(-1)

    def marginals(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means and variances at each point by itself, ``... x q``."""
        mean, white, left = self._whiten(sought)
        prior = sought.variance(data=self._train)
        known = white.square().sum(-1) - left.square().sum(-1)
        return mean, (prior - known).maximum(least_variance(prior, white.shape[-1]))

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means ``... x q`` and covariances ``... x q x q``."""
        mean, white, left = self._whiten(sought)
        covariance = conditional_covariance(sought.covariance() + left @ left.mT, white)
        return mean, covariance.expand(*mean.shape, mean.shape[-1])

    def pathwise_update(self, prior: Tensor) -> Tensor:
        """The weights that give functions from the prior, ``k x ... x M``, drawn values."""
        drawn = torch.randn(*prior.shape, 1).to(prior)
        residual = (prior - self._train.mean()).unsqueeze(-1)
        white = torch.linalg.solve_triangular(self._chol, residual, upper=False)
        return self._solve(self._mean + self._root @ drawn - white).squeeze(-1)

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Pickle as nothing, as it is copied: it can be made again from the model."""
        return type(None), ()

    def _whiten(self, sought: WeightedSum) -> tuple[Tensor, Tensor, Tensor]:
        """Means; :math:`a` and :math:`a C`, ``... x q x M``."""
        cross = sought.cross(self._train, is_data=True)
        white = batched_solve(cross, self._chol.mT, upper=True)
        return self.mean(sought, cross), white, white @ self._root

    def _solve(self, white: Tensor) -> Tensor:
        """Solve :math:`L^T` for columns, ``... x M x 1``."""
        return torch.linalg.solve_triangular(self._chol.mT, white, upper=True)
