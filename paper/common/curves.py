"""A measure over the episodes, of several learners with several seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from paper.common.experiment import Record
from paper.common.statistics import Difference


def load_trials(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each trial of the runs of a comparison; a learner is a ``scenario``."""
    rows = [
        {
            "system": record["system"],
            "scenario": record["learner"],
            "seed": record["seed"],
            "episode": i + 1,
            **{name: values[i] for name, values in record["trials"].items()},
        }
        for record in records
        for i in range(len(next(iter(record["trials"].values()))))
    ]
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class Curves:
    """What claims and tables ask of the runs that there are.

    Args:
        records: A row for each ``scenario``, ``seed`` and ``episode``.
        measure: The column that is looked at.
        reference: The scenario that others are compared with, seed by seed.
    """

    records: pd.DataFrame
    measure: str
    reference: str = "cka"

    @property
    def names(self) -> list[str]:
        """The scenarios that there are, in order."""
        return list(self.records["scenario"].unique())

    def seeds(self, name: str, last: int = 0) -> set[int]:
        """The seeds of a scenario; with a last episode, of the runs that reached it."""
        own = self._of(name)
        return set(own[own["episode"] >= last]["seed"])

    def restricted(self, seeds: set[int]) -> Curves:
        """Those of some seeds only."""
        return replace(self, records=self.records[self.records["seed"].isin(seeds)])

    def mean(self, name: str) -> pd.Series[float]:
        """The mean over the runs, by episode."""
        return self._of(name).groupby("episode")[self.measure].mean()

    def spread(self, name: str) -> pd.Series[float]:
        """The standard deviation over the runs, by episode."""
        return self._of(name).groupby("episode")[self.measure].std()

    def mean_at(self, name: str, episode: int) -> float:
        """The mean over the runs at an episode; nan if none got there."""
        return float(self.mean(name).get(episode, np.nan))

    def first_below(self, name: str, threshold: float) -> int | None:
        """The first episode at which the mean over the runs is not above a threshold."""
        mean = self.mean(name)
        below = mean.index[mean <= threshold]
        return int(below[0]) if len(below) else None

    def window(self, name: str, first: int, last: int) -> pd.Series[float]:
        """The mean over some episodes, by seed."""
        own = self._of(name)
        return own[own["episode"].between(first, last)].groupby("seed")[self.measure].mean()

    def paired_difference(
        self, name: str, first: int, last: int, reference: str | None = None
    ) -> Difference:
        """How much more a scenario has than another with the same seeds, over some episodes.

        It is nan for the reference itself, and where no seed is shared.
        """
        other = self.reference if reference is None else reference
        if name == other:
            return Difference.of([])
        return Difference.of(self.window(name, first, last) - self.window(other, first, last))

    def _of(self, name: str) -> pd.DataFrame:
        return self.records[self.records["scenario"] == name]
