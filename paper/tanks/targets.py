"""What was aimed at, and what was found."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.claims import Judged, counted, met
from paper.tanks import CANDIDATES, TENTH

PUBLISHED = {
    "linear": 0.588,
    "polynomial NARX": 0.413,
    "GRU": 0.396,
    "CT-SUBNET": 0.306,
    "grey box (Worden 2018)": 0.191,
}
"""Errors in V of free runs along the validation record."""


def verdicts(runs: pd.DataFrame, chosen: str) -> list[Judged]:
    """The verdict on each target.

    Args:
        runs: A row for each run.
        chosen: The candidate that cross-validation chose.
    """
    all_chosen = (
        "free run of the validation record, by the fit that the estimation record chooses, of "
        "structures from a search that had looked at both"
    )
    return [
        _judged("T1", f"{all_chosen}: at most 0.28 V", runs, chosen, 0.28),
        _judged("T2", "the same: at most 0.19 V", runs, chosen, 0.19),
        _judged("T3", "parameters from 100 samples: at most 0.25 V", runs, TENTH, 0.25),
    ]


def _judged(name: str, claim: str, runs: pd.DataFrame, learner: str, most: float) -> Judged:
    own: Sequence[float] = runs.loc[runs["learner"] == learner, "rmse"].tolist()
    if not own:
        return Judged(name, claim, "not run", f"no results of {learner}")
    mean = sum(own) / len(own)
    text = f"{learner} {mean:.3f}"
    if not runs.loc[runs["learner"] == learner, "settled"].fillna(True).all():
        text += ", a fit that had not settled"
    if learner not in CANDIDATES:
        held = sum(error <= most for error in own)
        text += f" in the mean of {counted(len(own))}, {held} of which are at most that"
    return Judged(name, claim, met(mean <= most), text)
