"""What a Gaussian process remembers of its training data to predict from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from gpytorch.models.exact_prediction_strategies import DefaultPredictionStrategy
from gpytorch.settings import detach_test_caches, skip_posterior_variances
from linear_operator import to_dense, to_linear_operator
from linear_operator.operators import LinearOperator, ZeroLinearOperator
from linear_operator.utils.errors import NotPSDError
from torch import Tensor

from gpadjust.gp import SumOfTerms, Term, TermsMean
from gpadjust.gp.gaussian import cholesky, noise_variances, nugget, scaled

_FEW = 256  # points up to which a product is faster than solving
_INFINITE = 1e200  # the standard deviation of a target that is missing
_SOUND = 1e-8  # least ratio of squared pivots with which an inverse costs no digit that counts

Weights = list[tuple[Term, Tensor | None]]
"""Terms and what each is multiplied by, ``... x n``, or None for 1."""


class PreparedTerms(NamedTuple):
    """What is remembered of some unknown terms and the training data, to predict from.

    Attributes:
        terms: The terms.
        train: The transformed training inputs, ``... x n x (d + k)``.
        origin: Their mean, ``... x 1 x d``.
        stack: Of the terms with scaled RBF kernels, what makes the logarithms of covariances with
            the data (:meth:`Term.log_covariance_with`), ``... x T x (2 d + 1) x n``.
        stacked: The names of these.
        bases: The terms' bases at the data, ``... x n``, or None for 1.
        variances: Their prior variances, ``... x 1``, or None where these are not the same
            everywhere.
    """

    terms: list[Term]
    train: Tensor
    origin: Tensor
    stack: Tensor | None
    stacked: list[str]
    bases: list[Tensor | None]
    variances: list[Tensor | None]


def prepare(terms: list[Term], train: Tensor, with_graph: bool = False) -> PreparedTerms:
    """Prepare some terms, at training inputs ``... x n x (d + k)``, by autograd or faster."""
    origin = train[..., : max((t.num_inputs for t in terms), default=0)].mean(-2, keepdim=True)
    found = [] if with_graph else terms
    matrices = {term.name: term.log_covariance_with(train, origin) for term in found}
    stacked = {name: matrix for name, matrix in matrices.items() if matrix is not None}
    stack = torch.stack(torch.broadcast_tensors(*stacked.values()), -3) if stacked else None
    bases = [term.weights(train) for term in terms]
    variances = [None if with_graph else term.variance() for term in terms]
    return PreparedTerms(terms, train, origin, stack, [*stacked], bases, variances)


def covariances(data: PreparedTerms, inputs: Tensor) -> list[Tensor]:
    """The covariances of terms with those at the data, without bases, ``... x q x n`` each."""
    values: Tensor | None = None
    if data.stack is not None:
        x = inputs[..., : data.origin.shape[-1]] - data.origin
        left = torch.cat([x, x.square(), torch.ones_like(x[..., :1])], dim=-1)
        values = (left.unsqueeze(-3) @ data.stack).exp_()
    parts = []
    for term in data.terms:
        if values is None or term.name not in data.stacked:
            part = term.covariance(inputs, data.train)
        else:
            part = values.select(-3, data.stacked.index(term.name))
            if term.learns_mean:
                part = part + term.mean_variance.detach().unsqueeze(-1)
        parts.append(part)
    return parts


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
        return self._unwhiten(self.whiten(residual.unsqueeze(-2))).squeeze(-2)

    def _unwhiten(self, white: Tensor) -> Tensor:
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

    def append(self, cross: Tensor, corner: Tensor, residual: Tensor) -> Factors:
        """Return the factors with ``k`` more points.

        Args:
            cross: Covariances of the new points with the old ones, ``... x k x n``.
            corner: Covariance of the new targets, noise included, ``... x k x k``.
            residual: New targets less their prediction by the old ones, ``... x k``; NaN where one
                is missing.
        """
        n, k = cross.shape[-1], cross.shape[-2]
        observed = ~residual.isnan()
        residual = residual.nan_to_num(nan=0.0).unsqueeze(-1)
        if observed.all():
            observed = observed.new_ones(k)  # without the fantasies' dimension: they share factors
        else:
            cross = cross * observed.unsqueeze(-1)
        border = self.whiten(cross)
        size = corner.diagonal(dim1=-1, dim2=-2).mean(-1)
        identity = torch.eye(k, dtype=corner.dtype, device=corner.device)
        corner = corner + nugget(n + k) * size[..., None, None] * identity
        chol, _ = cholesky(corner - border @ border.mT, None if observed.all() else observed, n + k)
        chol = _without(chol, observed).expand(*border.shape[:-1], k)
        rows = torch.cat([border, chol], dim=-1)
        rows = torch.cat([pad(self.rows, k).expand(*rows.shape[:-2], -1, -1), rows], dim=-2)
        last = torch.cholesky_solve(residual, chol).mT
        first = self.alpha - self._unwhiten(last @ border).squeeze(-2)
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


def pad(tensor: Tensor, k: int) -> Tensor:
    """Append ``k`` zeros to the last dimension."""
    return torch.nn.functional.pad(tensor, (0, k))


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
    """What rounding errors leave of a variance at a point that is known without noise."""
    return (4 * n * torch.finfo(prior_variance.dtype).eps * prior_variance).detach()


class CholeskyStrategy(DefaultPredictionStrategy):
    r"""GPyTorch's exact prediction from two cached factors, which new points only border.

    With the covariance :math:`K = L L^T` of the ``n`` noisy targets y and their prior mean m, the
    factors are L and :math:`\alpha = K^{-1} (y - m)` (Rasmussen and Williams 2006,
    sec. 2.2). For ``k`` further observations of cross-covariance U and covariance S, with residual
    :math:`r = y' - m' - U^T \alpha`,

    .. math::

        B = L^{-1} U, \quad C C^T = S - B^T B, \quad
        L \leftarrow \begin{bmatrix} L & 0 \\ B^T & C \end{bmatrix}, \quad
        v = (C C^T)^{-1} r, \quad
        \alpha \leftarrow \begin{bmatrix} \alpha - L^{-T} B v \\ v \end{bmatrix},

    which takes :math:`O(n^2 k)` operations where GPyTorch refactorises in :math:`O(n^3)`. The
    factors live and die with the strategy, that is with ``model.prediction_strategy``.
    """

    def __init__(
        self,
        train_inputs: list[Tensor],
        train_prior_dist: MultivariateNormal,
        train_labels: Tensor,
        likelihood: _GaussianLikelihoodBase,
        kernel: SumOfTerms,
    ) -> None:
        # GPyTorch's own makes lazy covariances that are not needed here.
        self.train_inputs = train_inputs
        self.train_prior_dist = train_prior_dist
        self.train_labels = train_labels
        self.likelihood = likelihood
        self.kernel = kernel
        self._train_shape = train_prior_dist.event_shape
        self._factors: Factors | None = None
        self.kept: dict[str, Any] = {}  # what else a model makes of the same data
        self._terms: dict[tuple[str, ...], PreparedTerms] = {}

    def factors(self) -> Factors:
        """Return the factors, computed at the first call."""
        found = self._factors
        if found is not None and (
            not self.has_graph or found.alpha.requires_grad or found.rows.shape[-2]
        ):
            return found
        with torch.set_grad_enabled(torch.is_grad_enabled() and detach_test_caches.off()):
            # Not from the lazy covariances at hand, which would keep a matrix each.
            residual = self.train_labels - TermsMean(self.kernel)(self.train_inputs[0])
            factors = Factors.of(self.noisy_covariance(self.kernel), residual)
        for factor in (factors.base, factors.alpha):
            if factor.grad_fn is not None:
                # A backward pass frees the graph that a later prediction would need.
                factor.grad_fn.register_hook(self._forget)
        self._factors = factors
        return factors

    def pathwise_update(self, prior: Tensor) -> Tensor:
        r"""The weights :math:`K^{-1} (y - f - \varepsilon)` that make functions meet the data.

        Matheron's rule (Wilson et al. 2020): a function f from the prior, plus its covariances with
        the data times these weights, is one from the posterior.

        Args:
            prior: Functions from the prior at the training inputs, ``k x ... x n``.

        Returns:
            ``k x ... x n``; zero where an observation is missing.
        """
        (train,) = self.train_inputs
        sd = noise_variances(self.likelihood, train).sqrt()
        noise = sd * torch.randn(len(prior), *train.shape[:-1]).to(train)
        return self.factors().solve((self.train_labels - prior - noise).nan_to_num(nan=0.0))

    def noisy_covariance(self, kernel: SumOfTerms) -> Tensor:
        """The covariance of the targets under a kernel, noise included, ``... x n x n``."""
        (train,) = self.train_inputs
        return kernel.forward(train, train) + self.noise_covariance()

    def noise_covariance(self) -> Tensor:
        """The covariance of the training targets' noise, ``... x n x n``."""
        return torch.diag_embed(noise_variances(self.likelihood, self.train_inputs[0]))

    def cross_covariance(self, inputs: Tensor, weights: Weights) -> Tensor:
        """The covariance of a weighted sum of terms with the targets, ``... x q x n``."""
        unknown = [(term, weight) for term, weight in weights if not term.is_known]
        if not unknown:
            return inputs.new_zeros(*inputs.shape[:-1], self.num_train)
        data = self.prepared([term for term, _ in unknown])
        parts = covariances(data, inputs)
        for i, ((_, weight), basis) in enumerate(zip(unknown, data.bases, strict=True)):
            if basis is not None:
                parts[i] = scaled(parts[i], basis.unsqueeze(-2))
            if weight is not None:
                parts[i] = scaled(parts[i], weight.unsqueeze(-1))
        return sum(parts[1:], parts[0])

    def prepared(self, terms: list[Term]) -> PreparedTerms:
        """What is remembered of some unknown terms, and of the data."""
        (train,) = self.train_inputs
        if self.has_graph:
            return prepare(terms, train, with_graph=True)
        names = tuple(term.name for term in terms)
        if names not in self._terms:
            with torch.no_grad():
                self._terms[names] = prepare(terms, train)
        return self._terms[names]

    @property
    def has_graph(self) -> bool:
        """Whether gradients flow to what is remembered, which is then made anew each time."""
        wanted = detach_test_caches.off() or self.train_inputs[0].requires_grad
        return torch.is_grad_enabled() and wanted

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
        return test_mean + (test_train_covar @ self.mean_cache.unsqueeze(-1)).squeeze(-1)

    def exact_predictive_covar(
        self, test_test_covar: Tensor | LinearOperator, test_train_covar: Tensor | LinearOperator
    ) -> LinearOperator:
        """Return the posterior covariance, ``... x q x q``."""
        if skip_posterior_variances.on():
            return ZeroLinearOperator(*test_test_covar.shape)
        prior = to_dense(test_test_covar)
        root = self.factors().whiten(to_dense(test_train_covar))
        return to_linear_operator(conditional_covariance(prior, root))

    def marginals(self, inputs: Tensor, weights: Weights, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Posterior means and variances of a weighted sum of terms at each point by itself.

        All are ``... x q``, as the prior mean of the sum is; the inputs are ``... x q x d``.
        """
        unknown = [(term, weight) for term, weight in weights if not term.is_known]
        if not unknown:
            return mean, torch.zeros_like(mean)
        data, prior = self.prepared([term for term, _ in unknown]), inputs.new_zeros(())
        for (term, weight), variance in zip(unknown, data.variances, strict=True):
            part = term.covariance(inputs, inputs, diag=True) if variance is None else variance
            prior = prior + (part if weight is None else part * weight.square())
        cross = self.cross_covariance(inputs, weights)
        return self.exact_predictive_mean(mean, cross), self._reduced(prior, cross)

    def _reduced(self, prior: Tensor, cross: Tensor) -> Tensor:
        """Prior variances ``... x q`` less what covariances with the data say is known."""
        known = torch.linalg.vector_norm(self._whiten(cross), dim=-1).square()
        return (prior - known).maximum(least_variance(prior, self.num_train))

    def _whiten(self, cross: Tensor) -> Tensor:
        """As that of the factors; for few points with noise by the inverse, which is faster."""
        factors = self.factors()
        if "inverse" not in self.kept:
            base = factors.base.detach()
            pivots = base.diagonal(dim1=-1, dim2=-2).square()
            largest = pivots.where(pivots < _INFINITE, torch.zeros_like(pivots)).amax(-1)
            sound = (pivots.amin(-1) > _SOUND * largest).all()
            few = base.shape[-1] <= _FEW and not factors.rows.shape[-2]
            inverse = None
            if sound and few:
                identity = torch.eye(base.shape[-1]).to(base).expand_as(base)
                inverse = torch.linalg.solve_triangular(base, identity, upper=False)
            self.kept["inverse"] = inverse
        inverse = None if factors.base.requires_grad else self.kept["inverse"]
        return factors.whiten(cross) if inverse is None else batched_product(cross, inverse.mT)

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
            inputs: Transformed new inputs, one tensor ``... x k x d``; not used.
            targets: New targets, ``(f) x ... x k``; with a dimension of fantasies ``f`` that the
                inputs lack, all fantasies share one factor.
            full_inputs: All inputs, one tensor ``... x (n + k) x d``.
            full_targets: All targets, ``(f) x ... x (n + k)``.
            full_output: The prior at all inputs.
            kwargs: ``noise``, the known variances of the new observations, ``... x k``.
        """
        n, kernel = self.num_train, self.kernel
        train, new = full_inputs[0][..., :n, :], full_inputs[0][..., n:, :]
        likelihood = self.likelihood.get_fantasy_likelihood(**kwargs)
        cross = kernel.forward(new, train)
        noise = noise_variances(likelihood, new, **kwargs)
        corner = kernel.forward(new, new) + torch.diag_embed(noise)
        residual = targets - self.exact_predictive_mean(full_output.mean[..., n:], cross)
        factors = self.factors().append(cross, corner, residual)
        if detach_test_caches.on():
            factors = Factors(*(factor.detach() for factor in factors))
        strategy = type(self)(full_inputs, full_output, full_targets, likelihood, kernel)
        strategy._factors = factors
        return strategy
