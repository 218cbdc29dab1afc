"""The paper's model as GPyTorch modules, for your own ``ExactGP``.

A mean and a kernel evaluate a physics; the rest is GPyTorch's::

    class MyCKA(gpytorch.models.ExactGP):
        def __init__(self, X, y, likelihood, f_p):
            super().__init__(X, y, likelihood)
            self.mean_module = PhysicsMean(f_p)
            self.rho_covar_module = PhysicsScaledKernel(ScaleKernel(RBFKernel()), f_p)
            self.delta_covar_module = ScaleKernel(RBFKernel())

        def forward(self, x):
            covar = self.rho_covar_module(x) + self.delta_covar_module(x)
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), covar)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from gpytorch.kernels import Kernel
from gpytorch.means import Mean
from torch import Tensor

from gpadjust.physics import Physics, as_physics

__all__ = ["PhysicsMean", "PhysicsScaledKernel"]


class PhysicsMean(Mean):
    """The mean f_p(x), of one output of a physics.

    Args:
        physics: A torch function of ``n x d`` to ``n x m`` or ``n``, or a Physics.
        output: The number of the output.
    """

    def __init__(self, physics: Physics | Callable[[Tensor], Tensor], output: int = 0) -> None:
        super().__init__()
        self.physics = as_physics(physics)
        self.output = output

    def forward(self, x: Tensor) -> Tensor:
        """Return f_p at ``... x n x d``: ``... x n``."""
        values: Tensor = self.physics(x)[..., self.output]
        return values


class PhysicsScaledKernel(Kernel):
    r"""The kernel of :math:`\rho(x) f_p(x)`: :math:`f_p(x) \, k(x, x') \, f_p(x')`.

    Args:
        base_kernel: The kernel k of rho.
        physics: As of :class:`PhysicsMean`.
        output: The number of the output.
        center: A number c: the kernel has :math:`f_p(x) - c` in place of :math:`f_p(x)`.
    """

    def __init__(
        self, base_kernel: Kernel, physics: Physics | Callable[[Tensor], Tensor],
        output: int = 0, center: float = 0.0,
    ) -> None:  # fmt: skip
        super().__init__()
        self.base_kernel = base_kernel
        self.mean = PhysicsMean(physics, output)
        self.center = center

    @property
    def batch_shape(self) -> torch.Size:
        """The batch shape of the base kernel."""
        return self.base_kernel.batch_shape

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return covariances ``... x n x n'``, or variances ``... x n``."""
        f1 = self.mean(x1) - self.center
        f2 = self.mean(x2) - self.center
        # cov(x, x') = (f_p(x) - c) k(x, x') (f_p(x') - c)
        if diag:
            variance: Tensor = self.base_kernel(x1, x2, diag=True, **params)
            return f1 * variance * f2
        K: Tensor = self.base_kernel(x1, x2, **params).to_dense()
        return f1.unsqueeze(-1) * K * f2.unsqueeze(-2)
