"""Unknown parameters of a physics, and their priors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from keyword import iskeyword
from typing import Any

import torch
from torch import Tensor
from torch.special import ndtr, ndtri

from gpadjust.checks import check_kind, checked_number, real_array

LARGEST = 8.0  # coordinate, beyond which float64 has no mass of the normal distribution
_UNBOUNDED = (-math.inf, math.inf)
_KNOTS = 3.0  # of a function, in a lengthscale
_MOST_KNOTS = 60
_OF_RANGE = 0.25  # a lengthscale, by default
_NUGGET = 1e-10
_AT_BOUND = 40.0  # coordinate of a knot, in place of infinity


def _pair(name: str, pair: Any) -> tuple[float, float]:
    """Return the least and the largest value as floats, or raise a ValueError."""
    try:
        low, high = real_array(pair).tolist()
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"Expected {name} as two numbers, such as (0.0, 20.0); found {pair!r}."
        ) from error
    return low, high


@dataclass(frozen=True, repr=False)
class Unknown:
    r"""An unknown parameter of a physics, and its prior; a number, or a function.

    Its prior is one of three: :math:`N(\text{guess}, \text{sd}^2)`; a log-normal one, of which
    ``factor`` is one standard deviation (1.5: two thirds to one and a half times the guess are
    likely); or, with neither, the uniform one between ``bounds``, which cut off the other two.

    A function of one variable, such as friction of speed, has this prior at each point. Its
    coordinates are a Gaussian process along the variable, with a Matern kernel (5/2); beyond
    ``between`` it stays as it is at the end. Models learn its values at knots, ``friction(0)`` and
    so on, three in a lengthscale. A function of torch calls it, ``p.friction(speed)``.

    Args:
        guess: The value before a fit; inside the bounds.
        sd: Standard deviation of a normal prior, in the parameter's unit.
        factor: Factor of one standard deviation of a log-normal prior, above 1.
        bounds: The least and the largest possible value.
        unit: Its unit, for tables and figures.
        function_of: The variable of a function. A :class:`FormulaPhysics` reads it, as a formula of
            its columns and numbers: ``"speed"`` or ``"abs(speed)"``. Default: a number.
        between: The least and the largest value of that variable; needed of a function.
        lengthscale: Distance along the variable over which a function changes. Default: a quarter
            of the range.

    Raises:
        ValueError: If guess, bounds and prior do not suit each other, or only some of the arguments
            of a function are there.

    Example:
        >>> Unknown(9.81, sd=0.1, unit="m/s²"), Unknown(0.2, bounds=(0.0, 1.0)).prior_text
        (Unknown(9.81, sd=0.1, unit='m/s²'), '0 to 1')
        >>> friction = Unknown(0.1, factor=2.0, function_of="speed", between=(0.0, 12.0))
        >>> friction.knots[:4].tolist()
        [0.0, 1.0, 2.0, 3.0]
    """

    guess: float
    sd: float | None = None
    factor: float | None = None
    bounds: tuple[float, float] = _UNBOUNDED
    unit: str = ""
    function_of: str = ""
    between: tuple[float, float] | None = None
    lengthscale: float | None = None

    def __post_init__(self) -> None:
        # Plain floats, as programs and fingerprints have their repr, not that of NumPy's numbers.
        object.__setattr__(self, "guess", checked_number("guess", self.guess))
        for name, least in (("sd", 0.0), ("factor", 1.0)):
            if getattr(self, name) is not None:
                value = checked_number(name, getattr(self, name), above=least)
                object.__setattr__(self, name, value)
        low, high = _pair("bounds", self.bounds)
        object.__setattr__(self, "bounds", (low, high))
        # sd, factor or two finite bounds: one of them is the prior.
        lacking = (self.sd, self.factor).count(None)
        is_one_prior = lacking == 1 or (lacking == 2 and math.isfinite(high - low))
        is_positive = self.factor is None or self.guess > 0
        if not (low < self.guess < high and is_positive and is_one_prior):
            raise ValueError(
                "Expected a guess inside of the bounds, above 0 with a factor, and one prior: sd, "
                f"factor, or two finite bounds; found {self!r}."
            )
        check_kind("function_of", self.function_of, str, "the name of a variable")
        if (self.function_of, self.between, self.lengthscale) != ("", None, None):
            self._check_function()

    def _check_function(self) -> None:
        """Raise an error unless the arguments of a function suit each other."""
        low, high = (0.0, 0.0) if self.between is None else _pair("between", self.between)
        if not (self.function_of and low < high and math.isfinite(high - low)):
            raise ValueError(
                'Expected of a function its variable and the range of that, function_of="speed", '
                f"between=(0.0, 20.0); found {self!r}."
            )
        scale = _OF_RANGE * (high - low)
        if self.lengthscale is not None:
            scale = checked_number("lengthscale", self.lengthscale, above=0)
        if (high - low) / scale > _MOST_KNOTS / _KNOTS:
            raise ValueError(
                f"Expected a lengthscale of {_KNOTS / _MOST_KNOTS:g} of the range or more, found "
                f"{scale:g} of {high - low:g}: take a larger one, or a shorter range."
            )
        object.__setattr__(self, "between", (low, high))
        object.__setattr__(self, "lengthscale", scale)

    def __repr__(self) -> str:
        # The code that makes it, without defaults.
        options = [(f.name, getattr(self, f.name), f.default) for f in fields(self)[1:]]
        texts = [f"{name}={value!r}" for name, value, default in options if value != default]
        return f"Unknown({', '.join([repr(self.guess), *texts])})"

    @property
    def prior_text(self) -> str:
        """The prior, for tables."""
        low, high = self.bounds
        limits = f"{low:g} to {high:g}"
        if high == math.inf:
            limits = f"above {low:g}"
        elif low == -math.inf:
            limits = f"below {high:g}"
        if self.sd is not None:
            text = f"{self.guess:g} ± {self.sd:g}"
        elif self.factor is not None:
            text = f"{self.guess:g}, factor {self.factor:g}"
        else:
            return limits
        if self.bounds == _UNBOUNDED:
            return text
        return f"{text}, {limits}"

    def value(self, z: Tensor) -> Tensor:
        """Return the value at a coordinate, which is standard normal by the prior."""
        low, high = self.bounds
        below, above = self._tails
        if self.is_cut:
            # The prior between the bounds: its quantile at the probability of z.
            z = ndtri(below + (above - below) * ndtr(z.clamp(-LARGEST, LARGEST)))
        value: Tensor = self.quantile(z, torch.exp, lambda z: ndtr(z.clamp(-LARGEST, LARGEST)))
        return value.clamp(low, high)  # beyond there are rounding errors

    def quantile(self, z: Any, exp: Callable[[Any], Any], cdf: Callable[[Any], Any]) -> Any:
        """Return the value at a coordinate of any kind of number, by the prior without a cut."""
        if self.sd is not None:
            return self.guess + self.sd * z  # N(guess, sd^2)
        if self.factor is not None:
            return self.guess * exp(math.log(self.factor) * z)  # guess factor^z
        low, high = self.bounds
        return low + (high - low) * cdf(z)  # uniform between the bounds

    @property
    def is_cut(self) -> bool:
        """Whether the bounds cut off the normal or log-normal prior."""
        return self._tails != (0.0, 1.0)

    def coordinate(self, value: Tensor) -> Tensor:
        """Return the coordinate at which :meth:`value` is this one."""
        below, above = self._tails
        z = self._without_bounds(value)
        if self.is_cut:
            z = ndtri((ndtr(z) - below) / (above - below))
        return z

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

    # Of a function

    @cached_property
    def knots(self) -> Tensor:
        """Points at which the values of a function are learnt, ``k``; none of a number."""
        if self.between is None or self.lengthscale is None:
            return torch.empty(0, dtype=torch.float64)
        low, high = self.between
        # Rounding would add a knot to a range of whole lengthscales.
        number = 1 + math.ceil(_KNOTS * (high - low) / self.lengthscale - 1e-9)
        return torch.linspace(low, high, number, dtype=torch.float64)

    @cached_property
    def root(self) -> Tensor:
        """L of :math:`L L^T = k(Z, Z)`, the correlation of coordinates at the knots, ``k x k``."""
        eye = torch.eye(len(self.knots)).to(self.knots)
        return torch.linalg.cholesky(self._correlation(self.knots) + _NUGGET * eye)

    @cached_property
    def precision(self) -> Tensor:
        """The inverse of :math:`k(Z, Z)`, ``k x k``."""
        return torch.cholesky_inverse(self.root)

    def weights(self, x: Tensor) -> Tensor:
        """Return :math:`k(x, Z) k(Z, Z)^{-1}`, weights of the coordinates at knots Z, at ``x``."""
        low, high = self.between or (0.0, 0.0)
        return self._correlation(x.clamp(low, high)) @ self.precision.to(x)

    def _correlation(self, x: Tensor) -> Tensor:
        """Return the correlation of coordinates at ``x`` and at the knots, ``... x k``."""
        # k(x, x') = (1 + r + r^2 / 3) exp(-r), r = sqrt(5) |x - x'| / lengthscale
        r = math.sqrt(5) * (x.unsqueeze(-1) - self.knots.to(x)).abs() / (self.lengthscale or 1.0)
        return (1 + r + r.square() / 3) * (-r).exp()


@dataclass(frozen=True, repr=False)
class Knot(Unknown):
    """The value of an unknown function, by its name, at one of its knots: a number of a table."""

    function: str = ""
    at: float = 0.0


class Curve:
    """An unknown function by its prior and its values at the knots, ``... x k``."""

    def __init__(self, unknown: Unknown, values: Any) -> None:
        self.unknown, self.values = unknown, values

    def __call__(self, x: Any) -> Any:
        """Return the function at ``x``, whose shape broadcasts with that of the rows of values."""
        values = torch.as_tensor(self.values)
        points = torch.as_tensor(x).to(values)
        # value(k(x, Z) k(Z, Z)^-1 z), z the coordinates of the values
        z = self.unknown.coordinate(values).clamp(-_AT_BOUND, _AT_BOUND)
        curve = self.unknown.value((self.unknown.weights(points) * z).sum(-1))
        return curve if isinstance(self.values, Tensor) else curve.numpy()


class Unknowns(dict[str, Unknown]):
    """The ``p`` unknown parameters of a physics, by name; of a function a :class:`Knot` each."""

    def __init__(self, unknowns: Mapping[str, Unknown]) -> None:
        is_mapping = isinstance(unknowns, Mapping)
        if not is_mapping or not all(isinstance(u, Unknown) for u in unknowns.values()):
            raise TypeError(
                f"unknowns must map names to Unknown(guess, sd=...); found {unknowns!r}."
            )
        super().__init__()
        for name, unknown in unknowns.items():
            if isinstance(unknown, Knot):
                self[name] = unknown
                continue
            # "link1.mass" of a simulator is an item, "mass" an attribute, too.
            is_path = isinstance(name, str) and ("." in name.strip(".") or "[" in name)
            is_word = isinstance(name, str) and name.isidentifier() and not iskeyword(name)
            is_attribute = is_word and not name.startswith("_") and name != "rows"
            if not is_path and (not is_attribute or hasattr(dict, name)):
                raise ValueError(
                    "Expected a name that can be an attribute, or one with a point or bracket, "
                    f"such as 'link1.mass' or 'wall[1].G', found {name!r}."
                )
            if not unknown.function_of:
                self[name] = unknown
            knots = unknown.knots.tolist()
            for knot, text in zip(knots, _different(knots), strict=True):
                self[f"{name}({text})"] = Knot(**asdict(unknown), function=name, at=knot)

    @classmethod
    def together(cls, several: Iterable[Unknowns]) -> Unknowns:
        """Return the parameters of several physics, one for each name, or raise a ValueError."""
        union: dict[str, Unknown] = {}
        for unknowns in several:
            for name, unknown in unknowns.items():
                if union.setdefault(name, unknown) != unknown:
                    raise ValueError(
                        f"Expected one prior of the parameter {name!r} in all physics; found "
                        f"{union[name]!r} and {unknown!r}. Rename one of them."
                    )
        return cls(union)

    @cached_property
    def functions(self) -> dict[str, tuple[Unknown, list[int]]]:
        """The functions: their priors, and the columns of their values."""
        functions: dict[str, tuple[Unknown, list[int]]] = {}
        for i, knot in enumerate(self.values()):
            if isinstance(knot, Knot):
                functions.setdefault(knot.function, (knot, []))[1].append(i)
        return functions

    def refuse_functions(self) -> None:
        """Raise a ValueError if one of them is a function."""
        if self.functions:
            raise ValueError(
                f"The unknown {min(self.functions)!r} is a function. A parameter here is a number; "
                "functions are for FormulaPhysics, ODEPhysics and Python functions. Leave out "
                "function_of and between."
            )

    @property
    def declared(self) -> dict[str, Unknown]:
        """The parameters as the user named them, a function as one."""
        declared = {}
        for name, unknown in self.items():
            if isinstance(unknown, Knot):
                settings = {f.name: getattr(unknown, f.name) for f in fields(Unknown)}
                declared[unknown.function] = Unknown(**settings)
            else:
                declared[name] = unknown
        return declared

    @property
    def guess(self) -> Tensor:
        """The guesses, ``p``."""
        return torch.tensor([u.guess for u in self.values()], dtype=torch.float64)

    def to_values(self, coordinates: Tensor) -> Tensor:
        """Return values ``... x p`` at coordinates ``... x p``, standard normal by the prior."""
        for unknown, columns in self.functions.values():
            coordinates = coordinates.clone()
            # L z, whose covariance is k(Z, Z)
            coordinates[..., columns] = coordinates[..., columns] @ unknown.root.mT.to(coordinates)
        pairs = zip(self.values(), coordinates.unbind(-1), strict=True)
        return torch.stack([u.value(z) for u, z in pairs], dim=-1)

    def to_coordinates(self, values: Tensor) -> Tensor:
        """Return the coordinates ``... x p`` of values ``... x p``."""
        pairs = zip(self.values(), values.unbind(-1), strict=True)
        z = torch.stack([u.coordinate(value) for u, value in pairs], dim=-1)
        for unknown, columns in self.functions.values():
            root = unknown.root.to(z)
            # L^-1 z
            z[..., columns] = torch.linalg.solve_triangular(
                root, z[..., columns].unsqueeze(-1), upper=False
            ).squeeze(-1)
        return z


NO_UNKNOWNS = Unknowns({})


def _different(values: list[float]) -> list[str]:
    """Return texts of increasing values, of as few digits as make them different."""
    for digits in range(3, 18):
        texts = [f"{value:.{digits}g}" for value in values]
        if len({*texts}) == len(texts):
            break
    return texts
