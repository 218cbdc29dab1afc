"""Observations and rewards that cannot be data."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

LARGEST = 1e25
"""The largest number that an environment may observe or reward.

No quantity of a machine is as large in a unit that is used, nor is the square of one, which a
reward may be: pressures stay below 1e12 Pa. There is no least one, as for 1e-9 m.
"""


def fault(observation: ArrayLike, reward: Any = 0.0) -> str:
    """Return what cannot be data in an observation or a reward, in words; empty if all can."""
    for name, values in (("observation", observation), ("reward", reward)):
        numbers = np.asarray(values, dtype=np.float64)
        wrong = ~(np.abs(numbers) <= LARGEST)  # NaN is not, either
        if wrong.any():
            place = np.argwhere(wrong)[0]
            entry = f"entry {', '.join(map(str, place))} of the " if len(place) else "the "
            return (
                f"{entry}{name} is {numbers[tuple(place)]:g}, where a finite number of at most "
                f"{LARGEST:g} is expected (a larger quantity needs another unit)"
            )
    return ""


def check_observation(observation: ArrayLike, what: str = "No action can be chosen") -> None:
    """Raise a ValueError, which begins with ``what``, if an observation cannot be data."""
    if problem := fault(observation):
        raise ValueError(f"{what}: {problem}. Stop the machine, or wait for a good observation.")
