"""Checks of the numbers that options hold."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any


def check_whole(name: str, value: Any, least: int) -> None:
    """Raise an error unless an option is a whole number of at least ``least``."""
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise TypeError(f"{name} must be a whole number; found {value!r}.")
    if value < least:
        raise ValueError(f"{name} must be at least {least}; found {value}.")


def check_fraction(name: str, value: Any, most: float = 1.0, zero: bool = True) -> None:
    """Raise an error unless an option is a finite number from 0 (or above) up to below ``most``."""
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} must be a number; found {value!r}.")
    number = float(value)
    if not math.isfinite(number) or not 0 <= number < most or (not zero and not number):
        least = "at least 0" if zero else "above 0"
        below = "" if most == math.inf else f" and below {most:g}"
        raise ValueError(f"{name} must be {least}{below}; found {value}.")
