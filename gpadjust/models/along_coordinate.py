"""Outputs that are coupled along a coordinate, by the eigenvalues of two covariances."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from gpytorch.kernels import MaternKernel
from torch import Tensor

from gpadjust.gp import WeightedSum
from gpadjust.gp.gaussian import nugget
from gpadjust.models.training_data import ArrayLike

_RANK = 128  # of the covariance along the coordinate, at most
_LENGTHS = 20  # that are tried, from the resolution of that rank to three times the range
_NOISES = (1e-10, 10.0, 14)  # the same of the noise's share, and how many at first
_FINER = 15  # of these, around the best
_KNOTS = 101  # of what is smoothed along the coordinate
_WIDTH = 0.05  # standard deviation of that, in the range
_CONSTANT = 1e2  # prior variance of an unknown mean of delta, in its own


class AlongCoordinate(NamedTuple):
    r"""Residuals E with the covariance :math:`K_x \otimes A K_t A + s I`, for ``S`` samples.

    With :math:`K_x = U \Lambda U^T` and :math:`A K_t A = V M V^T`, whose rank is at most 128 (a
    Nystrom approximation at evenly spaced outputs), the coefficients :math:`U^T E V` are
    independent, with variances :math:`\lambda_i \mu_k + s` (Stegle et al. 2011), and what
    is not in the span of V is noise.

    Attributes:
        train: The kernel's sum at the training inputs.
        constant: A constant that is added to the kernel, for an unknown mean.
        vectors: U, ``S x n x n``.
        basis: V, ``S x m x r``.
        values: M, ``S x r``.
        noise: s, ``S x 1``.
        variances: :math:`\lambda_i \mu_k + s`, ``S x n x r``.
        coefficients: :math:`U^T E V`, ``S x n x r``.
        coordinate: That of the outputs, ``m``.
    """

    train: WeightedSum
    constant: float
    vectors: Tensor
    basis: Tensor
    values: Tensor
    noise: Tensor
    variances: Tensor
    coefficients: Tensor
    coordinate: Tensor

    @classmethod
    def of(cls, model: Any) -> AlongCoordinate:
        """That of a :class:`~gpadjust.ParallelPartialGP` with a coordinate."""
        train, constant, lam, vectors = _eigen(model)
        found = [_basis(model.coordinate, model.profile, length) for length in model.along[:, 0]]
        basis, values = (torch.stack(each) for each in zip(*found, strict=True))
        values = values * model.along[:, 1:2]
        noise = model.along[:, 2:]
        variances = lam.unsqueeze(-1) * values.unsqueeze(-2) + noise.unsqueeze(-1)
        coefficients = vectors.mT @ (model.residuals @ basis)
        t = model.coordinate
        return cls(train, constant, vectors, basis, values, noise, variances, coefficients, t)

    @staticmethod
    def learn(model: Any) -> Tensor:
        """The most likely lengthscale, variance and noise variance for each sample, ``S x 3``."""
        t, residuals = model.coordinate, model.residuals
        n, m = residuals.shape
        _, _, lam, vectors = _eigen(model)
        extent = t.max() - t.min()
        shortest = float(2 * extent / min(m, _RANK))
        lengths = torch.logspace(
            math.log10(shortest), math.log10(3 * float(extent)), _LENGTHS, dtype=t.dtype
        )
        low, high, number = _NOISES
        noises = torch.logspace(math.log10(low), math.log10(high), number, dtype=t.dtype)

        def of_length(length: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
            """The negative log likelihood ``S x g`` of shares ``S x g``, and its variance."""
            basis, values = _basis(t, model.profile, length)
            square = (vectors.mT @ (residuals @ basis)).square()  # S x n x r
            total = residuals.square().sum()
            rest = (total - square.sum((-1, -2))).clamp_min(1e-15 * total)
            each = []
            for share in shares.unbind(-1):
                variances = lam.unsqueeze(-1) * values + share[:, None, None]
                cost = (square / variances).sum((-1, -2)) + rest / share
                size = variances.log().sum((-1, -2)) + n * (m - len(values)) * share.log()
                scale = cost / (n * m)
                each.append(torch.stack([0.5 * (n * m * scale.log() + size), scale], -1))
            value, scale = torch.stack(each, 1).unbind(-1)
            return value, scale

        shares = noises.expand(len(lam), -1)
        coarse = torch.stack([of_length(length, shares)[0] for length in lengths])  # L x S x g
        best = coarse.amin(-1).argmin(0)  # S
        step = math.log(high / low) / (number - 1)
        finer = (step * torch.linspace(-1, 1, _FINER, dtype=t.dtype)).exp()
        rows = []
        for s, i in enumerate(best.tolist()):
            near = noises[coarse[i, s].argmin()] * finer
            value, scale = of_length(lengths[i], near.expand(len(lam), -1))
            k = value[s].argmin()
            rows.append(torch.stack([lengths[i], scale[s, k], scale[s, k] * near[k]]))
        return torch.stack(rows)

    def marginals(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Means and variances of delta, ``... x S x q x m``."""
        projected, size = self._projected(sought)
        weights = self.coefficients * self.values.unsqueeze(-2) / self.variances
        return projected @ weights @ self.basis.mT, size @ self.basis.square().mT

    def roots(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Standard deviations along the basis at each point, ``... x S x q x r``, and the basis."""
        return self._projected(sought)[1].sqrt(), self.basis

    def joint(self, sought: WeightedSum, among: bool, idcs: list[int] | None = None) -> Tensor:
        """Covariances ``... x S x m x q x q``; ``among`` outputs, ``... x S x (q m) x (q m)``."""
        cross = (sought.cross(self.train, is_data=True) + self.constant) @ self.vectors
        prior = (sought.covariance() + self.constant).unsqueeze(-3)
        known = self.values.square().unsqueeze(-2) / self.variances  # S x n x r
        own = cross.unsqueeze(-3) * known.mT.unsqueeze(-2)  # ... S x r x q x n
        covariance = self.values[..., None, None] * prior - own @ cross.unsqueeze(-3).mT
        if not among:
            return torch.einsum("...skab,sjk->...sjab", covariance, self.basis.square())
        basis = self.basis if idcs is None else self.basis[:, idcs]
        found = torch.einsum("...skab,sjk,slk->...sajbl", covariance, basis, basis)
        return found.flatten(-4, -3).flatten(-2, -1)

    def left_out(self, residuals: Tensor) -> tuple[Tensor, Tensor]:
        """Each row from all others, means and variances without noise, ``S x n x m``."""
        inverse = self.variances.reciprocal()
        precision = self.vectors.square() @ inverse
        error = self.vectors @ (self.coefficients * inverse) / precision
        shown = residuals @ self.basis - error
        variance = (precision.reciprocal() - self.noise.unsqueeze(-1)).clamp_min(0.0)
        return shown @ self.basis.mT, variance @ self.basis.square().mT

    def _projected(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        cross = (sought.cross(self.train, is_data=True) + self.constant) @ self.vectors
        prior = (sought.variance() + self.constant).unsqueeze(-1) * self.values.unsqueeze(-2)
        known = self.values.square().unsqueeze(-2) / self.variances
        least = nugget(cross.shape[-1]) * prior
        return cross, (prior - cross.square() @ known).maximum(least)


def coordinates_of(values: ArrayLike, number: int) -> Tensor:
    """The coordinates of outputs as a tensor, checked."""
    try:
        t = torch.as_tensor(np.asarray(values, dtype=np.float64)).flatten()
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"Expected coordinate as {number} numbers, got {type(values).__name__}."
        ) from error
    if len(t) != number or not t.isfinite().all() or number < 2 or t.max() == t.min():
        raise ValueError(
            f"Expected coordinate as {number} finite numbers, one for each output and not all the "
            f"same, got {len(t)} from {t.min():.4g} to {t.max():.4g}."
        )
    return t.clone()


def smoothed(t: Tensor, values: Tensor) -> Tensor:
    """Values along a coordinate, ``m``, averaged over neighbours within 5 % of its range."""
    knots = torch.linspace(float(t.min()), float(t.max()), _KNOTS, dtype=t.dtype)
    away = (knots.unsqueeze(-1) - t) / (_WIDTH * (t.max() - t.min()))
    weights = (-0.5 * away.square()).softmax(-1)
    found = np.interp(t.numpy(), knots.numpy(), (weights @ values).numpy())
    return torch.as_tensor(found).to(values)


def _eigen(model: Any) -> tuple[WeightedSum, float, Tensor, Tensor]:
    """The kernel at the training inputs, its constant, eigenvalues and vectors of the sum."""
    train = model.shared.conditioning().train
    constant = _CONSTANT if model.learns_offset else 0.0
    covariance = train.covariance()
    least = nugget(covariance.shape[-1]) * covariance.diagonal(dim1=-1, dim2=-2).amax(-1)
    lam, vectors = torch.linalg.eigh(covariance + constant)
    return train, constant, lam.clamp_min(0.0) + least.unsqueeze(-1), vectors


def _basis(t: Tensor, profile: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvectors ``m x r`` and values ``r`` of the covariance along the coordinate."""
    kernel = MaternKernel(2.5).to(t)
    kernel.lengthscale = length
    order = t.argsort()
    rank = min(len(t), _RANK)
    points = t[order[torch.linspace(0, len(t) - 1, rank).round().long()]]
    values, vectors = torch.linalg.eigh(kernel(points.unsqueeze(-1)).to_dense())
    inverse = values.clamp_min(1e-12 * values[-1]).rsqrt() * (values > 1e-12 * values[-1])
    cross = kernel(t.unsqueeze(-1), points.unsqueeze(-1)).to_dense() * profile.unsqueeze(-1)
    basis, sizes, _ = torch.linalg.svd(cross @ (vectors * inverse), full_matrices=False)
    return basis.detach(), sizes.square().detach()
