"""The learnable parameters of a model as vectors: what optimiser and sampler see."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from torch import Size, Tensor
from torch.func import functional_call
from torch.nn import Module

from gpadjust.models.hyperparameters import (
    KINDS,
    LogInterval,
    constraint_of,
    kind_of,
    typical_sizes,
)

Parameters = dict[str, Tensor]

_LITTLE_NOISE = (1e-11, 1e-6)  # the noise of half of the starts, in typical sizes


def shared_parameters(model: BatchedMultiOutputGPyTorchModel) -> list[str]:
    """The names of the learnable parameters that are no output's own, as those of a physics."""
    outputs = model._aug_batch_shape
    return [
        name
        for name, p in model.named_parameters()
        if p.requires_grad
        and (name.startswith("input_transform.") or p.shape[: len(outputs)] != outputs)
    ]


class LogParameters:
    """Vectors of a model's learnable parameters: logarithms of lengthscales and variances.

    Parameters of other kinds stay as they are. A model's outputs (and batches) have their own
    hyper-parameters each, and are ``B`` problems apart; where parameters are shared, by several
    outputs or with the input transform (a physics that learns), all outputs make up one problem.

    Bounds and starts are multiples of sizes read off the data, those of the table
    :data:`~gpadjust.models.hyperparameters.KINDS`, so that units do not matter; a constraint that
    the user gave takes their place. Parameters of other kinds start at normal draws around their
    current values, one to ten times as wide as these are large, and are bounded by nothing but
    their constraints. Those of the physics start within about a third of the user's guesses, which
    mean something.

    Args:
        model: The model.

    Attributes:
        names: The names of the raw parameters.
        batch_shape: The shape whose elements are the problems; empty for one.
        num_problems: Number ``B`` of problems.
        is_batched: Whether outputs are problems of their own.
        learns_inputs: Whether parameters of the input transform are among them.
        lower: Lower bounds, ``B x p``.
        upper: Upper bounds, ``B x p``.
        variances: 1 for a variance that nothing but the data bounds, 0 for others, ``B x p``.
        noise: 1 for such a noise variance, ``B x p``.
        is_constrained: Where bounds are those of the user's constraints, ``B x p``.

    Raises:
        ValueError: If no parameter is learnable, nor any of the physics unknown.
    """

    def __init__(self, model: BatchedMultiOutputGPyTorchModel) -> None:
        self._model = model
        self._raw = {n: p for n, p in model.named_parameters() if p.requires_grad}
        if not self._raw and not getattr(model, "has_unknowns", False):
            raise ValueError(
                "The model has no learnable parameter: all have `requires_grad=False`."
            )
        self.names = list(self._raw)
        self.learns_inputs = any(name.startswith("input_transform.") for name in self.names)
        self.is_batched = not shared_parameters(model)
        self.batch_shape = model._aug_batch_shape if self.is_batched else Size()
        self.num_problems = self.batch_shape.numel()
        self._shapes = [p.shape[len(self.batch_shape) :] for p in self._raw.values()]
        self._constraints = {name: constraint_of(model, name) for name in self.names}
        # Of the parameters whose raw one is not their logarithm already.
        self._squashes = {
            name: constraint
            for name, constraint in self._constraints.items()
            if self.is_log(name) and not isinstance(constraint, LogInterval)
        }
        self._sizes = self._typical_sizes(model)
        self.lower = self.pack(lambda name: self._bound(name, 0))
        self.upper = self.pack(lambda name: self._bound(name, 1))
        self.noise = self.mask(lambda name: kind_of(name) == "noise" and self.is_free(name))
        self.variances = self.noise + self.mask(
            lambda name: kind_of(name) == "outputscale" and self.is_free(name)
        )
        self.is_constrained = self.mask(lambda n: self.is_log(n) and not self.is_free(n)).bool()
        # A start that the user gives may lie outside, but not below the least noise.
        current = self.current()[0]
        lower = torch.minimum(self.lower, current)
        self.lower = torch.where(self.noise > 0, self.lower, lower)
        self.upper = torch.maximum(self.upper, current)

    def is_log(self, name: str) -> bool:
        """Whether a parameter is taken as its logarithm."""
        return kind_of(name) in KINDS and self._constraints.get(name) is not None

    def is_free(self, name: str) -> bool:
        """Whether nothing but the data bounds a lengthscale or variance."""
        constraint = self._constraints.get(name)
        if not self.is_log(name) or constraint is None:
            return False
        if isinstance(constraint, LogInterval):
            return constraint.is_default
        lower, upper = constraint.lower_bound, constraint.upper_bound
        return bool((lower <= 0).all()) and bool(upper.isinf().all())

    def flatten(self, values: Parameters) -> Tensor:
        """Pack one tensor per parameter name, ``k x`` its shape (or its shape), ``k x B x p``."""
        parts = [
            values[name].detach().reshape(-1, self.num_problems, shape.numel())
            for name, shape in zip(self.names, self._shapes, strict=True)
        ]
        if not parts:
            return torch.zeros(1, self.num_problems, 0, dtype=torch.float64)
        return torch.cat(parts, dim=-1)

    def unflatten(self, vectors: Tensor) -> Parameters:
        """The reverse of :meth:`flatten`."""
        if not self.names:
            return {}
        parts = vectors.split([shape.numel() for shape in self._shapes], dim=-1)
        return {
            name: part.reshape(-1, *self.batch_shape, *shape)
            for name, part, shape in zip(self.names, parts, self._shapes, strict=True)
        }

    def pack(self, value: Callable[[str], Tensor]) -> Tensor:
        """Pack what a function makes of each name, of the parameter's shape, into ``B x p``."""
        return self.flatten({name: value(name) for name in self.names})[0]

    def mask(self, which: Callable[[str], bool]) -> Tensor:
        """1 where a function of the name says so, 0 elsewhere, ``B x p``."""
        return self.pack(lambda name: torch.full_like(self.value(name), float(which(name))))

    def value(self, name: str) -> Tensor:
        """The model's own value of a parameter, its logarithm if it is taken as that."""
        raw = self._raw[name].detach()
        return self._squashes[name].transform(raw).log() if name in self._squashes else raw

    def current(self) -> Tensor:
        """The model's own vectors, ``1 x B x p``."""
        return self.pack(self.value).unsqueeze(0)

    def to_raw(self, parameters: Parameters) -> Parameters:
        """Turn values into GPyTorch's raw parameters; differentiable."""
        return {
            name: self._squashes[name].inverse_transform(value.exp())
            if name in self._squashes
            else value
            for name, value in parameters.items()
        }

    def call_at(self, parameters: Parameters, function: Callable[[], Any]) -> Any:
        """Call a function that reads the model, at other values of it; differentiable."""
        named = {f"model.{name}": value for name, value in self.to_raw(parameters).items()}
        return functional_call(_Call(self._model, function), named, ())

    def assign(self, vector: Tensor) -> None:
        """Give the model a vector, ``B x p``."""
        with torch.no_grad():
            for name, value in self.to_raw(self.unflatten(vector.unsqueeze(0))).items():
                self._raw[name].copy_(value[0])

    def clipped(self, vectors: Tensor) -> Tensor:
        """The vectors (``k x B x p``) moved into the bounds."""
        return torch.minimum(torch.maximum(vectors, self.lower), self.upper)

    def is_allowed(self, vectors: Tensor) -> Tensor:
        """Whether vectors keep to constraints and to the least noise, ``k x B``.

        Bounds that the data suggest to a search do not count.
        """
        counts = self.is_constrained | self.noise.bool()
        inside = (vectors >= self.lower) & ((vectors <= self.upper) | ~self.is_constrained)
        return (inside | ~counts).all(-1)

    def draw(self, num_starts: int, generator: torch.Generator) -> Tensor:
        """Draw random vectors, ``num_starts x B x p``."""
        values: Parameters = {}
        multiples = self._draw_multiples(num_starts, generator)
        for name in self.names:
            if name in multiples:
                values[name] = self._log(name, multiples[name])
                continue
            parameter = self.value(name)
            shape = (num_starts, *parameter.shape)
            noise = torch.randn(shape, generator=generator, dtype=parameter.dtype)
            spread = 10 ** torch.rand(shape, generator=generator, dtype=parameter.dtype)
            if name.startswith("input_transform."):
                spread.fill_(0.3)
            noise = (spread * noise).to(parameter.device)
            values[name] = parameter + magnitude(parameter) * noise
        return self.clipped(self.flatten(values))

    def _typical_sizes(self, model: BatchedMultiOutputGPyTorchModel) -> Parameters:
        """The typical sizes before any fit, which moves unknown means and so the residual."""
        sizes = typical_sizes(model)
        if not any(term.learns_mean for term in getattr(model.covar_module, "terms", ())):
            return sizes
        for name, size in sizes.items():
            constraint = self._constraints.get(name)
            if isinstance(constraint, LogInterval) and constraint.is_default:
                # The model keeps them as its bounds.
                sizes[name] = size.maximum(constraint.lower_bound / KINDS[kind_of(name)].bounds[0])
        return sizes

    def _draw_multiples(self, num_starts: int, generator: torch.Generator) -> Parameters:
        """Draw values as multiples of the typical sizes.

        A function with a lengthscale of r times the data's range looks linear there, with a
        variation of 1 / r of its standard deviation: so half of the starts raise the outputscale
        by up to r^2. The first half of the starts has next to no noise.
        """
        multiples: Parameters = {}
        for name in self.names:
            if name in self._sizes and self.is_log(name):
                parameter, kind = self.value(name), kind_of(name)
                low, high = (math.log(limit) for limit in KINDS[kind].starts)
                shape = (num_starts, *parameter.shape)
                share = torch.rand(shape, generator=generator, dtype=parameter.dtype)
                multiple = (low + share * (high - low)).exp()
                if kind == "noise":
                    low, high = (math.log(limit) for limit in _LITTLE_NOISE)
                    half = num_starts // 2
                    multiple[:half] = (low + share[:half] * (high - low)).exp()
                multiples[name] = multiple.to(parameter.device)
        for name, multiple in multiples.items():
            if kind_of(name) == "outputscale":
                path = name.removesuffix("raw_outputscale") + "base_kernel.raw_lengthscale"
                if path in multiples:
                    stretch = multiples[path].amin((-1, -2)).clamp_min(1.0)
                    power = torch.rand(multiple.shape, generator=generator, dtype=multiple.dtype)
                    multiple *= stretch.pow((4 * power - 2).clamp_min(0.0).to(stretch.device))
        return multiples

    def _bound(self, name: str, side: int) -> Tensor:
        """The lower (0) or upper (1) bound of a parameter, of its shape."""
        like = self.value(name)
        if self.is_log(name):
            return self._log(name, torch.full_like(like, KINDS[kind_of(name)].bounds[side]))
        constraint, limit = self._constraints[name], (-math.inf, math.inf)[side]
        if constraint is not None and not constraint.enforced:
            limit = (constraint.lower_bound, constraint.upper_bound)[side].item()
        return torch.full_like(like, limit)

    def _log(self, name: str, multiple: Tensor) -> Tensor:
        """The logarithm of a multiple of a parameter's typical size, within its constraint."""
        value = multiple * self._sizes[name] if name in self._sizes else multiple
        if self.is_free(name):
            return value.log()
        constraint = self._constraints[name]
        lower, upper = constraint.lower_bound.to(value), constraint.upper_bound.to(value)
        if constraint.enforced and not isinstance(constraint, LogInterval):
            # At its ends the raw parameter of a constraint that squashes is infinite.
            margin = 1e-6 * torch.where(upper.isfinite(), upper - lower, value.new_ones(()))
            lower, upper = lower + margin, upper - margin
        return value.clamp(lower, upper).log()


class _Call(Module):
    """A function beside a model, for `functional_call` to replace the model's parameters."""

    def __init__(self, model: Module, function: Callable[[], Any]) -> None:
        super().__init__()
        self.model = model
        self.forward = function


def magnitude(values: Tensor) -> Tensor:
    """The absolute values, and 1 for zeros."""
    return torch.where(values == 0, torch.ones_like(values), values.abs())
