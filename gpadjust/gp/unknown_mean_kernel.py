"""The covariance of an unknown constant mean."""

from __future__ import annotations

from gpytorch.kernels import ConstantKernel
from torch import Size

from gpadjust.gp.log_interval import LogInterval


class UnknownMeanKernel(ConstantKernel):
    r"""The constant covariance :math:`\kappa` of a constant with the prior :math:`N(m, \kappa)`.

    Added to the kernel of a function, it makes the function's mean unknown: with a large
    :math:`\kappa` the posterior is that of universal kriging (Rasmussen and Williams 2006, sec.
    2.7). Its prior is set, not trained.

    Args:
        batch_shape: Batch shape of the constant.
    """

    def __init__(self, batch_shape: Size = Size()) -> None:  # noqa: B008
        super().__init__(batch_shape=batch_shape, constant_constraint=LogInterval(1e-100, 1e100))
        self.raw_constant.requires_grad_(False)
