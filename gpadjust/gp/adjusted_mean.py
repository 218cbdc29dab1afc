"""The physics, adjusted by constants, as the mean of a Gaussian process."""

from __future__ import annotations

import torch
from torch import Size, Tensor
from torch.nn import Parameter

from gpadjust.gp.physics_mean import PhysicsMean
from gpadjust.gp.readers import PhysicsColumn


class AdjustedMean(PhysicsMean):
    r"""The mean :math:`m(x) = f_p(x) + (\bar\rho - 1)(f_p(x) - c) + \bar\delta`.

    The constants are parameters that gradients do not train: :func:`gpadjust.fit` sets them to
    their generalised least squares estimates.

    Args:
        physics: Reads f_p in the units of the targets.
        column: Reads :math:`f_p - c`, as the kernel of rho does.
        batch_shape: Batch shape of the constants.
    """

    def __init__(
        self,
        physics: PhysicsColumn,
        column: PhysicsColumn,
        batch_shape: Size = Size(),  # noqa: B008
    ) -> None:
        super().__init__(physics)
        self.column = column
        one = torch.ones(*batch_shape, 1, dtype=torch.float64)
        self.rho_mean = Parameter(one, requires_grad=False)
        self.delta_mean = Parameter(torch.zeros_like(one), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the mean at ``x`` (``... x n x (d + m)``) as ``... x n``."""
        return super().forward(x) + (self.rho_mean - 1) * self.column(x) + self.delta_mean
