"""Gaussian targets: one covariance with noise, one Cholesky factor, one nugget, few threads."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache
from threading import Lock
from typing import NamedTuple

import torch
from threadpoolctl import ThreadpoolController
from torch import Tensor

_limiting = Lock()  # held by the thread that limits those of other libraries
_setting = Lock()  # held by the thread that sets PyTorch's number of threads
_FAINT = 1e-10  # of the mean variance: what a point has at least, for its nugget
_TRIES = 8  # each with ten times the nugget of the one before
_controller = cache(ThreadpoolController)  # it lists the process's libraries, once
_SMALL = 256  # points of a covariance up to which a second thread costs more than it brings


def nugget(n: int) -> float:
    r"""The nugget of every factorised covariance of ``n`` points, :math:`\max(100, n)\epsilon`.

    It is relative to each point's own variance, in fits and in predictions alike. With less,
    rounding errors, of the order of :math:`n \epsilon` of the prior variance at worst, would decide
    what a model without noise knows; with more, the nugget, as for a function that is nearly
    polynomial the prior variance is a million times that of the targets. These errors are relative
    to each point's variance, too (Higham 2002, theorem 10.7): those of a large part of a function
    do not blur a small one.
    """
    return max(100, n) * torch.finfo(torch.float64).eps


def cholesky(
    covariance: Tensor, observed: Tensor | None = None, n: int | None = None
) -> tuple[Tensor, Tensor]:
    """Factorise covariances of targets, noise included; they are overwritten.

    Args:
        covariance: ``... x n x n``.
        observed: Which targets there are, ``... x n``; the others become independent ones of
            variance 1. Default: all.
        n: The number of points that the nugget is for, if another.

    Returns:
        The Cholesky factors, and which of them failed with the largest nugget, too, ``...``.
    """
    n = covariance.shape[-1] if n is None else n
    if observed is not None:
        pairs = observed.unsqueeze(-1) & observed.unsqueeze(-2)
        covariance = covariance.where(pairs, torch.zeros_like(covariance))
    diagonal = covariance.diagonal(dim1=-1, dim2=-2)
    added = nugget(n) * diagonal.maximum(_FAINT * diagonal.mean(-1, keepdim=True))
    if observed is not None:
        covariance = covariance + torch.diag_embed((~observed).to(covariance))
    step = added
    for _ in range(_TRIES):
        if covariance.requires_grad or step.requires_grad:
            covariance = covariance + torch.diag_embed(step.expand(covariance.shape[:-1]))
        else:
            covariance.diagonal(dim1=-1, dim2=-2).add_(step)
        chol, info = torch.linalg.cholesky_ex(covariance)
        failed = info > 0
        if not failed.any():
            return chol, failed
        step, added = 9 * added * failed.unsqueeze(-1), 10 * added
    identity = torch.eye(covariance.shape[-1], dtype=chol.dtype, device=chol.device)
    return torch.where(failed[..., None, None], identity, chol), failed


def scaled(matrix: Tensor, factor: Tensor) -> Tensor:
    """Multiply a matrix, in place where its shape and autograd allow."""
    traced = torch.is_grad_enabled() and (matrix.requires_grad or factor.requires_grad)
    shapes = zip(reversed(factor.shape), reversed(matrix.shape), strict=False)  # PyTorch's is slow
    fits = factor.dim() <= matrix.dim() and all(ours in (1, theirs) for ours, theirs in shapes)
    return matrix * factor if traced or not fits or 0 in matrix.stride() else matrix.mul_(factor)


class LikelihoodValue(NamedTuple):
    """Value and derivatives (None if not asked for) of a negative log likelihood of a batch."""

    value: Tensor  # ...; infinite where the covariance has no Cholesky factor
    scale: Tensor  # the factor of the covariance that it is for, ...
    by_mean: Tensor | None = None  # ... x n
    by_covariance: Tensor | None = None  # ... x n x n
    by_least_scale: Tensor | None = None  # by the logarithm of `least_scale`, ...
    coefficients: Tensor | None = None  # of the basis, ... x q; None without one


class Trend(NamedTuple):
    """Functions whose coefficients a restricted likelihood does not charge for.

    Attributes:
        columns: The functions at the targets, ``... x n x q``, of full rank.
        shares: Which share of the cost of each is not counted, given those before it, ``q``.
    """

    columns: Tensor
    shares: Tensor


def log_likelihood(residual: Tensor, covariance: Tensor) -> Tensor:
    r"""The log density of ``... x n`` residuals under :math:`N(0, K)`, by the book.

    It is algorithm 2.1 of Rasmussen and Williams (2006), of which :func:`negative_log_likelihood`
    is the negative, but for the nugget, without basis, scale and trend.
    """
    chol = torch.linalg.cholesky(covariance)
    alpha = torch.cholesky_solve(residual.unsqueeze(-1), chol).squeeze(-1)
    data_fit = -0.5 * (residual * alpha).sum(-1)
    complexity = -chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    return data_fit + complexity - 0.5 * residual.shape[-1] * math.log(2 * math.pi)


def negative_log_likelihood(
    residual: Tensor,
    covariance: Tensor,
    basis: Tensor | None = None,
    least_scale: Tensor | None = None,
    derivatives: bool = False,
    trend: Trend | None = None,
) -> LikelihoodValue:
    r"""Negative log likelihood of :math:`r \sim N(H \beta, s K)`, with one Cholesky factor.

    .. math:: \tfrac{1}{2s} r^T P r + \tfrac12 \log|s K| + \tfrac n2 \log 2\pi

    where :math:`P = K^{-1} - K^{-1} H (H^T K^{-1} H)^{-1} H^T K^{-1}`: the coefficients
    :math:`\beta` are at their generalised least squares estimate. With a ``least_scale`` the factor
    s is at its optimum, :math:`s = r^T P r / n`, or at that least value if the optimum is below it;
    without one it is 1 (Rasmussen and Williams 2006, sec. 2.7, 5.4).

    Its derivative by the covariance is :math:`\tfrac12 (K^{-1} - \alpha \alpha^T / s)` with
    :math:`\alpha = P r`. A trend T adds :math:`\tfrac12 \log|T^T K^{-1} T|`, for s = 1, as in the
    restricted likelihood (Harville 1974): coefficients on T then cost the same at all their sizes.
    Of columns with a share below 1 it is that share of what they add to the logarithm.

    Args:
        residual: Targets less their mean, ``... x n``; NaN where there is no observation.
        covariance: The covariance K, noise included, ``... x n x n``; it is overwritten.
        basis: The basis H, ``... x n x q``, or none.
        least_scale: The least s, ``...``, or None for s = 1.
        derivatives: Whether to compute the derivatives.
        trend: The trend T, or none.
    """
    size = residual.shape[-1]
    observed = ~residual.isnan()
    n = observed.sum(-1).to(residual)
    everything = bool(observed.all())
    if not everything:
        residual, mask = residual.nan_to_num(nan=0.0), observed.unsqueeze(-1)
        basis = None if basis is None else basis * mask
        trend = None if trend is None else trend._replace(columns=trend.columns * mask)
    chol, failed = cholesky(covariance, None if everything else observed)
    alpha, coefficients = torch.cholesky_solve(residual.unsqueeze(-1), chol), None
    if basis is not None:
        basis = basis.expand(*chol.shape[:-1], basis.shape[-1])
        coefficients, _ = least_squares(chol, residual, basis)
        alpha = alpha - torch.cholesky_solve(basis @ coefficients.unsqueeze(-1), chol)
    alpha = alpha.squeeze(-1)
    # The basis is orthogonal to P r, so that r^T P r needs no other residual.
    square = (residual * alpha).sum(-1)
    scale = torch.ones_like(square)
    if least_scale is not None:
        scale = (square / n).maximum(least_scale)
    log_det = 2 * chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    if trend is not None:
        columns = trend.columns.expand(*chol.shape[:-1], trend.columns.shape[-1])
        # Through an orthogonal basis, as the product is ill-conditioned where K is.
        white, triangle = torch.linalg.qr(torch.linalg.solve_triangular(chol, columns, upper=False))
        log_sizes = triangle.diagonal(dim1=-1, dim2=-2).abs().log()
        log_det = log_det + 2 * (trend.shares * log_sizes).sum(-1)
    value = 0.5 * (square / scale + n * (scale.log() + math.log(2 * math.pi)) + log_det)
    failed = failed | ~value.isfinite()
    value = value.masked_fill(failed, math.inf)
    if not derivatives:
        return LikelihoodValue(value, scale, coefficients=coefficients)
    weight = alpha / scale.unsqueeze(-1)
    by_covariance = torch.cholesky_inverse(chol)
    by_covariance.view(-1, size, size).baddbmm_(
        weight.reshape(-1, size, 1), alpha.reshape(-1, 1, size), beta=0.5, alpha=-0.5
    )
    if trend is not None:
        columns = torch.linalg.solve_triangular(chol.mT, white, upper=True)
        by_covariance = by_covariance - 0.5 * (trend.shares * columns) @ columns.mT
    if not everything:
        by_covariance = by_covariance * observed.unsqueeze(-1) * observed.unsqueeze(-2)
    diagonal = by_covariance.diagonal(dim1=-1, dim2=-2)
    diagonal.mul_(1 + nugget(size))  # as the nugget is a share of it
    by_scale = None if least_scale is None else 0.5 * (n - square / scale)
    # LAPACK's matrices are stored by columns, ours by rows: mixing them would be slow.
    return LikelihoodValue(value, scale, -weight, by_covariance.mT, by_scale, coefficients)


def least_squares(chol: Tensor, residual: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Generalised least squares of a residual, ``... x n``, on a basis, ``... x n x q``.

    With the Cholesky factor of the residual's covariance. Returns the coefficients, ``... x q``,
    and their covariance, ``... x q x q``.
    """
    both = torch.cat([basis, residual.unsqueeze(-1)], dim=-1)
    white = torch.linalg.solve_triangular(chol, both, upper=False)
    # Through an orthogonal basis, for columns that are nearly collinear; the pseudo-inverse is
    # for those that are so exactly, a physics that is constant, say, whatever their sizes.
    size = torch.linalg.vector_norm(white[..., :-1], dim=-2, keepdim=True)
    size = size.where(size > 0, torch.ones_like(size))
    inverse = torch.linalg.pinv(white[..., :-1] / size, rtol=1e-10) / size.mT
    return (inverse @ white[..., -1:]).squeeze(-1), inverse @ inverse.mT


@contextmanager
def threads_for(num_points: int) -> Iterator[None]:
    """Compute a small problem with one thread; the user's settings hold again after.

    On a busy machine, threads that wait for each other at every small product can make a fit take a
    hundred times as long. PyTorch is limited in the calling thread alone, NumPy's and SciPy's
    libraries in the process, by the first thread that asks; in about 0.2 ms.

    Example:
        >>> import torch
        >>> with threads_for(12):
        ...     torch.get_num_threads()
        1
    """
    if num_points > _SMALL:
        yield
        return
    with _setting:
        # The first call in a thread sets its number, which the limits below put back, too.
        before = torch.get_num_threads()
    with ExitStack() as stack:
        if _limiting.acquire(blocking=False):
            stack.callback(_limiting.release)
            stack.enter_context(_controller().limit(limits=1, user_api="blas"))
        stack.callback(_set_own_threads, before)
        _set_own_threads(1)
        yield


def _set_own_threads(number: int) -> None:
    """Set the number of threads that PyTorch uses in the calling thread alone."""
    # PyTorch's own call also sets what new threads begin with; another thread sets that back.
    with _setting:
        if torch.get_num_threads() == number:
            return
        with ThreadPoolExecutor(1) as another:
            common = another.submit(torch.get_num_threads).result()
            try:
                torch.set_num_threads(number)
            finally:
                another.submit(torch.set_num_threads, common)
