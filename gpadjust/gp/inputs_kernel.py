"""A kernel on the first columns only."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from gpytorch.kernels import Kernel
from linear_operator.operators import LinearOperator
from torch import Size, Tensor


class InputsKernel(Kernel):
    r"""Evaluates a base kernel on the first ``num_inputs`` columns, without those appended to them.

    It does what ``active_dims=range(num_inputs)`` does, and stays right when GPyTorch indexes a
    batch of kernels.

    Args:
        base_kernel: The kernel to evaluate.
        num_inputs: Number of leading columns that it sees.
    """

    def __init__(self, base_kernel: Kernel, num_inputs: int) -> None:
        super().__init__()
        self.base_kernel = base_kernel
        self.num_inputs = num_inputs

    @property
    def is_stationary(self) -> bool:
        """As the base kernel."""
        return bool(self.base_kernel.is_stationary)

    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any
    ) -> Tensor | LinearOperator:
        """Return the base kernel's ``... x n x n'``, or its diagonal ``... x n``."""
        d = self.num_inputs
        return self.base_kernel(x1[..., :d], x2[..., :d], diag=diag, **params)

    def num_outputs_per_input(self, x1: Tensor, x2: Tensor) -> int:
        """As the base kernel."""
        return int(self.base_kernel.num_outputs_per_input(x1, x2))

    def __getitem__(self, index: Any) -> InputsKernel:
        """The kernel of a part of the batch."""
        return self._with(self.base_kernel[index])

    def expand_batch(self, *sizes: Any) -> InputsKernel:
        """The kernel with its batch expanded to ``sizes``."""
        shape = Size(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else Size(sizes)
        return self._with(self.base_kernel.expand_batch(shape))

    def _with(self, base_kernel: Kernel) -> InputsKernel:
        new = deepcopy(self)
        new.base_kernel = base_kernel
        return new
