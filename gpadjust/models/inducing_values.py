"""A sum of terms that is known by its values at inducing points, for training and prediction."""

from __future__ import annotations

from typing import Any, Self

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.models import ApproximateGP
from gpytorch.settings import skip_posterior_variances
from gpytorch.utils.memoize import cached
from gpytorch.variational import CholeskyVariationalDistribution, VariationalStrategy
from linear_operator import to_dense, to_linear_operator
from linear_operator.operators import LinearOperator, TriangularLinearOperator, ZeroLinearOperator
from torch import Size, Tensor

from gpadjust.gp import SumOfTerms, TermsMean
from gpadjust.gp.gaussian import cholesky
from gpadjust.models.cholesky_strategy import (
    CholeskyStrategy,
    Weights,
    batched_solve,
    least_variance,
)

INDUCING_NUGGET = 1e-8
"""The nugget of inducing values, relative to their mean variance.

Many observations weigh heavily: their covariances with the inducing values, whose rounding errors
are divided by the nugget, are summed over all of them.
"""


def inducing_root(covariance: Tensor) -> Tensor:
    """The Cholesky factor of a covariance of inducing values, ``... x M x M``, and their nugget."""
    size = covariance.diagonal(dim1=-1, dim2=-2).mean(-1)
    identity = torch.eye(covariance.shape[-1]).to(covariance)
    return cholesky(covariance + INDUCING_NUGGET * size[..., None, None] * identity)[0]


class ScaleFreeVariationalStrategy(VariationalStrategy):
    """GPyTorch's whitened strategy, with a nugget that follows the size of the covariance."""

    def __getstate__(self) -> dict[str, Any]:
        """All but what is remembered with its graph, which cannot be copied."""
        return {name: each for name, each in vars(self).items() if name != "_memoize_cache"}

    @cached(name="cholesky_factor", ignore_args=True)  # type: ignore[untyped-decorator]
    def _cholesky_factor(self, induc_induc_covar: LinearOperator) -> TriangularLinearOperator:
        return TriangularLinearOperator(inducing_root(to_dense(induc_induc_covar)))


class InducingGP(ApproximateGP):
    r"""A sum of terms with a distribution over its values u at inducing points (Titsias 2009).

    GPyTorch's stochastic variational model: with ``VariationalELBO`` it is trained by minibatches
    as any other. It reads what the terms read, transformed inputs with columns of f_p.

    Args:
        covar_module: The covariance of the sum, of batch shape ``(m)``.
        inducing_points: Where u is, ``(m) x M x (d + k)``.

    Attributes:
        strategy: What is remembered to predict from; None once anything may have changed.
    """

    strategy: InducingStrategy | None = None

    def __init__(self, covar_module: SumOfTerms, inducing_points: Tensor) -> None:
        distribution = CholeskyVariationalDistribution(
            inducing_points.shape[-2], batch_shape=covar_module.batch_shape, mean_init_std=0.0
        )
        super().__init__(
            ScaleFreeVariationalStrategy(
                self,
                inducing_points,
                distribution.to(inducing_points),
                learn_inducing_locations=False,
                jitter_val=0.0,
            )
        )
        self.covar_module = covar_module
        self.mean_module = TermsMean(covar_module)

    @property
    def inducing_points(self) -> Tensor:
        """Where the inducing values are, ``(m) x M x (d + k)``."""
        points: Tensor = self.variational_strategy.inducing_points
        return points

    def train(self, mode: bool = True) -> Self:
        """Put it in train mode, or eval mode."""
        if mode or self.training:
            self.strategy = None
        return super().train(mode)

    @torch.no_grad()
    def place(self, points: Tensor) -> None:
        """Move the inducing points; what was known of the values there is forgotten."""
        self.inducing_points.copy_(points)
        identity = torch.eye(points.shape[-2]).to(points)
        self.hold(torch.zeros_like(points[..., 0]), identity)

    @torch.no_grad()
    def hold(self, mean: Tensor, root: Tensor) -> None:
        """Take the distribution of the whitened values: mean ``(m) x M``, and a lower root."""
        strategy: Any = self.variational_strategy
        distribution = strategy._variational_distribution
        distribution.variational_mean.copy_(mean)
        distribution.chol_variational_covar.copy_(root)
        strategy.variational_params_initialized.fill_(1)
        strategy._clear_cache()
        self.strategy = None

    def forward(self, x: Tensor) -> MultivariateNormal:
        """The prior at transformed inputs, ``... x n x (d + k)``."""
        return MultivariateNormal(self.mean_module(x), self.covar_module(x))


class InducingStrategy(CholeskyStrategy):
    r"""Predictions from inducing values :math:`u = m + L v`, of which :math:`v \sim N(\mu, C C^T)`.

    With :math:`K = L L^T` their prior covariance and a the covariances of what is predicted with
    them, times :math:`L^{-T}`, means are :math:`a \mu`, and covariances the prior's less
    :math:`a a^T - (a C)(a C)^T`. Terms that are not in the model's covariance are as they were.

    Args:
        model: The model of the values.
        likelihood: The noise of observations.
    """

    def __init__(self, model: InducingGP, likelihood: Any) -> None:
        with torch.no_grad():
            points = model.inducing_points.detach()
            known: Any = model.variational_strategy.variational_distribution
            prior = MultivariateNormal(model.mean_module(points), _no_covariance(points))
            super().__init__([points], prior, known.mean.detach(), likelihood, model.covar_module)
            covariance = model.covar_module.covariance(points, points)
            self.chol = inducing_root(covariance)
            root = known.lazy_covariance_matrix.cholesky()
            self.root = to_dense(root).detach()
            white = known.mean.detach().unsqueeze(-1)
            self._alpha = torch.linalg.solve_triangular(self.chol.mT, white, upper=True).squeeze(-1)
        self._reached = {term.name for term in model.covar_module.terms}

    @property
    def mean_cache(self) -> Tensor:
        r"""The weights :math:`L^{-T} \mu` of the mean, ``(m) x M``."""
        return self._alpha

    @property
    def has_graph(self) -> bool:
        """False: gradients flow to where predictions are made alone."""
        return False

    def cross_covariance(self, inputs: Tensor, weights: Weights) -> Tensor:
        """The covariance of a weighted sum of terms with the inducing values, ``... x q x M``."""
        reached = [(term, weight) for term, weight in weights if term.name in self._reached]
        return super().cross_covariance(inputs, reached)

    def exact_predictive_covar(
        self, test_test_covar: Tensor | LinearOperator, test_train_covar: Tensor | LinearOperator
    ) -> LinearOperator:
        """Return the posterior covariance, ``... x q x q``."""
        if skip_posterior_variances.on():
            return ZeroLinearOperator(*test_test_covar.shape)
        prior = to_dense(test_test_covar)
        white, left = self._white(to_dense(test_train_covar))
        least = least_variance(prior.diagonal(dim1=-1, dim2=-2), self.num_train)
        covariance = prior - white @ white.mT + left @ left.mT
        excess = (least - covariance.detach().diagonal(dim1=-1, dim2=-2)).clamp_min(0)
        return to_linear_operator(covariance + torch.diag_embed(excess))

    def _reduced(self, prior: Tensor, cross: Tensor) -> Tensor:
        white, left = self._white(cross)
        known = white.square().sum(-1) - left.square().sum(-1)
        return (prior - known).maximum(least_variance(prior, self.num_train))

    def _white(self, cross: Tensor) -> tuple[Tensor, Tensor]:
        """:math:`a` and :math:`a C` of covariances with the inducing values, ``... x q x M``."""
        white = batched_solve(cross, self.chol.mT, upper=True)
        return white, white @ self.root

    def pathwise_update(self, prior: Tensor) -> Tensor:
        """The weights that give functions from the prior, ``k x (m) x M``, drawn values."""
        mean, points = self.train_labels, self.train_inputs[0]
        drawn = torch.randn(len(prior), *mean.shape).to(mean)
        white = mean + (self.root @ drawn.unsqueeze(-1)).squeeze(-1)
        residual = (prior - TermsMean(self.kernel)(points)).unsqueeze(-1)
        rest = white.unsqueeze(-1) - torch.linalg.solve_triangular(self.chol, residual, upper=False)
        return torch.linalg.solve_triangular(self.chol.mT, rest, upper=True).squeeze(-1)


def _no_covariance(points: Tensor) -> LinearOperator:
    return ZeroLinearOperator(*points.shape[:-1], points.shape[-2])


def batch_of(covar_module: SumOfTerms, points: Tensor) -> Tensor:
    """Inducing points for each batch of a covariance, ``(m) x M x (d + k)``."""
    shape: Size = covar_module.batch_shape
    return points.expand(*shape, *points.shape[-2:]).clone()
