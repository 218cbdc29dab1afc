"""Verdicts on claims, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats
from torch import Tensor

Verdict = Literal[
    "not reproduced", "inconclusive", "undetermined", "reproduced", "beaten", "not run"
]
_FROM_WORST: tuple[Verdict, ...] = (
    *("not reproduced", "inconclusive", "undetermined", "reproduced", "beaten"),
)
FEWEST = 4  # runs of which a verdict is given
Finding = tuple[Verdict, str]


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences, with what it may be."""

    mean: float  # the mean
    error: float  # its standard error; nan of fewer than two, or of infinite ones
    n: int  # of how many differences it is

    @classmethod
    def of(cls, values: ArrayLike) -> Difference:
        """Return the mean of differences with its error; nan are left out."""
        found = np.asarray(values, dtype=float)
        found = found[~np.isnan(found)]
        mean = float(found.mean()) if len(found) else np.nan
        has_error = len(found) > 1 and np.isfinite(found).all()
        return cls(mean, float(stats.sem(found)) if has_error else np.nan, len(found))

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
        """Return the difference in words, without its standard error if that is nan."""
        if np.isnan(self.mean):
            return ""
        return f"{self.mean:+{form}}" + ("" if np.isnan(self.error) else f" ± {self.error:{form}}")

    def interval(self, form: str) -> str:
        """Return the mean and its 95 % interval."""
        return f"{self.mean:{form}} [{self.low:{form}}, {self.high:{form}}]"

    def ratio(self, form: str = ".2f") -> str:
        """Return, for differences of logarithms, the geometric mean ratio and its 95 % interval."""
        if np.isnan(self.mean):
            return ""
        middle, low, high = np.exp([self.mean, self.low, self.high])
        return f"{middle:{form}}" + ("" if np.isnan(low) else f" [{low:{form}}, {high:{form}}]")


def paired(
    runs: pd.DataFrame,
    value: str,
    by: str,
    name: Any,
    reference: Any,
    on: Sequence[str] = ("seed",),
    *,
    ratio: bool = False,
) -> Difference:
    """Return how much more a value is for one entry of the column ``by`` than for another.

    Runs of a pair share the columns ``on``; of ratios logarithms are compared. It is nan if there
    is no pair.
    """
    wide = runs.pivot_table(index=[*on], columns=by, values=value)
    if not {name, reference} <= {*wide}:
        return Difference.of([])
    wide = np.log(wide) if ratio else wide
    return Difference.of(wide[name] - wide[reference])


def scores_of(mean: Tensor, low: Tensor, high: Tensor, measured: Tensor) -> dict[str, Any]:
    """Return error, coverage and half width of intervals of a path of ``n``."""
    inside = (low <= measured) & (measured <= high)
    return {
        "rmse": float((mean - measured).square().mean().sqrt()),
        "coverage": float(inside.double().mean()),
        "half_width": float((high - low).mean() / 2),
    }


@dataclass(frozen=True)
class Curves:
    """A measure over the episodes, of several learners with several seeds."""

    # A row for each learner, `seed` and `episode`, as `tables.frame` makes.
    runs: pd.DataFrame
    measure: str  # the column that is looked at

    @property
    def names(self) -> list[str]:
        """The learners that there are, in order."""
        return list(self.runs["learner"].unique())

    def of(self, name: str) -> pd.DataFrame:
        """Return the rows of a learner."""
        return self.runs[self.runs["learner"] == name]

    def seeds(self, name: str, last: int = 0) -> set[int]:
        """Return the seeds of a learner; with a last episode, of the runs that reached it."""
        own = self.of(name)
        return set(own[own["episode"] >= last]["seed"])

    def restricted(self, seeds: set[int]) -> Curves:
        """Return the curves of some seeds."""
        return replace(self, runs=self.runs[self.runs["seed"].isin(seeds)])

    def mean(self, name: str) -> pd.Series[float]:
        """Return the mean over the runs, by episode."""
        return self.of(name).groupby("episode")[self.measure].mean()

    def spread(self, name: str) -> pd.Series[float]:
        """Return the standard deviation over the runs, by episode."""
        return self.of(name).groupby("episode")[self.measure].std()

    def mean_at(self, name: str, episode: int) -> float:
        """Return the mean over the runs at an episode; nan if none got there."""
        return float(self.mean(name).get(episode, np.nan))

    def first_below(self, name: str, threshold: float) -> int | None:
        """Return the first episode at which the mean over the runs is not above a threshold."""
        mean = self.mean(name)
        below = mean.index[mean <= threshold]
        return int(below[0]) if len(below) else None

    def window(self, name: str, first: int, last: int) -> pd.Series[float]:
        """Return the mean over some episodes, by seed."""
        own = self.of(name)
        return own[own["episode"].between(first, last)].groupby("seed")[self.measure].mean()

    def least(self, name: str, last: int) -> Difference:
        """Return the measure at the best episode up to a last one, by the mean over the runs."""
        best = int(self.mean(name).loc[:last].idxmin())
        return Difference.of(self.window(name, best, best))

    def paired_difference(
        self, name: str, first: int, last: int, reference: str = "cka"
    ) -> Difference:
        """Return how much more a learner has than another with the same seeds, over some episodes.

        It is nan for the reference itself, and where no seed is shared.
        """
        if name == reference:
            return Difference.of([])
        return Difference.of(self.window(name, first, last) - self.window(reference, first, last))

    def described(self, name: str, levels: Sequence[float], unit: str = "") -> str:
        """Return when the mean first was at some levels, in words."""
        return ", ".join(f"{x}{unit} {reached(self.first_below(name, x))}" for x in levels)


class Judged(NamedTuple):
    """A claim, its verdict, and the numbers behind it."""

    id: str
    claim: str
    verdict: Verdict
    measured: str


class Claim(NamedTuple):
    """A claim of the paper about curves."""

    id: str  # ours, in the order of the paper
    text: str  # what it says
    needed: tuple[str, ...]  # the learners that it is about
    # Gives verdict and numbers, from curves of the seeds with which all of `needed` were run to
    # their end; other learners may lack some of these.
    decide: Callable[[Curves], Finding]


def judge(claims: Sequence[Claim], curves: Curves, last: int) -> list[Judged]:
    """Judge all claims, each by the seeds with which all its learners reached the last episode.

    One of fewer than two such seeds is not judged, one of fewer than ``FEWEST`` is inconclusive.
    """
    found = []
    for claim in claims:
        runs = {name: curves.seeds(name, last) for name in claim.needed}
        shared = set.intersection(*runs.values())
        if len(shared) < 2:
            least = min(runs, key=lambda name: len(runs[name]))
            lacking = f"no results of {least}" if not runs[least] else f"too few runs of {least}"
            found.append(Judged(claim.id, claim.text, "not run", lacking))
            continue
        verdict, measured = claim.decide(curves.restricted(shared))
        verdict = verdict if len(shared) >= FEWEST else "inconclusive"
        measured = f"{counted(len(shared))}: {measured}"
        found.append(Judged(claim.id, claim.text, verdict, measured))
    return found


def reproduced(held: bool) -> Verdict:
    """Return the verdict on a claim of the paper."""
    return "reproduced" if held else "not reproduced"


def between(ends: Sequence[float], low: float = -np.inf, high: float = np.inf) -> Verdict:
    """Judge whether an interval lies between two bounds; inconclusive if a bound lies in it."""
    least, most = ends
    if low <= least and most <= high:
        return "reproduced"
    return "not reproduced" if most < low or high < least else "inconclusive"


def within(difference: Difference, low: float = -np.inf, high: float = np.inf) -> Verdict:
    """Judge whether a difference is between two bounds, by its 95 % interval.

    Of one run, or of runs that are all alike, what it is decides.
    """
    half = np.nan_to_num(difference.half_width)
    return between((difference.mean - half, difference.mean + half), low, high)


def all_of(*verdicts: Verdict) -> Verdict:
    """Return the verdict on a claim of several parts: the worst of theirs."""
    return min(verdicts, key=_FROM_WORST.index)


def counted(runs: int) -> str:
    """Return a number of runs, in words."""
    return f"{runs} run{'' if runs == 1 else 's'}"


def reached(episode: int | None) -> str:
    """Return when a threshold was reached, in words."""
    return "never" if episode is None else f"at trial {episode}"
