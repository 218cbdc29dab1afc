"""The physics as mean and kernel of any GPyTorch model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from gpytorch.kernels import Kernel
from gpytorch.means import Mean
from linear_operator import to_dense
from torch import Tensor

from gpadjust.gp.kernels import CompositeKernel
from gpadjust.physics import Physics, as_physics


class PhysicsMean(Mean):
    r"""The mean function :math:`m(x) = f_p(x)`, for any GPyTorch model.

    The physics sees the inputs as the model's mean does, transformed: the models in
    :mod:`gpadjust.models` show it the raw ones. Parameters of a module are trained with the model.

    Args:
        physics: The physics f_p, ``... x n x d`` to ``... x n x m`` or ``n``.
        output: Which of the physics' outputs to use; to be said (or a ValueError when called) if it
            has several.

    Example:
        >>> import torch
        >>> from gpadjust.gp import PhysicsMean
        >>> mean = PhysicsMean(lambda X: X.sum(-1))
        >>> mean(torch.ones(3, 2, dtype=torch.float64))
        tensor([2., 2., 2.], dtype=torch.float64)
    """

    def __init__(
        self, physics: Physics | Callable[[Tensor], Tensor], output: int | None = None
    ) -> None:
        super().__init__()
        self.physics = as_physics(physics)
        self.output = output

    def forward(self, x: Tensor) -> Tensor:
        """Return f_p at ``x`` (``... x n x d``) as ``... x n``."""
        return _one_output(self.physics, x, self.output)


class PhysicsScaledKernel(CompositeKernel):
    r"""The covariance of :math:`\rho(x) f_p(x)` with :math:`\rho \sim GP(\cdot, k_\rho)`:

    .. math:: k(x, x') = f_p(x) \, k_\rho(x, x') \, f_p(x').

    With :class:`~gpadjust.gp.PhysicsMean` and a kernel of the bias it is the co-kriging adjustment
    in plain GPyTorch (Wannawas and Faisal 2023, eq. 2): ``PhysicsScaledKernel(k_rho, f_p) +
    k_delta``.

    Args:
        base_kernel: The kernel :math:`k_\rho`; its ``active_dims`` are for it alone.
        physics: As of :class:`~gpadjust.gp.PhysicsMean`.
        output: Likewise.
        active_dims: Select the inputs that this kernel, physics included, sees.

    Example:
        >>> import torch
        >>> from gpytorch.kernels import RBFKernel
        >>> from gpadjust.gp import PhysicsScaledKernel
        >>> kernel = PhysicsScaledKernel(RBFKernel(), lambda X: 3.0 * X).double()
        >>> kernel(torch.ones(1, 1, dtype=torch.float64)).to_dense().item()
        9.0
    """

    def __init__(
        self,
        base_kernel: Kernel,
        physics: Physics | Callable[[Tensor], Tensor],
        output: int | None = None,
        active_dims: tuple[int, ...] | None = None,
    ) -> None:
        # No batch shape of its own: the base kernel carries it, so that indexing can shrink it.
        super().__init__(active_dims=active_dims)
        self.base_kernel = base_kernel
        self.physics = as_physics(physics)
        self.output = output

    def basis(self, x: Tensor) -> Tensor:
        """Return f_p at ``x`` (``... x n x d``) as ``... x n``."""
        return _one_output(self.physics, x, self.output)

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n`` without building the matrix."""
        if params.pop("last_dim_is_batch", False):
            raise ValueError(
                "PhysicsScaledKernel cannot take `last_dim_is_batch=True`: f_p reads all inputs "
                "at once. Wrap the additive structure around the base kernel instead."
            )
        f1 = self.basis(x1)
        f2 = f1 if torch.equal(x1, x2) else self.basis(x2)
        covar = to_dense(self.base_kernel(x1, x2, diag=diag, **params))
        # Dense scaling is faster here than a product of diagonal linear operators.
        return covar * f1 * f2 if diag else covar * f1.unsqueeze(-1) * f2.unsqueeze(-2)


def _one_output(physics: Physics, x: Tensor, output: int | None) -> Tensor:
    values: Tensor = physics(x)
    if output is None and values.shape[-1] != 1:
        raise ValueError(
            f"The physics '{physics.name}' has {values.shape[-1]} outputs; say with `output=` "
            "which one this mean or kernel is about (one model, or one batch, per output)."
        )
    return values[..., output or 0]
