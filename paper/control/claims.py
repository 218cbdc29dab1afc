"""Verdicts, and the numbers behind them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Literal

import pandas as pd

Verdict = Literal["reproduced", "not reproduced", "beaten", "met", "missed", "not run"]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper or a target of our own, its verdict, and the number behind it."""

    id: str
    claim: str
    verdict: Verdict
    measured: str


def judged(
    claims: Mapping[str, tuple[str, tuple[str, ...]]],
    finished: Collection[str],
    decide: Callable[[str], tuple[Verdict, str]],
) -> list[Claim]:
    """All claims; one that needs what was not run to its end is not judged.

    Args:
        claims: By their ids, what they say and the scenarios that they need.
        finished: The scenarios that were run to their end.
        decide: Verdict and number of the claim of an id.
    """
    found = []
    for name, (text, needed) in claims.items():
        missing = [scenario for scenario in needed if scenario not in finished]
        if missing:
            found.append(Claim(name, text, "not run", f"no results of {missing[0]}"))
        else:
            found.append(Claim(name, text, *decide(name)))
    return found


def num_runs(trials: pd.DataFrame, name: str) -> str:
    """How many runs of a scenario there are, in words."""
    runs = trials[trials["scenario"] == name]["seed"].nunique()
    return f"{runs} run{'' if runs == 1 else 's'}"


def signed(value: float, error: float, digits: int = 3) -> str:
    """A difference, with its standard error unless that is nan, as it is of a single run."""
    if math.isnan(error):
        return f"{value:+.{digits}f}"
    return f"{value:+.{digits}f} ± {error:.{digits}f}"
