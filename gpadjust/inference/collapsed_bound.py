"""The evidence lower bound of a model with inducing points, at its optimal distribution."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.inference.priors import LogPriors
from gpadjust.inference.vectors import Parameters
from gpadjust.models import TermsGP, VariationalCKA
from gpadjust.models.sparse_conditioning import inducing_root

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

    @classmethod
    def of(cls, model: VariationalCKA) -> Observations:
        """Return the bound of a model."""
        (inputs,), known = model.train_inputs, model.noise.known
        with torch.no_grad():
            residual = model.train_targets - model.covar_module.at(inputs).mean()
            weight = torch.ones_like(residual) if known is None else known.reciprocal()
            weight = weight.masked_fill(residual.isnan(), 0.0)
        return cls(inputs, residual.nan_to_num(nan=0.0), weight)

    def rows(self, which: Tensor | slice) -> Observations:
        """Some of them."""
        return Observations(self.inputs[which], self.residual[..., which], self.weight[..., which])


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
        model: The exact model whose hyper-parameters these are; its own data do not count.
        data: The observations that count.
        inducing_points: ``(m) x M x (d + k)``.
    """

    def __init__(self, model: TermsGP, data: Observations, inducing_points: Tensor) -> None:
        model.covar_module.train()  # in which centers have gradients
        self._model, self._data, self._points = model, data, inducing_points

    @cached_property
    def parameters(self) -> Parameters:
        """The vectors and their bounds."""
        return Parameters(self._model)

    @cached_property
    def _priors(self) -> LogPriors:
        return LogPriors(self._model, self.parameters)

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective and its gradient, ``k x B`` and ``k x B x p``.

        It is infinite, with a gradient of zero, where a covariance has no Cholesky factor.
        """
        found = [self._at(vector.unsqueeze(0)) for vector in vectors]
        values, gradients = (torch.cat(each) for each in zip(*found, strict=True))
        log_prior, slope = self._priors(vectors)
        values = (values - log_prior).nan_to_num(math.inf, math.inf, math.inf)
        good = (values.isfinite() & gradients.isfinite().all(-1)).unsqueeze(-1)
        return values, (gradients - slope).where(good, torch.zeros_like(gradients))

    @torch.no_grad()
    def optimum(self) -> tuple[Tensor, Tensor, Tensor]:
        """The best distribution of whitened inducing values, at the model's hyper-parameters.

        Returns:
            The bound, ``(m)``; the mean, ``(m) x M``, and a lower root of the covariance.
        """
        root, noise = self._start()
        bound, chol, white = self._bound(self._sums(root, lambda covariances: covariances()), noise)
        mean = torch.cholesky_solve(white.unsqueeze(-1), chol).squeeze(-1)
        identity = torch.eye(chol.shape[-1]).to(chol).expand_as(chol)
        inverse = torch.linalg.solve_triangular(chol, identity, upper=False)
        root = torch.linalg.qr(inverse, mode="r").R.mT
        return bound, mean, root * root.diagonal(dim1=-1, dim2=-2).sign().unsqueeze(-2)

    def _at(self, vector: Tensor) -> _Pair:
        """The objective and its gradient at one vector, ``1 x B`` and ``1 x B x p``."""
        parameters = self.parameters
        values = {n: v[0].requires_grad_() for n, v in parameters.unflatten(vector).items()}
        call = partial(parameters.call_at, values)
        with torch.enable_grad():
            root, noise = call(self._start)
            with torch.no_grad():
                sums = self._sums(root, call)
            leaves = [each.requires_grad_() for each in sums]
            bound = self._bound(leaves, noise)[0]
            bound.sum().backward()
            self._pull_back(root, leaves, call)
        slopes = {n: torch.zeros_like(v) if v.grad is None else v.grad for n, v in values.items()}
        gradient = parameters.flatten(slopes)
        return -bound.detach().reshape(*gradient.shape[:-1], -1).sum(-1), -gradient

    def _sums(self, root: Tensor, call: _Call) -> list[Tensor]:
        """The sums of w v v^T, ``(m) x M x M``, of w v r, and of w times the prior variance."""
        square = torch.zeros_like(root)
        cross, prior = torch.zeros_like(square[..., 0]), torch.zeros_like(square[..., 0, 0])
        for part, (_, variance), white in self._parts(root, call):
            weighted = white * part.weight.unsqueeze(-2)
            square += weighted @ white.mT
            cross += (weighted @ part.residual.unsqueeze(-1)).squeeze(-1)
            prior += (part.weight * variance).sum(-1)
        return [square, cross, prior]

    def _pull_back(self, root: Tensor, sums: list[Tensor], call: _Call) -> None:
        """Bring the gradient by the sums to that by the hyper-parameters."""
        by_square, by_cross, by_prior = (
            torch.zeros_like(each) if each.grad is None else each.grad for each in sums
        )
        by_square, by_cross, chol = by_square + by_square.mT, by_cross.unsqueeze(-1), root.detach()
        for part, (k, variance), white in self._parts(chol, call):
            by_white = by_square @ white + by_cross * part.residual.unsqueeze(-2)
            by_k = torch.linalg.solve_triangular(chol.mT, by_white, upper=True)
            by_variance = by_prior.unsqueeze(-1) * part.weight
            torch.autograd.backward([k, variance], [by_k * part.weight.unsqueeze(-2), by_variance])
        # Of all observations at once, as each has -L^-T (dv) v^T.
        by_whites = by_square @ sums[0].detach() + by_cross * sums[1].detach().unsqueeze(-2)
        root.backward(-torch.linalg.solve_triangular(chol.mT, by_whites, upper=True).tril())

    def _parts(self, chol: Tensor, call: _Call) -> Iterator[tuple[Observations, _Pair, Tensor]]:
        """All observations in parts that fit in memory; their covariances and v."""
        size = max(1, _AT_ONCE // chol[..., 0].numel())
        for i in range(0, len(self._data.inputs), size):
            part = self._data.rows(slice(i, i + size))
            k, variance = call(partial(self._covariances, part.inputs))
            yield part, (k, variance), torch.linalg.solve_triangular(chol, k.detach(), upper=False)

    def _covariances(self, inputs: Tensor) -> _Pair:
        """Return covariances with inducing values, ``(m) x M x n``, and variances, ``(m) x n``."""
        f = self._model.at(inputs.expand(*self._points.shape[:-2], *inputs.shape[-2:]))
        return self._model.at(self._points).cross(f), f.variance()

    def _start(self) -> _Pair:
        """The root of the inducing values' covariance; the noise s of a weight of one, ``(m)``."""
        root, noise = inducing_root(self._model.at(self._points).covariance()), self._model.noise
        if noise.known is not None:
            return root, torch.ones_like(root[..., 0, 0])
        return root, noise.at(self._points)[..., 0]

    def _bound(self, sums: list[Tensor], noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The bound ``(m)``, the Cholesky factor of Lambda, and :math:`b / s`."""
        (square, cross, prior), (_, residual, weight) = sums, self._data
        # Without a nugget, which would be more than the identity in it.
        identity = torch.eye(square.shape[-1]).to(square)
        chol, failed = torch.linalg.cholesky_ex(identity + square / noise[..., None, None])
        target = cross / noise.unsqueeze(-1)
        explained = torch.linalg.solve_triangular(chol, target.unsqueeze(-1), upper=False)
        log_det = 2 * chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
        log_weights = torch.where(weight > 0, weight, 1.0).log().sum(-1)
        size = (weight > 0).sum(-1) * (2 * math.pi * noise).log() - log_weights
        misfit = (weight * residual.square()).sum(-1) / noise - explained.square().sum((-1, -2))
        unseen = (prior - square.diagonal(dim1=-1, dim2=-2).sum(-1)) / noise
        bound = -0.5 * (size + log_det + misfit + unseen)
        return bound.masked_fill(failed > 0, -math.inf), chol, target
