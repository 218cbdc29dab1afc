"""Unknown parameters of a physics, and their priors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from keyword import iskeyword

import torch
from torch import Tensor
from torch.special import ndtr, ndtri

from gpadjust.checks import checked_number

_LARGEST = 8.0  # coordinate, beyond which float64 knows no mass of the normal distribution
_UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True, repr=False)
class Unknown:
    r"""An unknown parameter of a physics, and its prior.

    Its prior is one of three: :math:`N(\text{guess}, \text{sd}^2)`; a log-normal one, of which
    ``factor`` is one standard deviation (1.5: two thirds to one and a half times the guess are
    likely); or, with neither, the uniform one between ``bounds``, which cut off the other two.

    Args:
        guess: The value that the physics has where nothing was learnt; inside the bounds.
        sd: Standard deviation of a normal prior, in the parameter's unit.
        factor: What a log-normal prior multiplies or divides the guess by, above 1.
        bounds: The least and the largest possible value.
        unit: Its unit, for tables and figures.

    Example:
        >>> Unknown(9.81, sd=0.1, unit="m/s²"), Unknown(0.2, bounds=(0.0, 1.0)).prior_text
        (Unknown(9.81, sd=0.1, unit='m/s²'), '0 to 1')
    """

    guess: float
    sd: float | None = None
    factor: float | None = None
    bounds: tuple[float, float] = _UNBOUNDED
    unit: str = ""

    def __post_init__(self) -> None:
        checked_number("guess", self.guess)
        for name, least in (("sd", 0.0), ("factor", 1.0)):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), above=least)
        low, high = map(float, self.bounds)
        object.__setattr__(self, "bounds", (low, high))
        spreads = (self.sd is not None) + (self.factor is not None)
        is_one_prior = spreads == 1 or (spreads == 0 and math.isfinite(high - low))
        is_positive = self.factor is None or self.guess > 0
        if not (low < self.guess < high and is_positive and is_one_prior):
            raise ValueError(
                "Expected a guess inside of the bounds, above 0 with a factor, and one prior: sd, "
                f"factor, or two finite bounds; found {self!r}."
            )

    def __repr__(self) -> str:
        # The code that makes it, without defaults.
        options = [(each.name, getattr(self, each.name), each.default) for each in fields(self)[1:]]
        texts = [f"{name}={value!r}" for name, value, default in options if value != default]
        return f"Unknown({', '.join([repr(self.guess), *texts])})"

    @property
    def prior_text(self) -> str:
        """The prior, for tables."""
        low, high = self.bounds
        limits = f"{low:g} to {high:g}"
        if math.inf in (high, -low):
            limits = f"above {low:g}" if high == math.inf else f"below {high:g}"
        if self.sd is None and self.factor is None:
            return limits
        spread = f" ± {self.sd:g}" if self.factor is None else f", factor {self.factor:g}"
        text = f"{self.guess:g}{spread}"
        return text if self.bounds == _UNBOUNDED else f"{text}, {limits}"

    def value(self, z: Tensor) -> Tensor:
        """Return the value at a coordinate, which is standard normal by the prior."""
        low, high = self.bounds
        below, above = self._tails
        if self._tails != (0.0, 1.0):
            z = ndtri(below + (above - below) * ndtr(z.clamp(-_LARGEST, _LARGEST)))
        if self.sd is not None:
            value = self.guess + self.sd * z
        elif self.factor is not None:
            value = self.guess * (math.log(self.factor) * z).exp()
        else:
            value = low + (high - low) * ndtr(z.clamp(-_LARGEST, _LARGEST))
        return value.clamp(low, high)  # beyond there are rounding errors

    def coordinate(self, value: Tensor) -> Tensor:
        """Return the coordinate at which :meth:`value` is this one."""
        below, above = self._tails
        z = self._without_bounds(value)
        return z if self._tails == (0.0, 1.0) else ndtri((ndtr(z) - below) / (above - below))

    def _without_bounds(self, value: Tensor) -> Tensor:
        """Return the coordinate by the prior that bounds do not cut off."""
        low, high = self.bounds
        if self.sd is not None:
            return (value - self.guess) / self.sd
        if self.factor is not None:
            return (value.clamp_min(0.0) / self.guess).log() / math.log(self.factor)
        return ndtri((value - low) / (high - low))

    @cached_property
    def _tails(self) -> tuple[float, ...]:
        """The probabilities below both bounds by the prior that they do not cut off."""
        z = self._without_bounds(torch.tensor(self.bounds, dtype=torch.float64))
        # Unlike those of ndtr, tiny ones are 0: such bounds cut off nothing.
        return tuple((0.5 * (1 + torch.erf(z / math.sqrt(2)))).tolist())


class Unknowns(dict[str, Unknown]):
    """The unknown parameters of a physics, by name, and their coordinates."""

    def __init__(self, unknowns: Mapping[str, Unknown]) -> None:
        is_mapping = isinstance(unknowns, Mapping)
        if not is_mapping or not all(isinstance(u, Unknown) for u in unknowns.values()):
            raise TypeError(
                f"unknowns must map names to Unknown(guess, sd=...); found {unknowns!r}."
            )
        for name in unknowns:
            is_path = isinstance(name, str) and ("." in name.strip(".") or "[" in name)
            is_word = isinstance(name, str) and name.isidentifier() and not iskeyword(name)
            is_attribute = is_word and not name.startswith("_") and name != "rows"
            if not is_path and (not is_attribute or hasattr(dict, name)):
                raise ValueError(
                    "Expected a name that can be an attribute, or one with a point or bracket, "
                    f"such as 'link1.mass' or 'wall[1].G', found {name!r}."
                )
        super().__init__(unknowns)

    @property
    def guess(self) -> Tensor:
        """The guesses, ``p``."""
        return torch.tensor([u.guess for u in self.values()], dtype=torch.float64)

    def at(self, coordinates: Tensor) -> Tensor:
        """Return values ``... x p`` at coordinates ``... x p``, standard normal by the prior."""
        pairs = zip(self.values(), coordinates.unbind(-1), strict=True)
        return torch.stack([u.value(z) for u, z in pairs], dim=-1)

    def coordinates(self, values: Tensor) -> Tensor:
        """Return the coordinates ``... x p`` of values ``... x p``."""
        pairs = zip(self.values(), values.unbind(-1), strict=True)
        return torch.stack([u.coordinate(value) for u, value in pairs], dim=-1)
