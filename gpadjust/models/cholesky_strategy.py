"""What a Gaussian process remembers of its training data to predict from."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import Kernel
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from gpytorch.models.exact_prediction_strategies import DefaultPredictionStrategy
from gpytorch.settings import (
    detach_test_caches,
    lazily_evaluate_kernels,
    skip_posterior_variances,
)
from linear_operator import to_dense, to_linear_operator
from linear_operator.operators import (
    DiagLinearOperator,
    LinearOperator,
    MatmulLinearOperator,
    ZeroLinearOperator,
)
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor


class Factors(NamedTuple):
    r"""The inverse Cholesky factor of ``n`` points by its blocks of rows, and the weights.

    Args:
        base: The first ``n_0`` rows without their zeros, ``... x n_0 x n_0``.
        rows: The other rows, ``... x (n - n_0) x n``; one base serves a batch of them.
        alpha: The weights :math:`K^{-1} (y - m)`, ``... x n``.
    """

    base: Tensor
    rows: Tensor
    alpha: Tensor

    def whiten(self, covariance: Tensor) -> Tensor:
        r"""Return :math:`A L^{-T}` for :math:`A`, ``... x q x n``."""
        first = batched_product(covariance[..., : self.base.shape[-1]], self.base.mT)
        if not self.rows.shape[-2]:
            return first
        rest = batched_product(covariance, self.rows.mT)
        shape = torch.broadcast_shapes(first.shape[:-1], rest.shape[:-1])
        return torch.cat([first.expand(*shape, -1), rest.expand(*shape, -1)], dim=-1)

    def append(self, cross: Tensor, corner: Tensor, residual: Tensor) -> Factors:
        """Return the factors with ``k`` more points.

        Args:
            cross: Covariances of the new points with the old ones, ``... x k x n``.
            corner: Covariance of the new targets, noise included, ``... x k x k``.
            residual: New targets less their prediction by the old ones, ``... x k``.
        """
        n_0, n, k = self.base.shape[-1], *cross.shape[-1:], cross.shape[-2]
        border = self.whiten(cross)
        chol = psd_safe_cholesky(corner - border @ border.mT)
        row = pad(batched_product(border[..., :n_0], self.base), n - n_0)
        if self.rows.shape[-2]:
            row = row + border[..., n_0:] @ self.rows
        identity = torch.eye(k, dtype=chol.dtype, device=chol.device).expand_as(chol)
        row = torch.linalg.solve_triangular(chol, torch.cat([-row, identity], -1), upper=False)
        rows = torch.cat([pad(self.rows, k).expand(*row.shape[:-2], -1, -1), row], dim=-2)
        whitened = row[..., n:] @ residual.unsqueeze(-1)
        return Factors(self.base, rows, pad(self.alpha, k) + (row.mT @ whitened).squeeze(-1))


def pad(tensor: Tensor, k: int) -> Tensor:
    """Append ``k`` zeros to the last dimension."""
    return torch.nn.functional.pad(tensor, (0, k))


def batched_product(left: Tensor, right: Tensor) -> Tensor:
    """The product of ``e x batch x q x n`` with ``batch x n x p``, which is not copied ``e`` times.

    Other shapes broadcast as ever.
    """
    extra = left.dim() - right.dim()
    if extra <= 0 or right.dim() == 2 or left.shape[extra:-2] != right.shape[:-2]:
        return left @ right
    lead, (q, n) = left.shape[:extra], left.shape[-2:]
    batch, e = right.shape[:-2], lead.numel()
    stacked = left.flatten(0, extra - 1).movedim(0, -3)
    product = stacked.reshape(*batch, e * q, n) @ right
    product = product.reshape(*batch, e, q, right.shape[-1])
    return product.movedim(-3, 0).unflatten(0, lead)


class CholeskyStrategy(DefaultPredictionStrategy):
    r"""GPyTorch's exact prediction from two cached factors, which new points only border.

    With the covariance :math:`K = L L^T` of the ``n`` noisy targets y and their prior mean m, the
    factors are :math:`L^{-1}` and :math:`\alpha = K^{-1} (y - m)` (Rasmussen and Williams 2006,
    sec. 2.2). For ``k`` further observations of cross-covariance U and covariance S, with residual
    :math:`r = y' - m' - U^T \alpha`,

    .. math::

        B = L^{-1} U, \quad C C^T = S - B^T B, \quad
        M = C^{-1} \begin{bmatrix} -B^T L^{-1} & I \end{bmatrix}, \quad
        L^{-1} \leftarrow \begin{bmatrix} L^{-1} \; 0 \\ M \end{bmatrix}, \quad
        \alpha \leftarrow \begin{bmatrix} \alpha \\ 0 \end{bmatrix} + M^T C^{-1} r,

    which takes :math:`O(n^2 k)` operations where GPyTorch refactorises in :math:`O(n^3)`. The
    factors live and die with the strategy, that is with ``model.prediction_strategy``.
    """

    def __init__(
        self,
        train_inputs: list[Tensor],
        train_prior_dist: MultivariateNormal,
        train_labels: Tensor,
        likelihood: _GaussianLikelihoodBase,
    ) -> None:
        # GPyTorch's own makes lazy covariances that are not needed here.
        self.train_inputs = train_inputs
        self.train_prior_dist = train_prior_dist
        self.train_labels = train_labels
        self.likelihood = likelihood
        self._train_shape = train_prior_dist.event_shape
        self._factors: Factors | None = None

    def factors(self) -> Factors:
        """Return the factors, computed at the first call."""
        if self._factors is None:
            self._factors = self._factorise()
        return self._factors

    def _factorise(self) -> Factors:
        with torch.set_grad_enabled(torch.is_grad_enabled() and detach_test_caches.off()):
            # Not from the lazy covariances at hand, which would keep a matrix each.
            prior_mean, kernel = self.train_prior_dist.mean, self._kernel
            with lazily_evaluate_kernels(False):
                prior = MultivariateNormal(prior_mean, kernel(self.train_inputs[0]))
            noisy = self.likelihood(prior, self.train_inputs).lazy_covariance_matrix
            chol = psd_safe_cholesky(to_dense(noisy))
            identity = torch.eye(chol.shape[-1], dtype=chol.dtype, device=chol.device)
            inverse = torch.linalg.solve_triangular(chol, identity, upper=False)
            residual = self.train_labels - prior_mean
            whitened = inverse @ residual.unsqueeze(-1)
            alpha = (inverse.mT @ whitened).squeeze(-1)
        for factor in (inverse, alpha):
            if factor.grad_fn is not None:
                # A backward pass frees the graph that a later prediction would need.
                factor.grad_fn.register_hook(self._forget)
        return Factors(inverse, inverse[..., :0, :], alpha)

    @property
    def _kernel(self) -> Kernel:
        return self.train_prior_dist.lazy_covariance_matrix.kernel

    @property
    def mean_cache(self) -> Tensor:
        r"""The weights :math:`\alpha` of the mean, under the name that GPyTorch reads."""
        return self.factors().alpha

    def _forget(self, *gradients: Any) -> None:
        self._factors = None

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Pickle as nothing, as it is copied: it can be made again from the model."""
        return type(None), ()

    def exact_predictive_mean(
        self, test_mean: Tensor, test_train_covar: Tensor | LinearOperator
    ) -> Tensor:
        """Return the posterior mean, ``... x q``."""
        mean: Tensor = (test_train_covar @ self.mean_cache.unsqueeze(-1)).squeeze(-1)
        return test_mean + mean

    def exact_predictive_covar(
        self, test_test_covar: Tensor | LinearOperator, test_train_covar: Tensor | LinearOperator
    ) -> LinearOperator:
        """Return the posterior covariance, ``... x q x q``."""
        if skip_posterior_variances.on():
            return ZeroLinearOperator(*test_test_covar.shape)
        root = self.factors().whiten(to_dense(test_train_covar))
        prior_variance = test_test_covar.diagonal(dim1=-1, dim2=-2)
        variance = (prior_variance - root.square().sum(-1)).detach()
        excess = (self._least_variance(prior_variance) - variance).clamp_min(0)
        if isinstance(test_test_covar, Tensor):
            covariance = to_linear_operator(test_test_covar - root @ root.mT)
        else:
            covariance = test_test_covar + MatmulLinearOperator(root, -root.mT)
        return covariance + DiagLinearOperator(excess) if excess.any() else covariance

    def marginals(
        self, prior_mean: Tensor, prior_variance: Tensor, covariance: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Predict each point by itself.

        Args:
            prior_mean: Prior means, ``... x q``.
            prior_variance: Prior variances, ``... x q``.
            covariance: Covariances with the training points, ``... x q x n``.

        Returns:
            Posterior means and variances, ``... x q`` each.
        """
        variance = prior_variance - self.factors().whiten(covariance).square().sum(-1)
        variance = variance.clamp_min(self._least_variance(prior_variance))
        return self.exact_predictive_mean(prior_mean, covariance), variance

    def _least_variance(self, prior_variance: Tensor) -> Tensor:
        """What rounding errors leave of a variance at a point that is known without noise."""
        eps = torch.finfo(prior_variance.dtype).eps
        return (4 * self.num_train * eps * prior_variance).detach()

    def get_fantasy_strategy(
        self,
        inputs: list[Tensor],
        targets: Tensor,
        full_inputs: list[Tensor],
        full_targets: Tensor,
        full_output: MultivariateNormal,
        **kwargs: Any,
    ) -> CholeskyStrategy:
        """Return the strategy with ``k`` further observations; GPyTorch's hook for conditioning.

        Args:
            inputs: Transformed new inputs, one tensor ``... x k x d``.
            targets: New targets, ``(f) x ... x k``; with a dimension of fantasies ``f`` that the
                inputs lack, all fantasies share one factor.
            full_inputs: All inputs, ``... x (n + k) x d``.
            full_targets: All targets, ``(f) x ... x (n + k)``.
            full_output: The prior at all inputs.
            kwargs: ``noise``, the known variances of the new observations, ``... x k``.
        """
        n = self.num_train
        kernel = self._kernel
        train, new = full_inputs[0][..., :n, :], full_inputs[0][..., n:, :]
        with lazily_evaluate_kernels(False):
            cross, corner = to_dense(kernel(new, train)), kernel(new, new)
        likelihood = self.likelihood.get_fantasy_likelihood(**kwargs)
        prior = MultivariateNormal(full_output.mean[..., n:], corner)
        corner = likelihood(prior, inputs, **kwargs).covariance_matrix

        residual = targets - self.exact_predictive_mean(prior.mean, cross)
        factors = self.factors().append(cross, corner, residual)
        if detach_test_caches.on():
            factors = Factors(*(factor.detach() for factor in factors))
        strategy = type(self)(full_inputs, full_output, full_targets, likelihood)
        strategy._factors = factors
        return strategy
