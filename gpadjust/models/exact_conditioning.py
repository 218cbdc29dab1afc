"""Exact posterior of a sum of terms, by the Cholesky factor of the covariance of observations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.models.exact_prediction_strategies import DefaultPredictionStrategy
from gpytorch.settings import detach_test_caches, skip_posterior_variances
from linear_operator import to_dense, to_linear_operator
from linear_operator.operators import LinearOperator, ZeroLinearOperator
from linear_operator.utils.errors import NotPSDError
from torch import Tensor

from gpadjust.gp import SumOfTerms, WeightedSum
from gpadjust.gp.gaussian import cholesky, nugget
from gpadjust.gp.noise import Noise

_FEW = 256  # points up to which a product is faster than solving
_INFINITE = 1e200  # the standard deviation of a target that is missing
_SOUND = 1e-8  # least ratio of squared pivots with which an inverse costs no digit that counts


class Factors(NamedTuple):
    r"""The Cholesky factor L of ``n`` points by its blocks of rows, and the weights.

    It is solved with, not inverted, which would take as long: where there is no noise, its inverse
    would leave no digit of a posterior variance.

    Args:
        base: The first ``n_0`` rows without their zeros, ``... x n_0 x n_0``. Missing observations
            have an infinite variance, so that covariances with these do not count.
        rows: The other rows, ``... x (n - n_0) x n``; one base serves a batch of them.
        alpha: The weights :math:`K^{-1} (y - m)`, ``... x n``.
    """

    base: Tensor
    rows: Tensor
    alpha: Tensor

    @classmethod
    def of(cls, covariance: Tensor, residual: Tensor) -> Factors:
        """Factorise a covariance with noise, ``... x n x n``, which is overwritten.

        The residual is the targets less their prior mean, ``... x n``; NaN where one is missing.
        """
        observed = ~residual.isnan()
        chol, failed = cholesky(covariance, None if observed.all() else observed)
        if failed.any():
            raise NotPSDError(
                "The covariance of the training targets has no Cholesky factor, with any nugget: "
                "some hyper-parameter is not finite."
            )
        chol = _without(chol, observed)
        alpha = torch.cholesky_solve(residual.nan_to_num(nan=0.0).unsqueeze(-1), chol)
        return cls(chol, chol[..., :0, :], alpha.squeeze(-1))

    def whiten(self, covariance: Tensor) -> Tensor:
        r"""Return :math:`A L^{-T}` for :math:`A`, ``... x q x n``."""
        n_0 = self.base.shape[-1]
        first = batched_solve(covariance[..., :n_0], self.base.mT, upper=True)
        if not self.rows.shape[-2]:
            return first
        rest = covariance[..., n_0:] - batched_product(first, self.rows[..., :n_0].mT)
        rest = batched_solve(rest, self.rows[..., n_0:].mT, upper=True)
        return torch.cat([first.expand(*rest.shape[:-1], n_0), rest], dim=-1)

    def solve(self, residual: Tensor) -> Tensor:
        """Return :math:`K^{-1} r` for r, ``... x n``."""
        return self.unwhiten(self.whiten(residual.unsqueeze(-2))).squeeze(-2)

    def unwhiten(self, white: Tensor) -> Tensor:
        r"""Return :math:`A L^{-1}` for :math:`A`, ``... x q x n``."""
        n_0 = self.base.shape[-1]
        first, rest = white[..., :n_0], white[..., n_0:]
        if rest.shape[-1]:
            rest = batched_solve(rest, self.rows[..., n_0:], upper=False)
            first = first - batched_product(rest, self.rows[..., :n_0])
        return torch.cat([batched_solve(first, self.base, upper=False), rest], dim=-1)

    def squared_columns(self) -> Tensor:
        """The diagonal of the inverse covariance, ``... x n``; zero for missing observations."""
        identity = torch.eye(self.alpha.shape[-1]).to(self.base)
        return self.whiten(identity).square().sum(-1)

    def variance(self) -> Tensor:
        """The diagonal of the covariance that was factorised, ``... x n``."""
        rows = self.rows.square().sum(-1)
        base = self.base.square().sum(-1)
        return torch.cat([base.expand(*rows.shape[:-1], base.shape[-1]), rows], dim=-1)

    def append(self, cross: Tensor, corner: Tensor, residual: Tensor) -> Factors:
        """Return the factors with ``k`` more points.

        They have covariances ``cross`` with the old ones, ``... x k x n``, and ``corner``, noise
        included; the residual is the new targets less their prediction by the old ones.
        """
        n, k = cross.shape[-1], cross.shape[-2]
        observed = ~residual.isnan()
        residual = residual.nan_to_num(nan=0.0).unsqueeze(-1)
        if observed.all():
            observed = observed.new_ones(k)  # without the fantasies' dimension: they share factors
        else:
            cross = cross * observed.unsqueeze(-1)
        border = self.whiten(cross)
        corner = corner + nugget(n + k) * torch.diag_embed(corner.diagonal(dim1=-1, dim2=-2))
        chol, _ = cholesky(corner - border @ border.mT, None if observed.all() else observed, n + k)
        chol = _without(chol, observed).expand(*border.shape[:-1], k)
        rows = torch.cat([border, chol], dim=-1)
        before = torch.nn.functional.pad(self.rows, (0, k))
        rows = torch.cat([before.expand(*rows.shape[:-2], -1, -1), rows], dim=-2)
        last = torch.cholesky_solve(residual, chol).mT
        first = self.alpha - self.unwhiten(last @ border).squeeze(-2)
        return Factors(self.base, rows, torch.cat([first, last.squeeze(-2)], dim=-1))


def _without(chol: Tensor, observed: Tensor) -> Tensor:
    """A Cholesky factor with an infinite variance of what is not observed, ``... x n``."""
    if observed.all():
        return chol
    return chol + torch.diag_embed((~observed).to(chol) * _INFINITE)


def batched_solve(left: Tensor, right: Tensor, upper: bool) -> Tensor:
    """``left`` times the inverse of a triangular ``right``, as :func:`batched_product`."""
    solve = partial(torch.linalg.solve_triangular, upper=upper, left=False)
    return _stacked(lambda rows: solve(right, rows), left, right)


def batched_product(left: Tensor, right: Tensor) -> Tensor:
    """The product of ``e x batch x q x n`` with ``batch x n x p``, which is not copied ``e`` times.

    Other shapes broadcast as ever.
    """
    return _stacked(lambda rows: rows @ right, left, right)


def _stacked(change: Callable[[Tensor], Tensor], left: Tensor, right: Tensor) -> Tensor:
    """Change the rows of ``left``, with those that meet the same matrix of ``right`` in one."""
    extra = left.dim() - right.dim()
    if extra <= 0 or left.shape[extra:-2] != right.shape[:-2]:
        return change(left)
    lead, (q, n) = left.shape[:extra], left.shape[-2:]
    rows = left.flatten(0, extra - 1).movedim(0, -3)
    changed = change(rows.reshape(*right.shape[:-2], lead.numel() * q, n))
    return changed.unflatten(-2, (lead.numel(), q)).movedim(-3, 0).unflatten(0, lead)


def conditional_covariance(prior: Tensor, root: Tensor) -> Tensor:
    """A prior covariance ``... x q x q`` less what a root ``... x q x n`` of it says is known."""
    least = least_variance(prior.diagonal(dim1=-1, dim2=-2), root.shape[-1])
    covariance = prior - root @ root.mT
    excess = (least - covariance.detach().diagonal(dim1=-1, dim2=-2)).clamp_min(0)
    return covariance + torch.diag_embed(excess) if excess.any() else covariance


def least_variance(prior_variance: Tensor, n: int) -> Tensor:
    """Return the variance that rounding errors leave at a point that is known without noise."""
    return (4 * n * torch.finfo(prior_variance.dtype).eps * prior_variance).detach()


class ExactConditioning(DefaultPredictionStrategy):
    r"""Posterior given ``n`` noisy targets, by two factors that new targets only border.

    With the covariance :math:`K = L L^T` of the targets y and their prior mean m, they are L and
    :math:`\alpha = K^{-1} (y - m)` (Rasmussen and Williams 2006, sec. 2.2). For ``k`` further
    observations of cross-covariance U and covariance S, with residual
    :math:`r = y' - m' - U^T \alpha`,

    .. math::

        B = L^{-1} U, \quad C C^T = S - B^T B, \quad
        L \leftarrow \begin{bmatrix} L & 0 \\ B^T & C \end{bmatrix}, \quad
        v = (C C^T)^{-1} r, \quad
        \alpha \leftarrow \begin{bmatrix} \alpha - L^{-T} B v \\ v \end{bmatrix},

    which takes :math:`O(n^2 k)` operations where GPyTorch refactorises in :math:`O(n^3)`. It is
    GPyTorch's prediction strategy of a model, ``model.prediction_strategy``, and dies with that.
    """

    def __init__(self, inputs: Tensor, targets: Tensor, noise: Noise, kernel: SumOfTerms) -> None:
        # GPyTorch's own makes lazy covariances that are not needed here.
        self.train_inputs = [inputs]
        self.targets = targets
        self.noise = noise
        self.kernel = kernel
        self.train_prior_dist = None  # of which GPyTorch asks whether its outputs are correlated
        self._train_shape = inputs.shape[-2:-1]
        self._remembered: WeightedSum | None = None
        self._factors: Factors | None = None
        self._inverse: Tensor | Literal[False] | None = None  # False: it would cost digits

    @property
    def has_graph(self) -> bool:
        """True if gradients flow to the memory, which is then built again each time."""
        wanted = detach_test_caches.off() or self.train_inputs[0].requires_grad
        return torch.is_grad_enabled() and wanted

    @property
    def train(self) -> WeightedSum:
        """The sum at the training inputs."""
        if self.has_graph:
            return self.kernel.at(self.train_inputs[0])
        if self._remembered is None:
            with torch.no_grad():
                self._remembered = self.kernel.at(self.train_inputs[0])
        return self._remembered

    def target_noise(self) -> Tensor:
        """The noise variances of the targets, ``... x n``."""
        return self.noise.of_rows(self.noise.at(self.train_inputs[0]))

    @property
    def mean_cache(self) -> Tensor:
        r"""The weights :math:`\alpha` of the mean, under the name that GPyTorch reads."""
        return self.factors().alpha

    def factors(self) -> Factors:
        """Return the factors, computed at the first call."""
        found = self._factors
        if found is not None and (
            not self.has_graph or found.alpha.requires_grad or found.rows.shape[-2]
        ):
            return found
        with torch.set_grad_enabled(torch.is_grad_enabled() and detach_test_caches.off()):
            train = self.kernel.at(self.train_inputs[0])
            covariance = train.covariance(self.kernel.known_means)
            noise = self.noise.of_rows(self.noise.at(train.x))
            # Not in place: kernels may share memory with what they return.
            covariance = covariance + torch.diag_embed(noise)
            factors = Factors.of(covariance, self.targets - train.mean())
        for factor in (factors.base, factors.alpha):
            if factor.grad_fn is not None:
                # A backward pass frees the graph that a later prediction would need.
                factor.grad_fn.register_hook(self._forget)
        self._factors = factors
        self._inverse = None
        return factors

    def marginals(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means and variances at each point by itself, ``... x q``."""
        mean, cross = self._mean(sought)
        prior = sought.variance(data=None if self.has_graph else self.train)
        factors = self.factors()
        if self._inverse is None:
            self._inverse = _inverse(factors)
        # For few points with noise by the inverse, which is faster.
        if self._inverse is False or factors.base.requires_grad:
            white = factors.whiten(cross)
        else:
            white = batched_product(cross, self._inverse.mT)
        known = torch.linalg.vector_norm(white, dim=-1).square()
        return mean, (prior - known).maximum(least_variance(prior, self.num_train))

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means ``... x q`` and covariances ``... x q x q``."""
        mean, cross = self._mean(sought)
        covariance = conditional_covariance(sought.covariance(), self.factors().whiten(cross))
        return mean, covariance.expand(*mean.shape, mean.shape[-1])

    def pathwise_update(self, prior: Tensor) -> Tensor:
        r"""The weights :math:`K^{-1} (y - f - \varepsilon)` that make functions meet the data.

        Matheron's rule (Wilson et al. 2020): a function f from the prior (here at the training
        inputs, ``k x ... x n``), plus its covariances with the data times these weights, is one
        from the posterior. They are zero where an observation is missing.
        """
        (train,) = self.train_inputs
        # What the factors have beside the prior: the noise, and their nugget.
        added = self.factors().variance() - self.train.variance(self.kernel.known_means)
        draws = torch.randn(len(prior), *train.shape[:-2], self.targets.shape[-1]).to(train)
        noise = added.maximum(self.target_noise()).sqrt() * draws
        return self.factors().solve((self.targets - prior - noise).nan_to_num(nan=0.0))

    def exact_predictive_mean(
        self, test_mean: Tensor, test_train_covar: Tensor | LinearOperator
    ) -> Tensor:
        """GPyTorch's hook for the posterior mean."""
        cross = test_train_covar
        return test_mean + (cross @ self.mean_cache.unsqueeze(-1)).squeeze(-1)

    def exact_predictive_covar(
        self, test_test_covar: Tensor | LinearOperator, test_train_covar: Tensor | LinearOperator
    ) -> LinearOperator:
        """GPyTorch's hook for the posterior covariance, ``... x q x q``."""
        if skip_posterior_variances.on():
            return ZeroLinearOperator(*test_test_covar.shape)
        white = self.factors().whiten(to_dense(test_train_covar))
        return to_linear_operator(conditional_covariance(to_dense(test_test_covar), white))

    def get_fantasy_strategy(
        self,
        inputs: list[Tensor],
        targets: Tensor,
        full_inputs: list[Tensor],
        full_targets: Tensor,
        full_output: MultivariateNormal,
        **kwargs: Any,
    ) -> ExactConditioning:
        """GPyTorch's hook for ``k`` further observations.

        Targets are ``(f) x ... x k``; with a dimension of fantasies ``f`` that the inputs lack, all
        fantasies share one factor. Of known noise ``kwargs`` has the variances, ``... x k``.
        """
        n = self.num_train
        train = self.kernel.at(full_inputs[0][..., :n, :])
        new = self.kernel.at(full_inputs[0][..., n:, :])
        noise = self.noise.after(**kwargs)
        cross = new.cross(train)
        corner = new.covariance() + torch.diag_embed(noise.at(new.x, **kwargs))
        residual = targets - self.exact_predictive_mean(full_output.mean[..., n:], cross)
        factors = self.factors().append(cross, corner, residual)
        if detach_test_caches.on():
            factors = Factors(*(factor.detach() for factor in factors))
        strategy = type(self)(full_inputs[0], full_targets, noise, self.kernel)
        strategy._factors = factors
        return strategy

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Pickle as nothing, as it is copied: it can be made again from the model."""
        return type(None), ()

    def _mean(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Posterior means of a sum, and its covariances with the data."""
        cross = sought.cross(self.train, is_data=not self.has_graph)
        return self.exact_predictive_mean(sought.mean(), cross), cross

    def _forget(self, *gradients: Any) -> None:
        self._factors = None


def _inverse(factors: Factors) -> Tensor | Literal[False]:
    """The inverse of a factor of few points, where it costs no digits."""
    base = factors.base.detach()
    pivots = base.diagonal(dim1=-1, dim2=-2).square()
    largest = pivots.where(pivots < _INFINITE, torch.zeros_like(pivots)).amax(-1)
    few = base.shape[-1] <= _FEW and not factors.rows.shape[-2]
    if not few or not (pivots.amin(-1) > _SOUND * largest).all():
        return False
    identity = torch.eye(base.shape[-1]).to(base).expand_as(base)
    return torch.linalg.solve_triangular(base, identity, upper=False)
