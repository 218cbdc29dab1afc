"""How a mean or a kernel gets at the value of f_p: by calling it, or by reading a column."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.physics import Physics, as_physics


class PhysicsOutput(Module):
    """One output of a physics, called at the inputs that a mean or a kernel is given.

    Args:
        physics: The physics f_p; a plain torch function is wrapped.
        output: Which of its outputs to use; may be left out when it has only one.
    """

    def __init__(
        self, physics: Physics | Callable[[Tensor], Tensor], output: int | None = None
    ) -> None:
        super().__init__()
        self.physics = as_physics(physics)
        self.output = output

    def forward(self, x: Tensor) -> Tensor:
        """Return f_p at ``x`` (``... x n x d``) as ``... x n``."""
        values: Tensor = self.physics(x)
        if self.output is not None:
            return values[..., self.output]
        if values.shape[-1] != 1:
            raise ValueError(
                f"The physics '{self.physics.name}' has {values.shape[-1]} outputs; say with "
                "`output=` which one this mean or kernel is about (one model, or one batch, "
                "per output)."
            )
        return values.squeeze(-1)

    def __getitem__(self, index: Any) -> PhysicsOutput:
        """The same reader: nothing in it depends on the batch."""
        return self

    def expand_batch(self, batch_shape: Size) -> PhysicsOutput:
        """The same reader: nothing in it depends on the batch."""
        return self


class PhysicsColumn(Module):
    r"""Reads f_p from the columns that :class:`~gpadjust.gp.PhysicsInput` appended.

    For output :math:`j` it returns :math:`(f_{p,j}(x) - \text{offset}_j) / \text{scale}_j`: one set
    of columns in the user's units serves a mean and a kernel in the units of the targets.

    Args:
        num_inputs: Number ``d`` of input columns before the physics columns.
        num_outputs: Number ``m`` of physics columns.
        batch_shape: The model's batch shape, the outputs last: ``batch_shape x m`` if ``m > 1``.
        offset: Tensor ``batch_shape x (m) x 1`` in the user's units. Default: 0.
        scale: Tensor of the same shape. Default: 1.
    """

    select: Tensor
    offset: Tensor
    scale: Tensor

    def __init__(
        self,
        num_inputs: int,
        num_outputs: int,
        batch_shape: Size = Size(),  # noqa: B008
        offset: Tensor | None = None,
        scale: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.num_inputs = num_inputs
        self.num_columns = num_outputs
        one = torch.ones(*batch_shape, 1, dtype=torch.float64)
        pick = torch.eye(num_outputs, dtype=torch.float64)
        pick = pick.unsqueeze(-2) if num_outputs > 1 else pick
        self.register_buffer("select", pick.expand(*batch_shape, 1, num_outputs).clone())
        self.register_buffer("offset", torch.zeros_like(one) if offset is None else offset.clone())
        self.register_buffer("scale", one if scale is None else scale.clone())

    def forward(self, x: Tensor) -> Tensor:
        """Return the scaled f_p of each batch as ``... x n``, from ``x``: ``... x n x (d + m)``."""
        if x.shape[-1] != self.num_inputs + self.num_columns:
            raise ValueError(
                f"Expected {self.num_inputs} input columns and {self.num_columns} columns of f_p, "
                f"got x with shape {tuple(x.shape)}. The model's input transform appends f_p: call "
                "`model.posterior(X)`, or `model(model.transform_inputs(X))` in eval mode."
            )
        values = (x[..., self.num_inputs :] * self.select).sum(-1) - self.offset
        # Differences of rounding errors are none: a physics that is constant has no variation.
        rounding = 8 * torch.finfo(values.dtype).eps * self.offset.abs()
        values = torch.where(values.abs() <= rounding, values - values.detach(), values)
        return values / self.scale

    def __getitem__(self, index: Any) -> PhysicsColumn:
        """The reader of a part of the batch, as GPyTorch indexes batched kernels."""
        return self._map_buffers(lambda buffer: buffer[index])

    def expand_batch(self, batch_shape: Size) -> PhysicsColumn:
        """The reader with its batch expanded to ``batch_shape``."""
        lead = self.scale.dim() - 1
        return self._map_buffers(lambda buffer: buffer.expand(*batch_shape, *buffer.shape[lead:]))

    def _map_buffers(self, change: Callable[[Tensor], Tensor]) -> PhysicsColumn:
        new = deepcopy(self)
        for name, buffer in self.named_buffers():
            setattr(new, name, change(buffer))
        return new


def as_reader(
    physics: Physics | Callable[[Tensor], Tensor] | PhysicsColumn | PhysicsOutput,
    output: int | None = None,
) -> PhysicsColumn | PhysicsOutput:
    """Return ``physics`` as a module that maps ``... x n x d`` to ``... x n``."""
    if isinstance(physics, PhysicsColumn | PhysicsOutput):
        return physics
    return PhysicsOutput(physics, output)
