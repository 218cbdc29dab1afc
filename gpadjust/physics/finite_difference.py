"""The Jacobian of a function of rows by finite differences."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def central_difference(
    function: Callable[[Tensor], Tensor], X: Tensor, step: Tensor | None = None
) -> Tensor:
    r"""The Jacobian of a function at some rows, by central differences in one call.

    .. math:: \frac{\partial f_k}{\partial x_j} \approx
        \frac{f_k(x + h_j e_j) - f_k(x - h_j e_j)}{2 h_j}

    Args:
        function: Maps ``2 d N x d`` rows to ``2 d N x m`` outputs. Row ``i`` of them is row
            ``i // d % N`` of X, moved along column ``i % d``.
        X: ``N x d``.
        step: :math:`h`, broadcastable to ``N x d``, in the columns' units. Default:
            :math:`\epsilon^{1/3} \max(1, |x|)`, which balances truncation against rounding for
            functions that vary on the scale of 1 and :math:`|x|`.

    Returns:
        ``N x m x d``.

    Example:
        >>> X = torch.tensor([[3.0, 2.0]], dtype=torch.float64)
        >>> central_difference(lambda X: X[:, :1] * X[:, 1:] ** 2, X)
        tensor([[[ 4.0000, 12.0000]]], dtype=torch.float64)
    """
    sides = _sides(X, step)
    return _slope(sides, function(sides.reshape(-1, X.shape[1])))


def value_and_central_difference(
    function: Callable[[Tensor], Tensor], X: Tensor
) -> tuple[Tensor, Tensor]:
    """The values of a function at rows ``N x d`` and its Jacobian, in one call.

    Args:
        function: Maps ``(2 d + 1) N x d`` rows, the first of which are those of X.
        X: ``N x d``.

    Returns:
        ``N x m`` and, as of :func:`central_difference`, ``N x m x d``.

    Example:
        >>> X = torch.tensor([[3.0]], dtype=torch.float64)
        >>> values, slope = value_and_central_difference(lambda X: X**2, X)
        >>> values.item(), round(slope.item(), 6)
        (9.0, 6.0)
    """
    sides = _sides(X, None)
    Y = function(torch.cat([X, sides.reshape(-1, X.shape[1])]))
    return Y[: len(X)], _slope(sides, Y[len(X) :])


def _sides(X: Tensor, step: Tensor | None) -> Tensor:
    """Each row moved along each column, up and down: ``2 x N x d x d``."""
    if step is None:
        step = torch.finfo(X.dtype).eps ** (1 / 3) * X.abs().clamp(min=1.0)
    moves = torch.diag_embed(step.expand(X.shape))
    return torch.stack([X.unsqueeze(1) + moves, X.unsqueeze(1) - moves])


def _slope(sides: Tensor, values: Tensor) -> Tensor:
    """The Jacobian from what a function is on both sides."""
    # The distance that rounding left, not 2 h.
    width = (sides[0] - sides[1]).diagonal(dim1=-2, dim2=-1)
    upper, lower = values.reshape(*sides.shape[:3], -1)
    return ((upper - lower) / width.unsqueeze(-1)).mT
