"""Checks of the settings of a physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import index
from typing import SupportsIndex


def column_numbers(inputs: Sequence[int]) -> tuple[int, ...]:
    """The setting ``inputs`` as a tuple.

    Raises:
        TypeError: If it holds something else than whole numbers.
        ValueError: If it is empty.
    """
    try:
        columns = tuple(index(i) for i in inputs)
    except TypeError:
        raise TypeError(
            f"inputs must be a sequence of column numbers, such as [0, 2]; found {inputs!r}."
        ) from None
    if not columns:
        raise ValueError("inputs is empty; name at least one column of X, or None for all.")
    return columns


def whole_number(name: str, value: SupportsIndex) -> int:
    """A setting as an int.

    Raises:
        TypeError: If it is no whole number.

    Example:
        >>> whole_number("memo", 1.5)
        Traceback (most recent call last):
        TypeError: memo must be a whole number; found 1.5.
    """
    try:
        return index(value)
    except TypeError:
        raise TypeError(f"{name} must be a whole number; found {value!r}.") from None


def is_finite(name: str, value: float) -> bool:
    """Whether a setting is finite.

    Raises:
        TypeError: If it is no number.

    Example:
        >>> is_finite("step", float("inf"))
        False
    """
    try:
        return math.isfinite(value)
    except TypeError:
        raise TypeError(f"{name} must be a number; found {value!r}.") from None
