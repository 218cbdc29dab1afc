"""Checks of the numbers that options hold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.states import StateSpec

ArrayLike = Tensor | NDArray[Any] | Sequence[Sequence[float]]


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


def checked_action_bounds(bounds: ArrayLike, spec: StateSpec) -> Tensor:
    """Lower and upper bounds of the actions, ``2 x action_dim``, in float64.

    Raises:
        ValueError: If they have another shape, are not finite, or a lower one is not below its
            upper one.
    """
    try:
        found = torch.as_tensor(np.asarray(bounds), dtype=torch.float64)
    except (TypeError, ValueError):
        found = torch.empty(0)
    if found.shape != (2, spec.action_dim) or not found.isfinite().all():
        raise ValueError(
            f"Expected finite action_bounds of shape 2 x {spec.action_dim}, lower ones and then "
            f"upper ones; found {found.tolist() if found.numel() else bounds!r}."
        )
    if not (found[0] < found[1]).all():
        raise ValueError(
            f"Each lower one of action_bounds must be below its upper one; found {found.tolist()}."
        )
    return found
