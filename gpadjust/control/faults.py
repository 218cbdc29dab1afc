"""Observations and rewards that cannot be data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_LARGEST = 1e25  # no quantity of a machine, nor its square, is as large in a unit that is used


def fault(observation: ArrayLike, reward: Any = 0.0, names: Sequence[str] = ()) -> str:
    """Return what cannot be data in an observation or a reward, in words; empty if all can.

    ``names`` are those of the observation's entries, if they are known.
    """
    for name, values in (("observation", observation), ("reward", reward)):
        numbers = np.asarray(values, dtype=np.float64)
        for place in np.argwhere(~(np.abs(numbers) <= _LARGEST)):  # NaN is not, either
            entry = f"entry {', '.join(map(str, place))} of the " if len(place) else "the "
            if len(place) == 1 and place[0] < len(names):
                entry = f"{names[place[0]]!r}, {entry}"
            return (
                f"{entry}{name} is {numbers[tuple(place)]:g}, where a finite number of at most "
                f"{_LARGEST:g} is expected (a larger quantity needs another unit)"
            )
    return ""


def check_observation(
    observation: ArrayLike, problem: str = "No action can be chosen", names: Sequence[str] = ()
) -> None:
    """Raise a ValueError, which begins with a problem, if an observation cannot be data."""
    if found := fault(observation, names=names):
        raise ValueError(f"{problem}: {found}. Stop the machine, or wait for a good observation.")
