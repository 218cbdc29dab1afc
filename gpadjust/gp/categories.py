"""Categories among the inputs: columns that kernels read, and kernels of these."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from botorch.models.transforms.input import InputTransform
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from torch import Tensor
from torch.nn import Module, Parameter

from gpadjust.gp.kernels import PROFILES, RBF

_FAR = 1e8  # the lengthscale of what a kernel does not read
_APART = 0.02  # that at which levels are independent: exp(-1 / (2 * 0.02^2)) = 0


class CategoricalInput(InputTransform):
    r"""Replaces each categorical column by one column for each level, 1 / sqrt(2) or 0.

    All levels are then at the distance 1 from each other, so that an RBF kernel with a single
    lengthscale for these columns is :math:`\exp(-1\{c \neq c'\} / (2 \ell^2))`: exchangeable.
    A physics does not see this.

    Args:
        levels: The values of each categorical column, by its number.
        batches: Those of these columns that other values may be in, which are then new levels.
        num_inputs: Number ``d`` of raw columns.
        names: The names of the raw columns, for errors.
        base: A transform of the other columns, ``d`` to ``d``, or None.

    Attributes:
        groups: The number of the raw column that each of the new ones is made of.
    """

    is_one_to_many = False
    transform_on_train = transform_on_eval = transform_on_fantasize = True

    def __init__(
        self,
        levels: Mapping[int, Sequence[float]],
        batches: Sequence[int],
        num_inputs: int,
        names: Sequence[str],
        base: InputTransform | None = None,
    ) -> None:
        super().__init__()
        self.levels = {i: [float(v) for v in values] for i, values in levels.items()}
        self.batches, self.names, self.base = tuple(batches), tuple(names), base
        each = [len(levels[i]) + (i in batches) if i in levels else 1 for i in range(num_inputs)]
        self.groups = tuple(i for i, number in enumerate(each) for _ in range(number))

    def transform(self, X: Tensor) -> Tensor:
        """Map raw ``... x n x d`` to ``... x n x d'``."""
        Z = X if self.base is None else self.base(X)
        if Z.shape[-1] != X.shape[-1]:
            raise ValueError(
                f"Expected an input transform that keeps the {X.shape[-1]} columns apart beside "
                f"categories, got {type(self.base).__name__}, which makes {Z.shape[-1]}."
            )
        X, parts = X.expand(Z.shape), []
        for i in range(X.shape[-1]):
            if i not in self.levels:
                parts.append(Z[..., i : i + 1])
                continue
            own = X[..., i : i + 1] == X.new_tensor(self.levels[i])
            unknown = ~own.any(-1, keepdim=True)
            if i in self.batches:
                own = torch.cat([own, unknown], dim=-1)
            elif unknown.any():
                found = X[..., i : i + 1][unknown][0].item()
                raise ValueError(
                    f"Expected {self.names[i]} to be one of {self.levels[i]}, the values that the "
                    f"model was built with, got {found:g}. Of a new value nothing is known; list "
                    "it beforehand, categorical={column: values}, or take the column as "
                    "batch=..., whose new values are new offsets."
                )
            parts.append(own.to(X) / math.sqrt(2))
        return torch.cat(parts, dim=-1)

    def grouped(self, kernel: Kernel) -> Kernel:
        """A kernel of the new columns with one lengthscale for each raw column, where it is RBF.

        It does not read batches.
        """
        read = [i for i in range(len(self.names)) if i not in self.batches]
        if not read:
            raise ValueError("Expected an input beside batches, got none.")
        groups = [read.index(i) if i in read else -1 for i in self.groups]
        for parent in [*kernel.modules()]:
            for name, child in parent.named_children():
                if type(child) is RBFKernel and child.ard_num_dims == len(groups):
                    own: Any = {"lengthscale_constraint": child.raw_lengthscale_constraint}
                    new = GroupedRBFKernel(groups, batch_shape=child.batch_shape, **own)
                    new.names = [self.names[i] for i in read]
                    setattr(parent, name, new)
        return kernel

    def untransform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d'`` back; of a level that is new, to one more than the last."""
        columns = []
        for i in range(len(self.names)):
            own = X[..., [j for j, group in enumerate(self.groups) if group == i]]
            values = self.levels.get(i)
            if values is not None:
                own = X.new_tensor([*values, values[-1] + 1])[own.argmax(-1, keepdim=True)]
            columns.append(own)
        raw = torch.cat(columns, dim=-1)
        if self.base is None:
            return raw
        plain = self.base.untransform(raw)
        kept = torch.tensor([i in self.levels for i in range(len(self.names))])
        return torch.where(kept.to(X.device), raw, plain)

    def equals(self, other: InputTransform) -> bool:
        """Return whether ``other`` has the same levels and an equal base."""
        if not isinstance(other, CategoricalInput) or self.levels != other.levels:
            return False
        bases = self.base is other.base or bool(self.base and self.base.equals(other.base))
        return self.batches == other.batches and bases


class GroupedRBFKernel(RBFKernel):
    """An RBF kernel with one lengthscale for each group of its inputs, or none of what it skips.

    Args:
        groups: The group of each input, numbers from 0; -1 for one that it does not read.
        options: As of ``RBFKernel``.

    Attributes:
        names: The names of the groups; empty if they have none.
    """

    names: Sequence[str] = ()
    raw_lengthscale: Any

    def __init__(self, groups: Sequence[int], **options: Any) -> None:
        super().__init__(ard_num_dims=len(groups), **options)
        self.groups = [*groups]
        raw: Any = self.raw_lengthscale
        self.raw_lengthscale = Parameter(raw.detach()[..., : max(groups) + 1].clone())

    @property
    def lengthscale(self) -> Tensor:
        """The lengthscale of each input, ``... x 1 x d``."""
        return self.of_inputs(self._lengthscale_param(self))

    @lengthscale.setter
    def lengthscale(self, value: Any) -> None:
        number, value = self.raw_lengthscale.shape[-1], torch.as_tensor(value)
        if value.dim() and value.shape[-1] == len(self.groups) > number:  # of inputs
            value = value[..., [self.groups.index(k) for k in range(number)]]
        self._set_lengthscale(value)

    def _lengthscale_param(self, m: Any) -> Tensor:
        """The lengthscales of groups, which priors are of."""
        lengthscales: Tensor = m.raw_lengthscale_constraint.transform(m.raw_lengthscale)
        return lengthscales

    def of_inputs(self, lengthscales: Tensor) -> Tensor:
        """Lengthscales of inputs, of those of groups, ``... x 1 x g``."""
        return torch.nn.functional.pad(lengthscales, (0, 1), value=_FAR)[..., self.groups]

    def of_groups(self, values: Tensor) -> Tensor:
        """Sums over the inputs of each group, of values ``... x d``."""
        number = self.raw_lengthscale.shape[-1]
        index = torch.tensor([g if g >= 0 else number for g in self.groups], device=values.device)
        sums = values.new_zeros(*values.shape[:-1], number + 1).index_add(-1, index, values)
        return sums[..., :number]

    def sizes(self, ranges: Tensor) -> Tensor:
        """The typical size of each group, ``... x 1 x g``: the range of one input, 1 of several."""
        count = self.of_groups(torch.ones_like(ranges))
        return torch.where(count > 1, torch.ones_like(count), self.of_groups(ranges))


class OffsetKernel(GroupedRBFKernel):
    """Independent offsets of equal variance, one for each level of a categorical column.

    Args:
        columns: The inputs that the column was replaced by.
        num_inputs: The number of all.
        options: As of ``RBFKernel``.
    """

    def __init__(self, columns: Sequence[int], num_inputs: int, **options: Any) -> None:
        super().__init__([0 if i in columns else -1 for i in range(num_inputs)], **options)
        self.columns = [*columns]
        self._set_lengthscale(_APART)
        self.raw_lengthscale.requires_grad_(False)


class OffsetFeatures(Module):
    """The features of an ``OffsetKernel``, which are finite: the columns of the levels."""

    def __init__(self, kernel: OffsetKernel, scale: ScaleKernel | None) -> None:
        super().__init__()
        self.columns, self.scale = kernel.columns, scale

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x K``."""
        features = math.sqrt(2) * x[..., self.columns]
        if self.scale is None:
            return features
        return features * self.scale.outputscale.sqrt()[..., None, None]


PROFILES[GroupedRBFKernel] = PROFILES[OffsetKernel] = lambda kernel: RBF
