"""Where a fit looks for hyper-parameters: coordinates, bounds and random starts."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gpadjust.gp import LogInterval
from gpadjust.inference.objective import Objective
from gpadjust.models.parameter_scales import BOUNDS, constraint_of, kind, parameter_scales

# Ranges of the starts as multiples of a parameter's typical size.
_STARTS = {"lengthscale": (0.05, 50.0), "outputscale": (1e-2, 1e2), "noise": (1e-6, 1.0)}
_LITTLE_NOISE = (1e-12, 1e-6)
_RATIO = (1e-6, 1e6)  # of one outputscale to the last, in typical sizes
_MOST_NOISE = 1e1  # in relation to the sum of the outputscales, in typical sizes
_TOTAL = (1e-9, 1e9)  # of that sum


class SearchSpace:
    r"""Coordinates in which the parameters of an objective are searched, with bounds and starts.

    Lengthscales, outputscales and noises are taken relative to their typical sizes
    (:func:`~gpadjust.models.parameter_scales.parameter_scales`), so that units do not matter. If
    all variances are learnt as logarithms, their coordinates are the ratios of the outputscales to
    the last one, a *relative* nugget :math:`\sigma^2 / \sum_t s_t`, and the total
    :math:`\sum_t s_t`, which stays at 1 where the objective concentrates it out.

    Parameters of other kinds start at normal draws around their current values, one to ten times
    as wide as these are large, and are bounded by nothing but their constraints. Those of the
    physics start within about a third of the user's guesses, which mean something.

    Args:
        objective: The objective whose settings are to be searched.

    Attributes:
        lower: Lower bounds of the coordinates, ``B x p``.
        upper: Upper bounds, ``B x p``.
        unit: What a step of one in unit coordinates is in these, ``B x p``.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self._sizes = parameter_scales(objective.model)
        self._origin, self._is_scale, self._is_noise = self._layout()
        scales = self._is_scale[0].nonzero().squeeze(-1)
        self._ratios, self._total = scales[:-1], scales[-1:]
        self._noises = self._is_noise[0].nonzero().squeeze(-1)
        self.lower, self.upper = (self._bounds(side) for side in (0, 1))
        scale = objective.scale
        self._is_bounded = objective.flatten(
            {
                n: torch.full_like(
                    scale.current(n), float(scale.covers(n) and not objective.is_free(n))
                ).unsqueeze(0)
                for n in objective.names
            }
        )[0].bool()
        # The start that the user gives may lie outside.
        current = self.to_coordinates(objective.current())[0]
        self.lower = torch.minimum(self.lower, current)
        self.upper = torch.maximum(self.upper, current)
        width = self.upper - self.lower
        bounded = width.isfinite() & (width > 0)
        self._zero = torch.where(bounded, self.lower, torch.zeros_like(width))
        self.unit = torch.where(bounded, width, _magnitude(current))

    def to_coordinates(self, settings: Tensor) -> Tensor:
        """Map settings ``k x B x p`` to coordinates of the same shape."""
        x = settings - self._origin
        if len(self._total):
            scales = torch.cat([x[..., self._ratios], x[..., self._total]], dim=-1)
            total = scales.logsumexp(-1, keepdim=True)
            x = x.clone()
            x[..., self._ratios] = scales[..., :-1] - scales[..., -1:]
            x[..., self._noises] = x[..., self._noises] - total
            x[..., self._total] = torch.zeros_like(total) if self._objective.concentrated else total
        return x

    def to_settings(self, coordinates: Tensor) -> Tensor:
        """The reverse of :meth:`to_coordinates`, ``k x B x p``."""
        x = coordinates
        if len(self._total):
            total = x[..., self._total]
            x = x.clone()
            shares = self._log_shares(coordinates)
            x[..., self._ratios] = total + shares[..., :-1]
            x[..., self._noises] = total + x[..., self._noises]
            x[..., self._total] = total + shares[..., -1:]
        return x + self._origin

    def pull_back(self, coordinates: Tensor, gradient: Tensor) -> Tensor:
        """Turn a gradient by settings (``k x B x p``) into one by coordinates."""
        if not len(self._total):
            return gradient
        by_scales = torch.cat([gradient[..., self._ratios], gradient[..., self._total]], dim=-1)
        shares = self._log_shares(coordinates).exp()
        total = by_scales.sum(-1, keepdim=True)
        result = gradient.clone()
        result[..., self._ratios] = (by_scales - shares * total)[..., :-1]
        by_noise = gradient[..., self._noises].sum(-1, keepdim=True)
        result[..., self._total] = total + by_noise
        return result

    def is_sound(self, settings: Tensor) -> Tensor:
        """Whether settings keep to constraints and above rounding errors, ``k x B``.

        Constraints that the data suggest to a search do not count.
        """
        x = self.to_coordinates(settings)
        inside = (x >= self.lower) & (x <= self.upper) | ~self._is_bounded
        noise = x[..., self._noises] >= self.lower[..., self._noises]
        return inside.all(-1) & noise.all(-1)

    def rescaled(self, coordinates: Tensor, factor: Tensor) -> Tensor:
        """Multiply all variances of coordinates (``k x B x p``) by factors (``k x B``)."""
        usable = factor.isfinite() & (factor > 0)
        shift = torch.where(usable, factor, torch.ones_like(factor)).log().unsqueeze(-1)
        if not len(self._total):
            return self.clipped(coordinates + self._objective.variances * shift)
        moved = coordinates.clone()
        moved[..., self._total] += shift
        return self.clipped(moved)

    def draw(self, num_starts: int, generator: torch.Generator) -> Tensor:
        """Draw random coordinates, ``num_starts x B x p``."""
        values: dict[str, Tensor] = {}
        multiples = self._draw_multiples(num_starts, generator)
        for name in self._objective.names:
            if name in multiples:
                values[name] = self._log(name, multiples[name])
            else:
                parameter = self._objective.scale.current(name)
                shape = (num_starts, *parameter.shape)
                noise = torch.randn(shape, generator=generator, dtype=parameter.dtype)
                spread = 10 ** torch.rand(shape, generator=generator, dtype=parameter.dtype)
                if name.startswith("input_transform."):
                    spread = torch.full_like(spread, 0.3)
                noise = (spread * noise).to(parameter.device)
                values[name] = parameter + _magnitude(parameter) * noise
        return self.clipped(self.to_coordinates(self._objective.flatten(values)))

    def _draw_multiples(self, num_starts: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw values as multiples of the typical sizes.

        A function with a lengthscale of r times the data's range looks linear there, with a
        variation of 1 / r of its standard deviation: so half of the starts raise the outputscale
        by up to r^2. The first half of the starts has next to no noise.
        """
        multiples: dict[str, Tensor] = {}
        for name in self._objective.names:
            if name in self._sizes and self._objective.scale.covers(name):
                parameter = self._objective.scale.current(name)
                low, high = (math.log(limit) for limit in _STARTS[kind(name)])
                shape = (num_starts, *parameter.shape)
                share = torch.rand(shape, generator=generator, dtype=parameter.dtype)
                multiple = (low + share * (high - low)).exp()
                if kind(name) == "noise":
                    low, high = (math.log(limit) for limit in _LITTLE_NOISE)
                    half = num_starts // 2
                    multiple[:half] = (low + share[:half] * (high - low)).exp()
                multiples[name] = multiple.to(parameter.device)
        for name, multiple in multiples.items():
            if kind(name) == "outputscale":
                path = name.removesuffix("raw_outputscale") + "base_kernel.raw_lengthscale"
                if path in multiples:
                    stretch = multiples[path].amin((-1, -2)).clamp_min(1.0)
                    power = torch.rand(multiple.shape, generator=generator, dtype=multiple.dtype)
                    multiple *= stretch.pow((4 * power - 2).clamp_min(0.0).to(stretch.device))
        return multiples

    def _layout(self) -> tuple[Tensor, Tensor, Tensor]:
        """What coordinates are counted from, and which settings are outputscales and noises.

        The latter are none, and the former zero, unless all variances are logarithms.
        """
        objective = self._objective
        origin: dict[str, Tensor] = {}
        masks: tuple[dict[str, Tensor], dict[str, Tensor]] = ({}, {})
        variances = [n for n in objective.names if kind(n) in ("outputscale", "noise")]
        relative = objective.is_batched and all(objective.is_free(n) for n in variances)
        relative = relative and objective.has_one_noise
        for name in objective.names:
            like = self._objective.scale.current(name).unsqueeze(0)
            origin[name] = torch.zeros_like(like)
            if relative and name in self._sizes and objective.scale.covers(name):
                origin[name] = self._sizes[name].log().expand_as(like)
            for mask, which in zip(masks, ("outputscale", "noise"), strict=True):
                mask[name] = torch.full_like(like, relative and kind(name) == which)
        flat = [objective.flatten(values)[0] for values in (origin, *masks)]
        return flat[0], flat[1].bool(), flat[2].bool()

    def _log_shares(self, coordinates: Tensor) -> Tensor:
        """The logarithms of the outputscales' shares of their total, ``k x B x T``."""
        ratios = coordinates[..., self._ratios]
        return torch.cat([ratios, torch.zeros_like(coordinates[..., :1])], dim=-1).log_softmax(-1)

    def _bounds(self, side: int) -> Tensor:
        """Lower (0) or upper (1) bounds of the coordinates, ``B x p``."""
        objective = self._objective
        limits = {n: self._bound(n, side).unsqueeze(0) for n in objective.names}
        bounds = objective.flatten(limits)[0] - self._origin
        if len(self._total):
            bounds[..., self._ratios] = math.log(_RATIO[side])
            # With less noise than that, rounding errors would decide where the optimum is.
            n = objective.model.train_targets.shape[-1]
            least_noise = 10 * n**2 * torch.finfo(bounds.dtype).eps
            bounds[..., self._noises] = math.log((least_noise, _MOST_NOISE)[side])
            bounds[..., self._total] = 0.0 if objective.concentrated else math.log(_TOTAL[side])
        return bounds

    @property
    def learns_noise(self) -> bool:
        """Whether a noise variance is among the parameters."""
        return any(kind(name) == "noise" for name in self._objective.names)

    @property
    def unit_bounds(self) -> list[tuple[float, float]]:
        """Bounds in unit coordinates, the same for all problems."""
        lower = ((self.lower - self._zero) / self.unit).amin(0).tolist()
        upper = ((self.upper - self._zero) / self.unit).amax(0).tolist()
        return list(zip(lower, upper, strict=True))

    def to_unit(self, coordinates: Tensor) -> Tensor:
        """Map coordinates ``k x B x p`` to unit coordinates: bounded ones to [0, 1]."""
        return (coordinates - self._zero) / self.unit

    def from_unit(self, unit: Tensor) -> Tensor:
        """The reverse of :meth:`to_unit`."""
        return self._zero + unit * self.unit

    def within(self, settings: Tensor) -> Tensor:
        """The settings (``k x B x p``) moved into the bounds."""
        return self.to_settings(self.clipped(self.to_coordinates(settings)))

    def clipped(self, coordinates: Tensor) -> Tensor:
        """The coordinates (``k x B x p``) moved into the bounds."""
        return torch.minimum(torch.maximum(coordinates, self.lower), self.upper)

    def _bound(self, name: str, side: int) -> Tensor:
        like = self._objective.scale.current(name)
        if self._objective.scale.covers(name):
            return self._log(name, torch.full_like(like, BOUNDS[kind(name)][side]))
        constraint = constraint_of(self._objective.model, name)
        limits = (-math.inf, math.inf)
        if constraint is not None and not constraint.enforced:
            limits = (constraint.lower_bound.item(), constraint.upper_bound.item())
        return torch.full_like(like, limits[side])

    def _log(self, name: str, multiple: Tensor) -> Tensor:
        """The logarithm of a multiple of a parameter's typical size, within its constraint."""
        value = multiple * self._sizes[name] if name in self._sizes else multiple
        if self._objective.is_free(name):
            return value.log()
        constraint = self._objective.scale.constraint(name)
        lower, upper = constraint.lower_bound.to(value), constraint.upper_bound.to(value)
        if constraint.enforced and not isinstance(constraint, LogInterval):
            # At its ends the raw parameter of a constraint that squashes is infinite.
            margin = 1e-6 * torch.where(upper.isfinite(), upper - lower, value.new_ones(()))
            lower, upper = lower + margin, upper - margin
        return value.clamp(lower, upper).log()


def _magnitude(values: Tensor) -> Tensor:
    """The absolute values, and 1 for zeros."""
    return torch.where(values == 0, torch.ones_like(values), values.abs())
