"""The kernel of a random function times the physics."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from gpytorch.kernels import Kernel
from linear_operator import to_dense
from linear_operator.operators import LinearOperator
from torch import Tensor

from gpadjust.gp.physics_columns import CalledPhysics
from gpadjust.physics import Physics, as_physics


class PhysicsScaledKernel(Kernel):
    r"""The covariance of :math:`\rho(x) f_p(x)` with :math:`\rho \sim GP(\cdot, k_\rho)`:

    .. math:: k(x, x') = f_p(x) \, k_\rho(x, x') \, f_p(x'),

    in matrix form :math:`F_p K_\rho F_p^T` with the diagonal matrix :math:`F_p` of f_p. Together
    with :class:`~gpadjust.gp.PhysicsMean` and an additive kernel of the bias it is the co-kriging
    adjustment in plain GPyTorch (Wannawas and Faisal 2023, eq. 2):
    ``PhysicsScaledKernel(k_rho, f_p) + k_delta``.

    Args:
        base_kernel: The kernel :math:`k_\rho`. Its ``active_dims`` select among the inputs for it
            alone; the physics reads all of them.
        physics: The physics f_p, ``... x n x d`` to ``... x n x m`` or ``n``.
        output: Which of the physics' outputs to use, if it has several.
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
        self.physics = CalledPhysics(as_physics(physics), output)

    @property
    def is_stationary(self) -> bool:
        """False, as the covariance follows f_p."""
        return False

    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any
    ) -> Tensor | LinearOperator:
        """Return ``... x n x n'``, or its diagonal ``... x n`` without building the matrix."""
        if params.pop("last_dim_is_batch", False):
            raise ValueError(
                "PhysicsScaledKernel cannot take `last_dim_is_batch=True`: f_p reads all inputs "
                "at once. Wrap the additive structure around the base kernel instead."
            )
        f1 = self.physics(x1)
        f2 = f1 if torch.equal(x1, x2) else self.physics(x2)
        covar = to_dense(self.base_kernel(x1, x2, diag=diag, **params))
        # Dense scaling is faster here than a product of diagonal linear operators.
        return covar * f1 * f2 if diag else covar * f1.unsqueeze(-1) * f2.unsqueeze(-2)

    def num_outputs_per_input(self, x1: Tensor, x2: Tensor) -> int:
        """As the base kernel."""
        return int(self.base_kernel.num_outputs_per_input(x1, x2))

    def __getitem__(self, index: Any) -> PhysicsScaledKernel:
        """The kernel of a part of the batch."""
        return self._with(self.base_kernel[index])

    def expand_batch(self, *sizes: Any) -> PhysicsScaledKernel:
        """The kernel with its batch expanded to ``sizes``."""
        return self._with(self.base_kernel.expand_batch(*sizes))

    def _with(self, base_kernel: Kernel) -> PhysicsScaledKernel:
        new = deepcopy(self)
        new.base_kernel = base_kernel
        return new
