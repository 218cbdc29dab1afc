"""Where a fit looks for hyper-parameters: bounds and random starts."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gpadjust.gp import LogInterval
from gpadjust.inference.objective import Objective
from gpadjust.models.parameter_scales import BOUNDS, constraint_of, kind, parameter_scales

# Ranges of the starts as multiples of a parameter's typical size.
_STARTS = {"lengthscale": (0.05, 50.0), "outputscale": (1e-2, 1e2), "noise": (1e-6, 1.0)}


class SearchSpace:
    """Bounds and starts for the raw parameters of an objective.

    Lengthscales, outputscales and noises are searched relative to their typical sizes
    (:func:`~gpadjust.models.parameter_scales.parameter_scales`), so that units do not matter.
    Parameters of other kinds start at normal draws around their current values, one to ten times
    as wide as these are large, and are bounded by nothing but their constraints. Those of the
    physics start within about a third of the user's guesses, which mean something.

    Args:
        objective: The objective whose settings are to be searched.

    Attributes:
        lower: Lower bounds, ``B x p``.
        upper: Upper bounds, ``B x p``.
        unit: What a step of one in unit coordinates is in raw parameters, ``B x p``.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self._sizes = parameter_scales(objective.model)
        self._parameters = dict(objective.model.named_parameters())
        lower = {n: self._bound(n, 0).unsqueeze(0) for n in objective.names}
        upper = {n: self._bound(n, 1).unsqueeze(0) for n in objective.names}
        current = objective.current()[0]
        # The start that the user gives may lie outside.
        self.lower = torch.minimum(objective.flatten(lower)[0], current)
        self.upper = torch.maximum(objective.flatten(upper)[0], current)
        self._is_log_variance = objective.flatten(
            {
                name: torch.full_like(self._parameters[name], self._is_variance(name))[None]
                for name in objective.names
            }
        )[0].detach()
        width = self.upper - self.lower
        bounded = width.isfinite() & (width > 0)
        self._origin = torch.where(bounded, self.lower, torch.zeros_like(width))
        self.unit = torch.where(bounded, width, _magnitude(current))

    def rescaled(self, settings: Tensor, factor: Tensor) -> Tensor:
        """Multiply all variances of settings (``k x B x p``) by factors (``k x B``)."""
        usable = factor.isfinite() & (factor > 0)
        shift = torch.where(usable, factor, torch.ones_like(factor)).log().unsqueeze(-1)
        moved = settings + self._is_log_variance * shift
        return torch.minimum(torch.maximum(moved, self.lower), self.upper)

    def draw(self, num_starts: int, generator: torch.Generator) -> Tensor:
        """Draw random settings, ``num_starts x B x p``."""
        values: dict[str, Tensor] = {}
        multiples = self._draw_multiples(num_starts, generator)
        for name in self._objective.names:
            if name in multiples:
                values[name] = self._raw(name, multiples[name])
            else:
                parameter = self._parameters[name].detach()
                shape = (num_starts, *parameter.shape)
                noise = torch.randn(shape, generator=generator, dtype=parameter.dtype)
                spread = 10 ** torch.rand(shape, generator=generator, dtype=parameter.dtype)
                if name.startswith("input_transform."):
                    spread = torch.full_like(spread, 0.3)
                noise = (spread * noise).to(parameter.device)
                values[name] = parameter + _magnitude(parameter) * noise
        settings = self._objective.flatten(values)
        return torch.minimum(torch.maximum(settings, self.lower), self.upper)

    def _draw_multiples(self, num_starts: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw values as multiples of the typical sizes.

        A function with a lengthscale of r times the data's range looks linear there, with a
        variation of 1 / r of its standard deviation: so half of the starts raise the outputscale
        by up to r^2.
        """
        multiples: dict[str, Tensor] = {}
        for name in self._objective.names:
            if name in self._sizes:
                parameter = self._parameters[name].detach()
                low, high = (math.log(limit) for limit in _STARTS[kind(name)])
                shape = (num_starts, *parameter.shape)
                share = torch.rand(shape, generator=generator, dtype=parameter.dtype)
                multiples[name] = (low + share * (high - low)).exp().to(parameter.device)
        for name, multiple in multiples.items():
            if kind(name) == "outputscale":
                path = name.removesuffix("raw_outputscale") + "base_kernel.raw_lengthscale"
                if path in multiples:
                    stretch = multiples[path].amin((-1, -2)).clamp_min(1.0)
                    power = torch.rand(multiple.shape, generator=generator, dtype=multiple.dtype)
                    multiple *= stretch.pow((4 * power - 2).clamp_min(0.0).to(stretch.device))
        return multiples

    @property
    def unit_bounds(self) -> list[tuple[float, float]]:
        """Bounds in the unit coordinates of :meth:`to_unit`, the same for all problems."""
        problems = np.arange(len(self.lower))
        lower = self.to_unit(self.lower, problems).amin(0).tolist()
        upper = self.to_unit(self.upper, problems).amax(0).tolist()
        return list(zip(lower, upper, strict=True))

    def to_unit(self, settings: Tensor, problems: np.ndarray) -> Tensor:
        """Map settings (``k x p``) of given problems (``k``): bounded parameters to [0, 1]."""
        return (settings - self._origin[problems]) / self.unit[problems]

    def from_unit(self, coordinates: Tensor, problems: np.ndarray) -> Tensor:
        """The reverse of :meth:`to_unit`."""
        return self._origin[problems] + coordinates * self.unit[problems]

    def _is_variance(self, name: str) -> bool:
        constraint = constraint_of(self._objective.model, name)
        return kind(name) in ("outputscale", "noise") and isinstance(constraint, LogInterval)

    def _bound(self, name: str, side: int) -> Tensor:
        parameter = self._parameters[name].detach()
        constraint = constraint_of(self._objective.model, name)
        if isinstance(constraint, LogInterval) or (constraint and not constraint.enforced):
            limit = (constraint.lower_bound, constraint.upper_bound)[side]
            return constraint.inverse_transform(limit.to(parameter)).expand_as(parameter)
        if name in self._sizes:
            return self._raw(name, torch.full_like(parameter, BOUNDS[kind(name)][side]))
        return torch.full_like(parameter, (-math.inf, math.inf)[side])

    def _raw(self, name: str, multiple: Tensor) -> Tensor:
        """The raw parameter at a multiple of its typical size, within its constraint."""
        value = multiple * self._sizes[name]
        constraint = constraint_of(self._objective.model, name)
        if constraint is None:
            return value
        lower, upper = constraint.lower_bound, constraint.upper_bound
        if not isinstance(constraint, LogInterval):
            # At its ends the raw parameter of a constraint that squashes is infinite.
            margin = 1e-6 * torch.where(upper.isfinite(), upper - lower, self._sizes[name])
            lower, upper = lower + margin, upper - margin
        raw: Tensor = constraint.inverse_transform(value.clamp(lower, upper))
        return raw


def _magnitude(values: Tensor) -> Tensor:
    """The absolute values, and 1 for zeros."""
    return torch.where(values == 0, torch.ones_like(values), values.abs())
