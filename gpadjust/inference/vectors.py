"""Vectors of the learnable parameters of a model, for optimiser and sampler."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from torch import Size, Tensor
from torch.func import functional_call
from torch.nn import Module

from gpadjust.models.parameters import KINDS, Hyperparameter, hyperparameters

_LITTLE_NOISE = (1e-11, 1e-6)  # the noise of half of the starts, in typical sizes
_GUESSED = 0.3  # spread of the starts of a physics' parameters around the user's guesses

Values = dict[str, Tensor]
"""What vectors have of parameters, by their names: ``k x`` their shape, or their shape."""


class Parameters:
    """Vectors of a model's learnable parameters: logarithms of lengthscales and variances.

    Parameters of other kinds stay as they are. A model's outputs (and batches) are ``B`` problems
    apart; where parameters are shared, by several outputs or with the input transform (a physics
    that learns), all outputs make up one problem.

    Bounds and starts are multiples of sizes read off the data, so that units do not matter; a
    constraint that the user gave takes their place. Parameters of other kinds start around their
    current values (those of the physics within about a third, the others one to ten times as wide),
    and are bounded by nothing but their constraints.

    Attributes:
        table: The rows of all its parameters, by the ``id`` of the raw one.
        rows: Those that are learnable, and ``names`` their names.
        batch_shape: The shape whose elements are the ``num_problems`` = ``B`` problems; empty for
            one.
        is_batched: Whether outputs are problems of their own.
        learns_inputs: Whether parameters of the input transform are among them.
        lower: Lower bounds, ``B x p``; ``upper`` upper ones.
        variances: 1 for a variance that nothing but the data bounds, 0 for others, ``B x p``.
        noise: 1 for such a noise variance, ``B x p``.
        is_constrained: Where bounds are those of the user's constraints, ``B x p``.

    Raises:
        ValueError: If no parameter is learnable, nor any of the physics unknown.
    """

    def __init__(self, model: BatchedMultiOutputGPyTorchModel) -> None:
        self._model = model
        every = hyperparameters(model)
        self.table = {id(row.raw): row for row in every}
        self.rows = [row for row in every if row.raw.requires_grad]
        if not self.rows and not getattr(model, "has_unknowns", False):
            raise ValueError(
                "The model has no learnable parameter: all have `requires_grad=False`."
            )
        self.names = [row.name for row in self.rows]
        self.learns_inputs = any(row.kind == "physics" for row in self.rows)
        self.is_batched = not any(row.is_shared for row in self.rows)
        self.batch_shape = model._aug_batch_shape if self.is_batched else Size()
        self.num_problems = self.batch_shape.numel()
        self.noise = self.mask(lambda row: row.kind == "noise" and row.is_free)
        self.variances = self.mask(lambda row: row.kind != "lengthscale" and row.is_free)
        self.is_constrained = self.mask(lambda row: row.is_log and not row.is_free).bool()
        lower = self._pack(lambda row: row.limits()[0])
        upper = self._pack(lambda row: row.limits()[1])
        # A start that the user gives may lie outside, but not below the least noise.
        current = self.current()[0]
        self.lower = torch.where(self.noise > 0, lower, torch.minimum(lower, current))
        self.upper = torch.maximum(upper, current)

    def flatten(self, values: Values) -> Tensor:
        """Pack values, ``k x`` each parameter's shape (or its shape), into ``k x B x p``."""
        lead = len(self.batch_shape)
        parts = [
            values[row.name].detach().reshape(-1, self.num_problems, row.raw.shape[lead:].numel())
            for row in self.rows
        ]
        return (
            torch.cat(parts, -1)
            if parts
            else self._model.train_targets.new_zeros(1, self.num_problems, 0)
        )

    def unflatten(self, vectors: Tensor) -> Values:
        """The reverse of :meth:`flatten`."""
        shapes = [row.raw.shape[len(self.batch_shape) :] for row in self.rows]
        parts = vectors.split([shape.numel() for shape in shapes], dim=-1) if shapes else ()
        return {
            name: part.reshape(-1, *self.batch_shape, *shape)
            for name, part, shape in zip(self.names, parts, shapes, strict=True)
        }

    def mask(self, which: Callable[[Hyperparameter], bool]) -> Tensor:
        """1 where a function of the row says so, 0 elsewhere, ``B x p``."""
        return self._pack(lambda row: torch.full_like(row.raw, float(which(row))))

    def current(self) -> Tensor:
        """The model's own vectors, ``1 x B x p``."""
        return self._pack(Hyperparameter.value).unsqueeze(0)

    def to_raw(self, values: Values) -> Values:
        """Turn values into GPyTorch's raw parameters; differentiable."""
        return {row.name: row.to_raw(values[row.name]) for row in self.rows}

    def call_at(self, values: Values, function: Callable[[], Any]) -> Any:
        """Call a function that reads the model, at other values of it; differentiable."""
        named = {f"model.{name}": value for name, value in self.to_raw(values).items()}
        return functional_call(_Call(self._model, function), named, ())

    @torch.no_grad()
    def assign(self, vector: Tensor) -> None:
        """Give the model a vector, ``B x p``."""
        raw = self.to_raw(self.unflatten(vector.unsqueeze(0)))
        for row in self.rows:
            row.raw.copy_(raw[row.name][0])

    def clipped(self, vectors: Tensor) -> Tensor:
        """The vectors (``k x B x p``) moved into the bounds."""
        return torch.minimum(torch.maximum(vectors, self.lower), self.upper)

    def is_allowed(self, vectors: Tensor) -> Tensor:
        """Return whether vectors keep to constraints and to the least noise, ``k x B``.

        Bounds that the data suggest to a search do not count.
        """
        counts = self.is_constrained | self.noise.bool()
        inside = (vectors >= self.lower) & ((vectors <= self.upper) | ~self.is_constrained)
        return (inside | ~counts).all(-1)

    def draw(self, num_starts: int, generator: torch.Generator) -> Tensor:
        """Draw random vectors, ``num_starts x B x p``.

        A function with a lengthscale of r times the data's range looks linear there, with a
        variation of 1 / r of its standard deviation: so half of the starts raise the outputscale
        by up to r^2. The first half of the starts has next to no noise.
        """
        options: Any = {"generator": generator, "dtype": self.lower.dtype}
        multiples, lengths, values = dict[str, Tensor](), dict[int, Tensor](), dict[str, Tensor]()
        half = num_starts // 2
        for row in self.rows:
            if not row.is_log:
                continue
            share = torch.rand(num_starts, *row.raw.shape, **options).to(row.raw.device)
            low, high = map(math.log, KINDS[row.kind].starts)
            multiples[row.name] = (low + share * (high - low)).exp()
            if row.kind == "noise":
                low, high = map(math.log, _LITTLE_NOISE)
                multiples[row.name][:half] = (low + share[:half] * (high - low)).exp()
            if row.kind == "lengthscale":
                lengths[id(row.owner)] = multiples[row.name].amin((-1, -2)).clamp_min(1.0)
        for row in self.rows:
            stretch = lengths.get(id(getattr(row.owner, "base_kernel", None)))
            if row.name in multiples and stretch is not None:
                power = torch.rand(num_starts, *row.raw.shape, **options).to(row.raw.device)
                multiples[row.name] *= stretch.pow((4 * power - 2).clamp_min(0.0))
        for row in self.rows:
            if row.name in multiples:
                values[row.name] = row.log_of(multiples[row.name])
                continue
            value, shape = row.value(), (num_starts, *row.raw.shape)
            away = torch.randn(shape, **options).to(value.device)
            spread = 10 ** torch.rand(shape, **options).to(value.device)
            spread = torch.full_like(spread, _GUESSED) if row.kind == "physics" else spread
            values[row.name] = value + magnitude(value) * spread * away
        return self.clipped(self.flatten(values))

    def _pack(self, function: Callable[[Hyperparameter], Tensor]) -> Tensor:
        """Pack what a function makes of each row, of the parameter's shape, into ``B x p``."""
        return self.flatten({row.name: function(row) for row in self.rows})[0]


class _Call(Module):
    """A function beside a model, for `functional_call` to replace the model's parameters."""

    def __init__(self, model: Module, function: Callable[[], Any]) -> None:
        super().__init__()
        self.model = model
        self.forward = function


def magnitude(values: Tensor) -> Tensor:
    """The absolute values, and 1 for zeros."""
    return torch.where(values == 0, torch.ones_like(values), values.abs())
