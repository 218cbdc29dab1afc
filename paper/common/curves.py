"""Goes when no chapter needs it: use ``tables.frame`` and ``verdicts.Curves``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from paper.common.experiment import Run
from paper.common.tables import frame
from paper.common.verdicts import Curves as _Curves


def load_trials(records: Sequence[Run]) -> pd.DataFrame:
    """A row for each trial of the runs of a comparison; a learner is a ``scenario``."""
    return frame(records, "trials").rename(columns={"learner": "scenario"})


@dataclass(frozen=True)
class Curves(_Curves):
    """By scenario."""

    by: str = "scenario"

    @property
    def records(self) -> pd.DataFrame:
        """The rows."""
        return self.runs
