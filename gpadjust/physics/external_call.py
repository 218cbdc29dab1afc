"""The bridge from autograd to values and Jacobians computed outside of torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

import torch
from torch import Tensor


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
        ctx: Any,
        X: Tensor,
        value: Callable[[Tensor], Tensor],
        jacobian: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """The values, ``N x m``."""
        ctx.save_for_backward(X)
        ctx.jacobian = jacobian
        return value(X.detach())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """The gradient in X, ``N x d``."""
        (X,) = ctx.saved_tensors
        J = _Jacobian.apply(X, ctx.jacobian)
        return torch.einsum("nm,nmd->nd", grad, J), None, None


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
