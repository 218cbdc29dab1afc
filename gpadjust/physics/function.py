"""A torch function as physics."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from torch import Tensor

from gpadjust.physics.base import Physics
from gpadjust.physics.error import PhysicsError


class FunctionPhysics(Physics):
    """Physics given as a torch function, differentiable by autograd.

    Args:
        function: Maps rows ``N x d`` to outputs ``N x m``, or ``N`` if ``m`` is 1. The parameters
            of a ``torch.nn.Module`` become parameters of the physics: they are learnt with the
            GP's hyper-parameters by the marginal likelihood.
        inputs: The columns of X that the function reads. Default: all.
        memo: The most rows to remember; 0 switches the memo off.
        name: The name in messages. Default: the function's.

    Raises:
        TypeError: If ``function`` is not callable.

    Example:
        >>> import torch
        >>> physics = FunctionPhysics(lambda X: X[:, 0] * X[:, 1], name="power")
        >>> physics(torch.tensor([[230.0, 2.0], [230.0, 3.0]], dtype=torch.float64))
        tensor([[460.],
                [690.]], dtype=torch.float64)
    """

    _callables = ("function",)

    def __init__(
        self,
        function: Callable[[Tensor], Tensor],
        *,
        inputs: Sequence[int] | None = None,
        memo: int = 100_000,
        name: str | None = None,
    ) -> None:
        if not callable(function):
            raise TypeError(f"function must be callable; found {type(function).__name__}.")
        name = name or getattr(function, "__name__", type(function).__name__)
        super().__init__(inputs=inputs, memo=memo, name=name)
        self.function = function

    def evaluate(self, X: Tensor) -> Tensor:
        """The function's outputs.

        Args:
            X: ``N x d``.

        Returns:
            ``N x m`` or ``N``, as the function gives them.

        Raises:
            PhysicsError: If the function computes with NumPy.
        """
        use_black_box = (
            f"Physics {self.name!r} computes with NumPy, expected torch; wrap the function as "
            "BlackBoxPhysics(function)."
        )
        try:
            Y = self.function(X)
        except RuntimeError as error:
            if "Can't call numpy() on Tensor that requires grad" in str(error):
                raise PhysicsError(use_black_box) from error
            raise
        if isinstance(Y, np.ndarray | np.generic):
            raise PhysicsError(use_black_box)
        return Y

    def _differentiate(self, rows: Tensor) -> Tensor:
        Y = super()._differentiate(rows)
        if rows.requires_grad and not Y.requires_grad:
            self._warn_once(
                f"No gradient flows through physics {self.name!r}: X requires grad, its outputs "
                "do not. Wrap the function as BlackBoxPhysics(function) for finite differences; "
                "ignore this if the outputs do not depend on X."
            )
        return Y
