"""Whether the arguments of environments are what they should be."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.physics.base import whole_number
from gpadjust.states.state_spec import check_columns


def checked_options(options: dict[str, Any] | None, known: Sequence[str]) -> dict[str, Any]:
    """The options of ``reset``.

    Raises:
        TypeError: If they are no dictionary.
        ValueError: If there is an unknown one.
    """
    options = {} if options is None else options
    names = ", ".join(map(repr, known))
    if not isinstance(options, dict):
        raise TypeError(f"options must be a dictionary, which may hold {names}; found {options!r}.")
    for name in options:
        if name not in known:
            raise ValueError(f"Unknown option {name!r}; the known ones: {names}.")
    return options


def finite_numbers(value: Any, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """A copy of finite numbers of a shape; None if the value is something else."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return numbers if numbers.shape == shape and np.isfinite(numbers).all() else None


def check_number(value: Any, name: str) -> None:
    """Raise a TypeError unless a value is a real number."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number; found {value!r}.")


def check_count(n: int) -> None:
    """Raise an error unless a number of states to draw is a whole one, and not negative."""
    if whole_number("n", n) < 0:
        raise ValueError(f"n must not be negative; found {n}.")


def check_least_columns(states: Tensor, least: int, name: str) -> None:
    """Raise an error unless states are a tensor with so many columns, or more."""
    check_columns(states[..., :least] if torch.is_tensor(states) else states, least, name)
