"""The evidence lower bound of a model with inducing points, at its optimal distribution."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.gp import TermsMean
from gpadjust.inference.log_parameters import LogParameters, Parameters
from gpadjust.inference.log_priors import LogPriors
from gpadjust.models import CKA
from gpadjust.models.inducing_values import inducing_root

_Pair = tuple[Tensor, Tensor]
_Call = Callable[[Callable[[], _Pair]], _Pair]
_AT_ONCE = 2**22  # covariances of inducing values with observations that are in memory


class Observations(NamedTuple):
    """Noisy observations of a sum of terms.

    Attributes:
        inputs: Transformed inputs with columns of f_p, ``n x (d + k)``.
        residual: Targets less their prior mean, ``(m) x n``; 0 where one is missing.
        weight: Of each, ``(m) x n``: the noise variance is s over it, 0 where one is missing.
    """

    inputs: Tensor
    residual: Tensor
    weight: Tensor

    def rows(self, which: Tensor | slice) -> Observations:
        """Some of them."""
        return Observations(self.inputs[which], self.residual[..., which], self.weight[..., which])

    def parts(self, num_inducing: int) -> Iterator[Observations]:
        """All of them in parts that fit in memory."""
        batch = max(1, self.residual.numel() // max(1, self.residual.shape[-1]))
        size = max(1, _AT_ONCE // (num_inducing * batch))
        for start in range(0, len(self.inputs), size):
            yield self.rows(slice(start, start + size))


class Optimum(NamedTuple):
    """The optimal distribution of whitened inducing values, and what it is worth.

    Attributes:
        bound: The evidence lower bound, ``(m)``.
        mean: ``(m) x M``.
        root: A lower root of the covariance, ``(m) x M x M``.
    """

    bound: Tensor
    mean: Tensor
    root: Tensor


class Sums(NamedTuple):
    """What the bound reads of all observations, with v = L^-1 k of their covariances k.

    Attributes:
        square: The sum of w v v^T, ``(m) x M x M``.
        cross: The sum of w v r, ``(m) x M``.
        prior: The sum of w times the prior variance, ``(m)``.
    """

    square: Tensor
    cross: Tensor
    prior: Tensor


class CollapsedBound:
    r"""The negative evidence lower bound at the best distribution of the inducing values.

    For Gaussian noise that is known in closed form (Titsias 2009), a natural-gradient step of
    length one from anywhere (Hensman et al. 2013): with :math:`K_{uu} = L L^T` and
    :math:`v_i = L^{-1} k_i`, :math:`\Lambda = I + \sum_i w_i v_i v_i^T / s` and
    :math:`b = \sum_i w_i r_i v_i`, it is :math:`N(\Lambda^{-1} b / s, \Lambda^{-1})`. The sums are
    made of one part of the observations after the other, and so is the gradient, by autograd:
    memory does not grow with their number. (Sums of :math:`k_i k_i^T` would be faster, but their
    rounding errors, divided by the nugget of :math:`K_{uu}`, are larger than what the points tell
    where variances are far above the noise.)

    Args:
        start: The exact model whose hyper-parameters these are; its own data do not count.
        data: The observations that count.
        inducing_points: ``(m) x M x (d + k)``.

    Attributes:
        parameters: The vectors and their bounds.
    """

    def __init__(self, start: CKA, data: Observations, inducing_points: Tensor) -> None:
        start.train()
        self.parameters = LogParameters(start)
        self._start, self._data, self._points = start, data, inducing_points
        self._square = (data.weight * data.residual.square()).sum(-1)
        self._count = (data.weight > 0).sum(-1)
        self._log_weights = data.weight.where(data.weight > 0, torch.ones_like(data.weight))
        self._log_weights = self._log_weights.log().sum(-1)
        has_priors = next(iter(start.named_priors()), None) is not None
        self._priors = LogPriors(start, self.parameters) if has_priors else None

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective and its gradient, ``k x B`` and ``k x B x p``.

        It is infinite, with a gradient of zero, where a covariance has no Cholesky factor.
        """
        found = [self._at(vector.unsqueeze(0)) for vector in vectors]
        values, gradients = (torch.cat(each) for each in zip(*found, strict=True))
        if self._priors is not None:
            log_prior, slope = self._priors.with_gradient(vectors)
            values, gradients = values - log_prior, gradients - slope
        values = values.nan_to_num(math.inf, math.inf, math.inf)
        good = (values.isfinite() & gradients.isfinite().all(-1)).unsqueeze(-1)
        return values, torch.where(good, gradients, torch.zeros_like(gradients))

    @torch.no_grad()
    def optimum(self) -> Optimum:
        """The best distribution at the hyper-parameters that the model has."""
        root = inducing_root(self._inducing_covariance())
        bound, chol, white = self._bound(self._sums(root, _here), self._noise())
        mean = torch.cholesky_solve(white.unsqueeze(-1), chol).squeeze(-1)
        identity = torch.eye(chol.shape[-1]).to(chol).expand_as(chol)
        inverse = torch.linalg.solve_triangular(chol, identity, upper=False)
        root = torch.linalg.qr(inverse, mode="r").R.mT
        sign = root.diagonal(dim1=-1, dim2=-2).sign()
        return Optimum(bound, mean, root * sign.unsqueeze(-2))

    def _at(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """The objective and its gradient at one vector, ``1 x B`` and ``1 x B x p``."""
        values: Parameters = {
            name: value[0].detach().requires_grad_()
            for name, value in self.parameters.unflatten(vector).items()
        }

        def call(function: Callable[[], _Pair]) -> _Pair:
            found: _Pair = self.parameters.call_at(values, function)
            return found

        with torch.enable_grad():
            root, noise = call(lambda: (inducing_root(self._inducing_covariance()), self._noise()))
        with torch.no_grad():
            sums = self._sums(root, call)
        with torch.enable_grad():
            leaves = Sums(*(each.requires_grad_() for each in sums))
            bound, *_ = self._bound(leaves, noise)
            bound.sum().backward()
            self._pull_back(root, leaves, call)
        gradient = self.parameters.flatten(
            {
                name: torch.zeros_like(value) if value.grad is None else value.grad
                for name, value in values.items()
            }
        )
        return -bound.detach().reshape(*gradient.shape[:-1], -1).sum(-1), -gradient

    def _sums(self, root: Tensor, call: _Call) -> Sums:
        square = torch.zeros_like(root)
        cross, prior = square.new_zeros(square.shape[:-1]), square.new_zeros(square.shape[:-2])
        for part in self._data.parts(root.shape[-1]):
            k, variance = call(partial(self._covariances, part.inputs))
            white = torch.linalg.solve_triangular(root, k, upper=False)
            weighted = white * part.weight.unsqueeze(-2)
            square += weighted @ white.mT
            cross += (weighted @ part.residual.unsqueeze(-1)).squeeze(-1)
            prior += (part.weight * variance).sum(-1)
        return Sums(square, cross, prior)

    def _pull_back(self, root: Tensor, sums: Sums, call: _Call) -> None:
        """Bring the gradient by the sums to that by the hyper-parameters."""
        by_square, by_cross, by_prior = (each.grad for each in sums)
        if by_square is None or by_cross is None or by_prior is None:
            raise RuntimeError("The bound has no gradient by its sums.")
        by_square, chol = by_square + by_square.mT, root.detach()
        for part in self._data.parts(chol.shape[-1]):
            k, variance = call(partial(self._covariances, part.inputs))
            white = torch.linalg.solve_triangular(chol, k.detach(), upper=False)
            by_white = by_square @ white + by_cross.unsqueeze(-1) * part.residual.unsqueeze(-2)
            by_k = torch.linalg.solve_triangular(chol.mT, by_white, upper=True)
            by_variance = by_prior.unsqueeze(-1) * part.weight
            torch.autograd.backward([k, variance], [by_k * part.weight.unsqueeze(-2), by_variance])
        # Of all observations at once, as each has -L^-T (dv) v^T.
        by_whites = by_square @ sums.square.detach()
        by_whites = by_whites + by_cross.unsqueeze(-1) * sums.cross.detach().unsqueeze(-2)
        root.backward(-torch.linalg.solve_triangular(chol.mT, by_whites, upper=True).tril())

    def _covariances(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Those with the inducing values, ``(m) x M x n``, and prior variances, ``(m) x n``."""
        kernel = self._start.covar_module
        inputs = inputs.expand(*self._points.shape[:-2], *inputs.shape[-2:])
        return kernel.covariance(self._points, inputs), kernel.covariance(inputs, diag=True)

    def _inducing_covariance(self) -> Tensor:
        return self._start.covar_module.covariance(self._points, self._points)

    def _noise(self) -> Tensor:
        """The noise variance s of a weight of one, ``(m)``."""
        return noise_of_weight_one(self._start)

    def _bound(self, sums: Sums, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The bound ``(m)``, the Cholesky factor of Lambda, and :math:`b / s`."""
        identity = torch.eye(sums.square.shape[-1]).to(sums.square)
        # Without a nugget, which would be more than the identity in it.
        precision, failed = torch.linalg.cholesky_ex(
            identity + sums.square / noise[..., None, None]
        )
        target = sums.cross / noise.unsqueeze(-1)
        explained = torch.linalg.solve_triangular(precision, target.unsqueeze(-1), upper=False)
        log_det = 2 * precision.diagonal(dim1=-1, dim2=-2).log().sum(-1)
        size = self._count * (math.log(2 * math.pi) + noise.log()) - self._log_weights
        square = self._square / noise - explained.square().sum((-1, -2))
        unseen = (sums.prior - sums.square.diagonal(dim1=-1, dim2=-2).sum(-1)) / noise
        bound = -0.5 * (size + log_det + square + unseen)
        return bound.masked_fill(failed > 0, -math.inf), precision, target


def _here(function: Callable[[], _Pair]) -> _Pair:
    """Call a function at the hyper-parameters that the model has."""
    return function()


def noise_of_weight_one(start: CKA) -> Tensor:
    """The noise variance that weights divide: the learnt one, or 1 of known noise; ``(m)``."""
    noise: Tensor = start.likelihood.noise
    if noise.shape[-1] != 1:
        return torch.ones_like(noise[..., 0])
    return noise.squeeze(-1)


def observations(
    start: CKA, columns: Tensor, targets: Tensor, known: Tensor | None
) -> Observations:
    """What the bound is of.

    Args:
        start: The model that has the prior mean.
        columns: Transformed inputs, ``n x (d + k)``.
        targets: In model units, ``(m) x n``; NaN where one is missing.
        known: Known noise variances in their square, ``(m) x n``, or None.
    """
    with torch.no_grad():
        residual = targets - TermsMean(start.covar_module)(columns)
        weight = torch.ones_like(residual) if known is None else known.reciprocal()
        weight = weight.masked_fill(residual.isnan(), 0.0)
    return Observations(columns, residual.nan_to_num(nan=0.0), weight)
