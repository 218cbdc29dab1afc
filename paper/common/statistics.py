"""Differences and means with their intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

FEWEST = 4  # runs that a bootstrap interval is given of
_RESAMPLES = 5000


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences, with what it may be.

    Args:
        mean: The mean.
        error: Its standard error; nan of fewer than two.
        n: Of how many differences it is.
    """

    mean: float
    error: float
    n: int

    @classmethod
    def of(cls, values: ArrayLike) -> Difference:
        """Of some differences; nan are left out."""
        found = np.asarray(values, dtype=float)
        found = found[~np.isnan(found)]
        mean = float(found.mean()) if len(found) else np.nan
        return cls(mean, float(stats.sem(found)) if len(found) > 1 else np.nan, len(found))

    def __truediv__(self, scale: float) -> Difference:
        return Difference(self.mean / scale, self.error / abs(scale), self.n)

    @property
    def half_width(self) -> float:
        """Of the 95 % interval of Student's t, to either side of the mean; nan of fewer than 2."""
        return float(stats.t.ppf(0.975, self.n - 1)) * self.error if self.n > 1 else np.nan

    @property
    def low(self) -> float:
        """The lower end of the 95 % interval."""
        return self.mean - self.half_width

    @property
    def high(self) -> float:
        """The upper end of the 95 % interval."""
        return self.mean + self.half_width

    def text(self, form: str = ".3f") -> str:
        """In words, with the standard error unless it is nan, as it is of a single run."""
        if np.isnan(self.mean):
            return ""
        return f"{self.mean:+{form}}" + ("" if np.isnan(self.error) else f" ± {self.error:{form}}")


def interquartile_mean(values: ArrayLike) -> tuple[float, float, float]:
    """The mean of the middle half of some runs, and its 95 % bootstrap interval.

    Of fewer than ``FEWEST`` runs an interval says nothing, and is nan.
    """
    scores = np.asarray(values, dtype=float)
    if not len(scores):
        return np.nan, np.nan, np.nan
    middle = float(stats.trim_mean(scores, 0.25))
    if len(scores) < FEWEST:
        return middle, np.nan, np.nan
    low, high = bootstrap([scores], lambda x, axis: stats.trim_mean(x, 0.25, axis=axis))
    return middle, low, high


def bootstrap(
    samples: Sequence[ArrayLike], statistic: Callable[..., Any], paired: bool = False
) -> tuple[float, float]:
    """The 95 % percentile interval of a statistic, from a generator of its own."""
    found = stats.bootstrap(
        [np.asarray(sample, dtype=float) for sample in samples],
        statistic,
        paired=paired,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)
