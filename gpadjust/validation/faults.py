"""Faults of a physics that data show: scaled inputs, a wrong sign, offset or unit."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP
from gpadjust.core.data import Data
from gpadjust.validation.trust import physics_at
from gpadjust.words import about, listed, name_among, name_and_unit, number, with_unit

_FEWEST = 5  # observations, for any statement
_MANY = 8  # observations, for the sign or a factor of a twentieth by correlation
_FAR = 3.0  # standard deviations of the observations, beyond which a physics is off
_NEAR = 0.5  # of the observations' root mean square; a physics that is nearer is crude, no more
_WORSE = 1.5  # standard deviations, where the cause is plain
_APART = 12.0  # standard deviations of the observations; a smaller offset is crudeness
_FACTOR = 10.0  # a smaller factor is crudeness
_TINY = 20.0  # times too small: so near to zero that the error is that of no physics
_HUGE = 100.0  # times as large as the observations, whatever its shape
_EXPLAINS = 1 / 3  # of the error is left, where its cause is found
_FITS = 0.6  # standard deviations of the observations that a factor leaves
_LIKE = 0.8  # of the error is left by the opposite, at most
_FOLLOWS = 0.5  # correlation of a physics that has anything to do with the observations
_TIGHT = 0.9  # correlation that shows what the size of the error does not
_SHOWN = 3.0  # standard errors of a correlation
_OF_UNITS = (25.4, 57.3, 60.0, 100.0, 1e3, 1e4, 1e6, 1e9)  # factors of units and angles
_NEARLY = 0.15  # of a factor, in logarithms
_ROUNDING = 1e-9  # relative; less is rounding
_STANDARD = 1e-6  # of means and standard deviations that a scaler made


class Fault(NamedTuple):
    """An obvious fault of a physics."""

    cause: str  # such as "it is about 1,000 times too large"
    text: str  # its cause with the evidence, and the way out


def fault_of(data: Data, output: int, f: Tensor) -> Fault | None:
    """Return the obvious fault of a physics with values ``n`` of an output; None without one."""
    y = data.Y[:, output]
    is_known = ~y.isnan() & f.isfinite()
    X, y, f = (values[is_known] for values in (data.X, y, f))
    if len(y) < _FEWEST:
        return None
    if is_constant(y):
        return None
    fault = _fault(data, output, X, y, f)
    if fault is None:
        return None
    name = data.output_names[output]
    error, spread = (with_unit(number(value), name) for value in (rms(y - f), y.std()))
    hint = ""
    if _is_standardised(y.unsqueeze(-1)):
        hint = " The observations were standardised: give them in the unit of your formula."
    return fault._replace(
        text=f"at the data your formula has a root mean square error of {error}, where the "
        f"observations have a standard deviation of {spread}: {fault.text}{hint}"
    )


def faults(model: GP) -> list[str]:
    """Return the obvious faults of each physics of a fitted model, and of each output."""
    texts = []
    for name, values in physics_at(model, model.data.X).items():
        for j, output in enumerate(model.data.output_names):
            if fault := fault_of(model.data, j, values[:, j]):
                subjects = [name_among(name, model.physics)]
                subjects.append(name_among(output, model.data.output_names))
                texts.append(about(subjects, fault.text))
    return texts


def _fault(data: Data, output: int, X: Tensor, y: Tensor, f: Tensor) -> Fault | None:
    """Return what is wrong with a formula: scaled inputs, or a sign, an offset or a factor."""
    n = len(y)
    sd = float(y.std())
    rmse = rms(f - y)
    r = _correlation(y, f)
    bound = _WORSE if r > _FOLLOWS else 1.0
    if rmse > bound * sd and _is_standardised(X):
        return Fault(
            "it reads scaled inputs",
            "are the inputs scaled? Each column of them has mean 0 and standard deviation 1, and "
            f"the correlation of your formula with the observations is {r:.2f}. It reads raw "
            "units: give the model raw inputs; its input_transform may scale them, and shows your "
            "formula raw ones.",
        )
    if rmse <= _NEAR * rms(y):
        return None
    factor, by_factor = _factor(y, f, r)
    is_off = rmse > _FAR * sd
    # t = r sqrt((n - 2) / (1 - r^2)) beyond three standard errors
    is_opposite = r < -_FOLLOWS and r**2 * (n - 2) > _SHOWN**2 * (1 - r**2)
    is_worse = n >= _MANY and rmse > _WORSE * sd and r < -_TIGHT
    left_by_opposite = 1.0 if is_off else _LIKE
    if is_opposite and (is_off or is_worse) and rms(f + y) < left_by_opposite * rmse:
        cause = "it is of the opposite sign"
        large = f", and {_times(factor)}" if abs(factor) > _FACTOR else ""
        return Fault(cause, f"{cause} (correlation {r:.2f}){large}.")
    is_tiny = n >= _MANY and r > _TIGHT and 0 < factor < 1 / _TINY
    if not is_off and not is_tiny:
        return None
    offset = float((f - y).mean())
    by_offset = rms(f - y - offset)
    if rmse > _APART * sd and by_offset < _EXPLAINS * rmse and by_offset <= by_factor:
        where = "above" if offset > 0 else "below"
        distance = with_unit(number(abs(offset)), data.output_names[output])
        cause = f"it is about {distance} {where} the observations"
        return Fault(cause, f"{cause}.")
    if factor > 0 and not 1 / _FACTOR < factor < _FACTOR:
        cause = f"it is {_times(factor)}"
        return Fault(cause, f"{cause}; {_units(data, output)}")
    return None


def _factor(y: Tensor, f: Tensor, r: float) -> tuple[float, float]:
    """Return how many times too large f is, 0 if that is unclear, and the error without it."""
    sd = float(y.std())
    slope = float(f @ y / (f @ f)) if f.any() else 0.0
    by_factor = rms(y - slope * f)
    affine = sd * max(0.0, 1 - r**2) ** 0.5  # the error of a straight line over f
    if affine < _FITS * sd and by_factor > 1.5 * affine:  # there is an offset, too
        slope = r * sd / float(f.std())
    elif by_factor > _FITS * sd:
        slope = 0.0  # its shape is another one: its size alone may be wrong
        if rms(f) > _HUGE * rms(y):
            slope = rms(y) / rms(f)
        if r < -_FOLLOWS:
            slope = -slope
    return (1 / slope if slope else 0.0), by_factor


def _correlation(y: Tensor, f: Tensor) -> float:
    """Return the correlation; 0 of a constant f."""
    if is_constant(f):
        return 0.0
    return float(torch.corrcoef(torch.stack([y, f]))[0, 1])


def _is_standardised(values: Tensor) -> bool:
    """Return whether a scaler made the columns of ``n x d``; it makes 0 of a constant one."""
    mean = values.mean(0)
    sd = values.std(0, correction=0)
    ones = torch.stack([(sd - 1).abs(), (values.std(0) - 1).abs()]).amin(0) < _STANDARD
    return bool((mean.abs() < _STANDARD).all() & (ones | (sd == 0)).all() & ones.any())


def is_constant(values: Tensor) -> bool:
    """Return whether values are equal but for rounding, as a single one is."""
    varies = float(values.std()) > _ROUNDING * rms(values)  # NaN of a single one is not
    return not varies


def rms(values: Tensor) -> float:
    """Return the root mean square of values."""
    return float(values.square().mean().sqrt())


def _times(factor: float) -> str:
    """Return a text for a factor, too large or too small, by the nearest one of units."""
    size = max(abs(factor), 1 / abs(factor))
    nearest = min(_OF_UNITS, key=lambda unit: abs(math.log(size / unit)))
    if abs(math.log(size / nearest)) >= _NEARLY:
        nearest = float(f"{size:.2g}")
    return f"about {nearest:,g} times too {'large' if abs(factor) >= 1 else 'small'}"


def _units(data: Data, output: int) -> str:
    """Return the question for the units of a formula, with those that names have."""
    units = [" in ".join(name_and_unit(name)) for name in data.input_names if "[" in name]
    name, unit = name_and_unit(data.output_names[output])
    if not units or not unit:
        return "are its units those of the observations?"
    question = f"does it give {name} in {unit}, and read {listed(units)}?"
    if unnamed := [name for name in data.input_names if "[" not in name]:
        units_are = "units are" if len(unnamed) > 1 else "unit is"
        question += f" In which {units_are} {listed(unnamed)}?"
    return question
