"""Gradients of functions outside of torch: by differences, and through autograd."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

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
            :math:`\epsilon^{1/3} \max(1, |x|)`.

    Returns:
        ``N x m x d``.

    Example:
        >>> X = torch.tensor([[3.0, 2.0]], dtype=torch.float64)
        >>> central_difference(lambda X: X[:, :1] * X[:, 1:] ** 2, X)
        tensor([[[ 4.0000, 12.0000]]], dtype=torch.float64)
    """
    if step is None:
        step = torch.finfo(X.dtype).eps ** (1 / 3) * X.abs().clamp(min=1.0)
    moves = torch.diag_embed(step.expand(X.shape))
    sides = torch.stack([X.unsqueeze(1) + moves, X.unsqueeze(1) - moves])  # 2 x N x d x d
    upper, lower = function(sides.reshape(-1, X.shape[1])).reshape(*sides.shape[:3], -1)
    # The distance that rounding left, not 2 h.
    width = (sides[0] - sides[1]).diagonal(dim1=-2, dim2=-1)
    return ((upper - lower) / width.unsqueeze(-1)).mT


class ExternalCall(torch.autograd.Function):
    """A function of rows whose Jacobian is computed elsewhere, when the backward pass asks for it.

    Call ``ExternalCall.apply(X, value, jacobian)``: X is ``N x d``, ``value(X)`` is ``N x m`` and
    ``jacobian(X)`` is ``N x m x d``. A second derivative in X raises a ``NotImplementedError``.

    Example:
        >>> X = torch.tensor([[3.0]], requires_grad=True)
        >>> Y = ExternalCall.apply(X, lambda X: X**2, lambda X: 2 * X.unsqueeze(-1))
        >>> torch.autograd.grad(Y.sum(), X)
        (tensor([[6.]]),)
    """

    @staticmethod
    def forward(
        ctx: Any, X: Tensor, value: Callable[[Tensor], Tensor], jacobian: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """The values, ``N x m``."""
        ctx.save_for_backward(X)
        ctx.jacobian = jacobian
        return value(X.detach())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """The gradient in X, ``N x d``."""
        (X,) = ctx.saved_tensors
        return torch.einsum("nm,nmd->nd", grad, _Jacobian.apply(X, ctx.jacobian)), None, None


class _Jacobian(torch.autograd.Function):
    # A node of its own: ``once_differentiable`` would drop the second derivative without a word
    # where the incoming gradient is a constant.

    @staticmethod
    def forward(ctx: Any, X: Tensor, jacobian: Callable[[Tensor], Tensor]) -> Tensor:
        return jacobian(X.detach())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> NoReturn:
        raise NotImplementedError(
            "BlackBoxPhysics has first derivatives only; for second ones write the physics in "
            "torch, as FunctionPhysics."
        )
