"""The likelihood of Gaussian targets and its derivatives in closed form."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

_JITTER = 1e-8  # of the mean diagonal, for a covariance that is not positive definite without


class Likelihood(NamedTuple):
    """Value and derivatives of a negative log likelihood; ``...`` is a batch of problems.

    Attributes:
        value: ``...``; infinite where the covariance has no Cholesky factor.
        scale: The factor of the covariance that maximises the likelihood, ``...``.
        gradient: Its derivatives by the mean, ``... x n``, and by the covariance,
            ``... x n x n``; empty if not asked for.
    """

    value: Tensor
    scale: Tensor
    gradient: tuple[Tensor, ...] = ()


def negative_log_likelihood(
    residual: Tensor,
    covariance: Tensor,
    basis: Tensor | None = None,
    concentrated: bool = False,
    derivatives: bool = False,
    least_scale: Tensor | float = 0.0,
) -> Likelihood:
    r"""Negative log likelihood of :math:`r \sim N(H \beta, K)`, with one Cholesky factor.

    .. math:: \tfrac12 r^T P r + \tfrac12 \log|K| + \tfrac n2 \log 2\pi

    where :math:`P = K^{-1} - K^{-1} H (H^T K^{-1} H)^{-1} H^T K^{-1}`: the coefficients
    :math:`\beta` of the basis are at their generalised least squares estimate. Concentrated, the
    covariance is :math:`s K` with the factor at its optimum :math:`s = r^T P r / n`, which makes
    the first term :math:`\tfrac n2 (1 + \log s)` (Rasmussen and Williams 2006, sec. 2.7 and 5.4).

    The derivative by the covariance is :math:`\tfrac12 (K^{-1} - \alpha \alpha^T / s)` with
    :math:`\alpha = P r`, one inverse from the same factor.

    Args:
        residual: Targets less their mean, ``... x n``.
        covariance: The covariance K, noise included, ``... x n x n``.
        basis: The basis H, ``... x n x q``, or none.
        concentrated: Whether the overall scale is at its optimum, instead of 1.
        derivatives: Whether to compute the derivatives.
        least_scale: The least s, ``...``, for targets that are met but for rounding errors.
    """
    n = residual.shape[-1]
    chol, failed = safe_cholesky(covariance)
    alpha = torch.cholesky_solve(residual.unsqueeze(-1), chol)
    if basis is not None:
        basis = basis.expand(*covariance.shape[:-1], basis.shape[-1])
        coefficients, _ = least_squares(chol, residual, basis)
        alpha = alpha - torch.cholesky_solve(basis @ coefficients.unsqueeze(-1), chol)
    alpha = alpha.squeeze(-1)
    # The basis is orthogonal to P r, so that r^T P r needs no other residual.
    square = (residual * alpha).sum(-1)
    log_det = 2 * chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    least = torch.as_tensor(least_scale, dtype=square.dtype).clamp_min(
        torch.finfo(square.dtype).tiny
    )
    scale = (square / n).clamp_min(least)
    fit = n * (1 + scale.log()) if concentrated else square
    value = 0.5 * (fit + log_det + n * math.log(2 * math.pi))
    failed = failed | ~value.isfinite()
    value = torch.where(failed, torch.full_like(value, math.inf), value)
    if not derivatives:
        return Likelihood(value, scale)
    weight = alpha / scale.unsqueeze(-1) if concentrated else alpha
    by_covariance = torch.cholesky_inverse(chol)
    by_covariance.view(-1, n, n).baddbmm_(
        weight.reshape(-1, n, 1), alpha.reshape(-1, 1, n), beta=0.5, alpha=-0.5
    )
    # LAPACK's matrices are stored by columns, ours by rows: mixing them would be slow.
    return Likelihood(value, scale, (-weight, by_covariance.mT))


def least_squares(chol: Tensor, residual: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Generalised least squares of a residual on a basis.

    Args:
        chol: Cholesky factor of the residual's covariance, ``... x n x n``.
        residual: ``... x n``.
        basis: ``... x n x q``.

    Returns:
        The coefficients, ``... x q``, and their covariance, ``... x q x q``.
    """
    white = torch.linalg.solve_triangular(
        chol, torch.cat([basis, residual.unsqueeze(-1)], dim=-1), upper=False
    )
    white_basis, white_residual = white[..., :-1], white[..., -1:]
    # Through an orthogonal basis, for columns that are nearly collinear; the pseudo-inverse is
    # for those that are so exactly, a physics that is constant, say.
    inverse = torch.linalg.pinv(white_basis, rtol=1e-10)
    return (inverse @ white_residual).squeeze(-1), inverse @ inverse.mT


def safe_cholesky(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors, with jitter where they need it, and which of them failed all the same."""
    chol, info = torch.linalg.cholesky_ex(covariance)
    if not info.any():
        return chol, info > 0
    identity = torch.eye(covariance.shape[-1], dtype=chol.dtype, device=chol.device)
    size = covariance.diagonal(dim1=-1, dim2=-2).mean(-1)[..., None, None]
    bad = (info > 0)[..., None, None]
    covariance = torch.where(bad, covariance + _JITTER * size * identity, covariance)
    chol, info = torch.linalg.cholesky_ex(covariance)
    failed = info > 0
    return torch.where(failed[..., None, None], identity, chol), failed
