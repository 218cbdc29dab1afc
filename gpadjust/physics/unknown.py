"""Unknown parameters of a physics, and their priors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from keyword import iskeyword
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Normal

_STANDARD = Normal(
    torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64), validate_args=False
)
_LARGEST = 8.0  # coordinate, beyond which float64 knows no mass of the normal distribution


@dataclass(frozen=True, repr=False)
class Unknown:
    r"""An unknown parameter of a physics, and its prior.

    Its prior is one of three: :math:`N(\text{guess}, \text{sd}^2)`; a log-normal one, of which
    ``factor`` is one standard deviation (1.5: two thirds to one and a half times the guess are
    likely); or, with neither, the uniform one between ``bounds``. Bounds beside ``sd`` or
    ``factor`` cut their prior off.

    Args:
        guess: The value that the physics has where nothing was learnt; inside the bounds.
        sd: Standard deviation of a normal prior, in the parameter's unit.
        factor: What a log-normal prior multiplies or divides the guess by, above 1.
        bounds: What the parameter cannot be beyond.
        unit: Its unit, for tables and figures.

    Raises:
        TypeError: If a number is none.
        ValueError: If numbers are out of range, or there is no prior, or more than one.

    Example:
        >>> Unknown(9.81, sd=0.1, unit="m/s²"), Unknown(0.2, bounds=(0.0, 1.0)).prior_text
        (Unknown(9.81, sd=0.1, unit='m/s²'), '0 to 1')
    """

    guess: float
    sd: float | None = None
    factor: float | None = None
    bounds: tuple[float, float] = (-math.inf, math.inf)
    unit: str = ""

    def __post_init__(self) -> None:
        for name in ("guess", "sd", "factor"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, Real)):
                raise TypeError(f"{name} must be a number; found {value!r}.")
        try:
            low, high = (float(end) for end in self.bounds)
        except (TypeError, ValueError):
            raise TypeError(f"bounds must be two numbers; found {self.bounds!r}.") from None
        if not low < self.guess < high or not math.isfinite(self.guess):
            raise ValueError(
                f"guess must be finite and inside of the bounds; found {self.guess} and "
                f"{self.bounds}."
            )
        if self.sd is not None and not 0 < self.sd < math.inf:
            raise ValueError(f"sd must be positive and finite; found {self.sd}.")
        if self.factor is not None and not 1 < self.factor < math.inf:
            raise ValueError(f"factor must be above 1 and finite; found {self.factor}.")
        if self.factor is not None and self.guess <= 0:
            raise ValueError(
                f"A factor is about a positive guess; found {self.guess}. Give sd instead."
            )
        if self.sd is not None and self.factor is not None:
            raise ValueError("Found sd and factor; give one of them.")
        if self.sd is None and self.factor is None and not math.isfinite(high - low):
            raise ValueError(
                "Found no prior; give sd, the standard deviation of a normal one, or factor, that "
                "of a log-normal one, or two finite bounds."
            )
        object.__setattr__(self, "bounds", (low, high))

    def __repr__(self) -> str:
        """The code that makes it, without what is left at its default."""
        given = [(each, getattr(self, each.name)) for each in fields(self)[1:]]
        told = [f"{each.name}={value!r}" for each, value in given if value != each.default]
        return f"Unknown({', '.join([repr(self.guess), *told])})"

    @property
    def prior_text(self) -> str:
        """The prior, for tables."""
        low, high = self.bounds
        limits = f"{low:g} to {high:g}" if math.isfinite(high - low) else f"above {low:g}"
        limits = f"below {high:g}" if low == -math.inf else limits
        if self.sd is None and self.factor is None:
            return limits
        text = f"{self.guess:g} ± {self.sd or 0.0:g}"
        if self.factor is not None:
            text = f"{self.guess:g}, factor {self.factor:g}"
        return text if self.bounds == (-math.inf, math.inf) else f"{text}, {limits}"

    def value(self, z: Tensor) -> Tensor:
        """The value at a coordinate, which is standard normal by the prior."""
        low, high = self.bounds
        if self._is_cut:
            below, above = self._cdf(low), self._cdf(high)
            z = _STANDARD.icdf(below + (above - below) * _share(z))
        if self._is_uniform:
            value = low + (high - low) * _share(z)
        elif self.factor is not None:
            value = self.guess * (math.log(self.factor) * z).exp()
        else:
            value = self.guess + (self.sd or 0.0) * z
        return value.clamp(low, high)  # beyond there are rounding errors

    def coordinate(self, value: Tensor) -> Tensor:
        """The reverse of :meth:`value`."""
        low, high = self.bounds
        if self._is_uniform:
            return _STANDARD.icdf((value - low) / (high - low))
        z = self._without_bounds(value)
        if self._is_cut:
            below, above = self._cdf(low), self._cdf(high)
            z = _STANDARD.icdf((_STANDARD.cdf(z) - below) / (above - below))
        return z

    @property
    def _is_uniform(self) -> bool:
        return self.sd is None and self.factor is None

    @property
    def _is_cut(self) -> bool:
        low, high = self.bounds
        return not self._is_uniform and (high < math.inf or low > (-math.inf if self.sd else 0.0))

    def _without_bounds(self, value: Tensor) -> Tensor:
        """The coordinate by the prior without bounds."""
        if self.factor is not None:
            return (value.clamp_min(0.0) / self.guess).log() / math.log(self.factor)
        return (value - self.guess) / (self.sd or 1.0)

    def _cdf(self, value: float) -> float:
        """Return the probability below a value by the prior without bounds."""
        end = torch.tensor(value, dtype=torch.float64)
        return float(_STANDARD.cdf(self._without_bounds(end)))


def _share(z: Tensor) -> Tensor:
    """Return the standard normal probability below ``z``, never 0 or 1."""
    return _STANDARD.cdf(z.clamp(-_LARGEST, _LARGEST))


class ParameterValues(Mapping[str, Any]):
    """Values of parameters by their names, as items or attributes: ``p["mass"]``, ``p.mass``.

    They are ``N`` each of ``rows``, ``N x p``, or numbers of a single row, ``p``.
    """

    def __init__(self, names: tuple[str, ...], rows: Any) -> None:
        self._names = names
        self.rows = rows

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(f"There is no parameter {name!r}; there are {', '.join(self._names)}.")
        return self.rows[..., self._names.index(name)]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also of a copy that has nothing yet
            raise AttributeError(name)
        if name not in self._names:
            known = ", ".join(self._names)
            raise AttributeError(f"there is no parameter {name!r}; there are {known}")
        return self[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def numpy(self) -> ParameterValues:
        """Return the values as NumPy arrays."""
        return ParameterValues(self._names, self.rows.detach().cpu().double().numpy().copy())

    def row(self, i: int) -> ParameterValues:
        """Return the values of a row, a number each."""
        return ParameterValues(self._names, np.asarray(self.rows[i]))


class Unknowns(dict[str, Unknown]):
    """The unknown parameters of a physics, by name, and their coordinates."""

    def __init__(self, given: Mapping[str, Unknown] | None) -> None:
        given = {} if given is None else given
        if not isinstance(given, Mapping) or not all(
            isinstance(u, Unknown) for u in given.values()
        ):
            raise TypeError(
                "unknowns must map names to Unknown(guess, sd=...), such as "
                f"{{'mass': Unknown(1.0, factor=1.5)}}; found {given!r}."
            )
        for name in given:
            is_word = isinstance(name, str) and name.isidentifier() and not iskeyword(name)
            if not is_word or name.startswith("_") or hasattr(ParameterValues((), None), name):
                raise ValueError(
                    f"Unknown parameters have names such as 'mass', that can be attributes; found "
                    f"{name!r}."
                )
        super().__init__(given)

    @property
    def names(self) -> tuple[str, ...]:
        """The names."""
        return tuple(self)

    @property
    def guess(self) -> Tensor:
        """The guesses, ``p``."""
        return torch.tensor([u.guess for u in self.values()], dtype=torch.float64)

    def at(self, coordinates: Tensor) -> Tensor:
        """Values ``... x p`` at coordinates ``... x p``, standard normal by the prior."""
        pairs = zip(self.values(), coordinates.unbind(-1), strict=True)
        return torch.stack([u.value(z) for u, z in pairs], dim=-1)

    def coordinates(self, values: Tensor) -> Tensor:
        """The reverse of :meth:`at`."""
        pairs = zip(self.values(), values.unbind(-1), strict=True)
        return torch.stack([u.coordinate(value) for u, value in pairs], dim=-1)

    def named(self, values: Tensor) -> ParameterValues:
        """Values ``N x p`` by name."""
        return ParameterValues(self.names, values)
