"""What the figures over time share: lines of states, and labels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.states import StateSpec


def going_on(values: Tensor, is_angle: bool) -> Tensor:
    """One state over time, ``n`` with NaN; an angle without jumps, at first within half a turn."""
    values, known = values.clone(), ~values.isnan()
    if is_angle and known.any():
        path = torch.from_numpy(np.unwrap(values[known].numpy()))
        values[known] = path - 2 * math.pi * (path[0] / (2 * math.pi)).round()
    return values


def labels(spec: StateSpec, units: Mapping[str, str] | None) -> dict[str, str]:
    """What axes are called, by the names of states and actions and "time"."""
    names = (*spec.states, *spec.actions, "time")
    units = {"time": "s", **dict.fromkeys(spec.angles, "rad"), **(units or {})}
    check_names("units", units, names)
    return {name: f"{name} in {units[name]}" if units.get(name) else name for name in names}


def check_names(argument: str, names: Any, known: Sequence[str]) -> None:
    """Raise a ValueError unless there are names, all of them known."""
    unknown = [name for name in names if name not in known]
    if unknown or not len(names):
        found = repr(unknown[0]) if unknown else "none"
        raise ValueError(f"Expected {argument} of {', '.join(known)}, found {found}.")
