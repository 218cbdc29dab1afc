"""A measure over the trials, of several learners with several seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

REFERENCE = "cka"  # which the others are compared with, seed by seed


@dataclass(frozen=True)
class Curves:
    """What claims and tables ask of the runs that there are.

    Args:
        records: A row for each ``scenario``, ``seed`` and ``trial``.
        measure: The column that is looked at.
    """

    records: pd.DataFrame
    measure: str

    @property
    def names(self) -> list[str]:
        """The scenarios that there are, in order."""
        return list(self.records["scenario"].unique())

    def seeds(self, name: str, last: int = 0) -> set[int]:
        """The seeds of a scenario; with a last trial, of the runs that reached it."""
        own = self._of(name)
        return set(own[own["trial"] >= last]["seed"])

    def restricted(self, seeds: set[int]) -> Curves:
        """Those of some seeds only."""
        return replace(self, records=self.records[self.records["seed"].isin(seeds)])

    def mean(self, name: str) -> pd.Series[float]:
        """The mean over the runs, by trial."""
        return self._of(name).groupby("trial")[self.measure].mean()

    def spread(self, name: str) -> pd.Series[float]:
        """The standard deviation over the runs, by trial."""
        return self._of(name).groupby("trial")[self.measure].std()

    def at(self, name: str, trial: int) -> float:
        """The mean over the runs at a trial; nan if none got there."""
        return float(self.mean(name).get(trial, np.nan))

    def first(self, name: str, threshold: float) -> int | None:
        """The first trial at which the mean over the runs is not above a threshold."""
        mean = self.mean(name)
        below = mean.index[mean <= threshold]
        return int(below[0]) if len(below) else None

    def window(self, name: str, first: int, last: int) -> pd.Series[float]:
        """The mean over some trials, by seed."""
        own = self._of(name)
        return own[own["trial"].between(first, last)].groupby("seed")[self.measure].mean()

    def more(
        self, name: str, first: int, last: int, reference: str = REFERENCE
    ) -> tuple[float, float]:
        """How much more a scenario has than another with the same seeds, over some trials.

        Returns:
            Mean and standard error; nan where there are too few shared seeds.
        """
        own, others = (self.window(n, first, last) for n in (name, reference))
        gap = (own - others).dropna()
        return float(gap.mean()), float(gap.sem()) if len(gap) > 1 else np.nan

    def more_columns(self, name: str, windows: Sequence[tuple[int, int]]) -> dict[str, float]:
        """Columns of what :meth:`more` finds, which is nan for the reference itself."""
        columns: dict[str, float] = {}
        for first, last in windows:
            found = (np.nan, np.nan) if name == REFERENCE else self.more(name, first, last)
            columns |= dict(
                zip((f"more_{first}_{last}", f"more_{first}_{last}_se"), found, strict=True)
            )
        return columns

    def _of(self, name: str) -> pd.DataFrame:
        return self.records[self.records["scenario"] == name]
