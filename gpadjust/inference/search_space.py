"""Where a fit looks for hyper-parameters: bounds and random starts."""

from __future__ import annotations

import math

import numpy as np
import torch
from gpytorch.constraints import Interval
from torch import Tensor

from gpadjust.inference.objective import Objective
from gpadjust.models.parameter_scales import parameter_scales

# Ranges as multiples of a parameter's typical size: of starts, and of the bounds of the search.
_STARTS = {"lengthscale": (0.05, 10.0), "outputscale": (1e-2, 1e2), "noise": (1e-7, 1e-1)}
_BOUNDS = {"lengthscale": (1e-2, 1e3), "outputscale": (1e-6, 1e6), "noise": (1e-10, 1e1)}


class SearchSpace:
    """Bounds and starts for the raw parameters of an objective.

    Lengthscales, outputscales and noises are searched relative to their typical sizes
    (:func:`~gpadjust.models.parameter_scales.parameter_scales`), so that units do not matter.
    Parameters of other kinds start at their current values plus standard normal noise, and are
    bounded by nothing but their constraints.

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
        width = self.upper - self.lower
        bounded = width.isfinite() & (width > 0)
        self._origin = torch.where(bounded, self.lower, torch.zeros_like(width))
        self.unit = torch.where(bounded, width, torch.ones_like(width))

    def draw(self, num_starts: int, generator: torch.Generator) -> Tensor:
        """Draw random settings, ``num_starts x B x p``."""
        values = {}
        for name in self._objective.names:
            parameter = self._parameters[name].detach()
            shape = (num_starts, *parameter.shape)
            if name in self._sizes:
                low, high = (math.log(limit) for limit in _STARTS[_kind(name)])
                share = torch.rand(shape, generator=generator, dtype=parameter.dtype)
                values[name] = self._raw(name, (low + share * (high - low)).exp())
            else:
                noise = torch.randn(shape, generator=generator, dtype=parameter.dtype)
                values[name] = parameter + noise
        settings = self._objective.flatten(values)
        return torch.minimum(torch.maximum(settings, self.lower), self.upper)

    @property
    def unit_bounds(self) -> list[tuple[float, float]]:
        """Bounds in the unit coordinates of :meth:`to_unit`, the same for all problems."""
        problems = np.arange(len(self.lower))
        lower = self.to_unit(self.lower, problems).amin(0).tolist()
        upper = self.to_unit(self.upper, problems).amax(0).tolist()
        return list(zip(lower, upper, strict=True))

    def to_unit(self, settings: Tensor, problems: np.ndarray) -> Tensor:
        """Map settings (``k x p``) of given problems (``k``) so that bounded parameters lie in
        [0, 1]."""
        return (settings - self._origin[problems]) / self.unit[problems]

    def from_unit(self, coordinates: Tensor, problems: np.ndarray) -> Tensor:
        """The reverse of :meth:`to_unit`."""
        return self._origin[problems] + coordinates * self.unit[problems]

    def _bound(self, name: str, side: int) -> Tensor:
        parameter = self._parameters[name].detach()
        if name in self._sizes:
            return self._raw(name, torch.full_like(parameter, _BOUNDS[_kind(name)][side]))
        constraint = self._constraint(name)
        limit = torch.tensor((-math.inf, math.inf)[side], dtype=parameter.dtype)
        if constraint is not None and not constraint.enforced:
            limit = (constraint.lower_bound, constraint.upper_bound)[side].to(parameter)
        return limit.expand_as(parameter)

    def _raw(self, name: str, multiple: Tensor) -> Tensor:
        """The raw parameter at a multiple of its typical size above its lower constraint."""
        value = multiple * self._sizes[name]
        constraint = self._constraint(name)
        if constraint is None:
            return value
        floor, ceiling = constraint.lower_bound, constraint.upper_bound
        if _kind(name) == "noise":
            value = floor + value
        if ceiling.isfinite().all():
            margin = 1e-6 * (ceiling - floor)
            value = torch.minimum(torch.maximum(value, floor + margin), ceiling - margin)
        elif floor.isfinite().all():
            value = torch.maximum(value, floor * (1 + 1e-6))
        raw: Tensor = constraint.inverse_transform(value)
        return raw

    def _constraint(self, name: str) -> Interval | None:
        path, leaf = name.rsplit(".", 1) if "." in name else ("", name)
        module = self._objective.model.get_submodule(path)
        constraint = getattr(module, f"{leaf}_constraint", None)
        return constraint if isinstance(constraint, Interval) else None


def _kind(name: str) -> str:
    return name.rsplit("raw_", 1)[1]
