"""Verdicts, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from paper.common.curves import Curves
from paper.common.statistics import Difference

Verdict = Literal[
    "reproduced",
    "not reproduced",
    "beaten",
    "inconclusive",
    "undetermined",
    "met",
    "missed",
    "not run",
]
Finding = tuple[Verdict, str]
FEWEST = 2  # runs that a verdict is given of


@dataclass(frozen=True)
class Judged:
    """A claim, its verdict, and the numbers behind it."""

    id: str
    claim: str
    verdict: Verdict
    measured: str


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, or a target of our own, about curves.

    Args:
        id: The paper's, or ours.
        text: What it says.
        needed: The scenarios that it is about.
        decide: Gives verdict and numbers, from curves of the seeds with which all of ``needed``
            were run to their end; other scenarios may lack some of these.
        fewest: Runs without which there is no verdict.
    """

    id: str
    text: str
    needed: tuple[str, ...]
    decide: Callable[[Curves], Finding]
    fewest: int = FEWEST


def judge(claims: Sequence[Claim], curves: Curves, last: int) -> list[Judged]:
    """All claims, each by the seeds that all its scenarios have; one that lacks them is not judged.

    Args:
        claims: What is judged.
        curves: Of all runs.
        last: The episode that a run must have reached.
    """
    found = []
    for claim in claims:
        shared = set.intersection(*(curves.seeds(name, last) for name in claim.needed))
        if len(shared) < claim.fewest:
            runs = {name: len(curves.seeds(name, last)) for name in claim.needed}
            least = min(runs, key=lambda name: runs[name])
            lacking = f"no results of {least}" if not runs[least] else f"too few runs of {least}"
            found.append(Judged(claim.id, claim.text, "not run", lacking))
            continue
        verdict, measured = claim.decide(curves.restricted(shared))
        measured = f"{counted(len(shared))}: {measured}"
        found.append(Judged(claim.id, claim.text, verdict, measured))
    return found


def reproduced(held: bool, beaten: bool = False) -> Verdict:
    """The verdict on a claim of the paper."""
    if not held:
        return "not reproduced"
    return "beaten" if beaten else "reproduced"


def within(difference: Difference, low: float = -np.inf, high: float = np.inf) -> Verdict:
    """Whether a difference is between two bounds.

    Inconclusive if a bound is in its 95 % interval; of one run, or of runs that are all alike, what
    it is decides.
    """
    half = np.nan_to_num(difference.half_width)
    least, most = difference.mean - half, difference.mean + half
    if low <= least and most <= high:
        return "reproduced"
    return "not reproduced" if most < low or high < least else "inconclusive"


def all_of(*verdicts: Verdict) -> Verdict:
    """The verdict on a claim of several parts: the worst of theirs."""
    order: tuple[Verdict, ...] = (
        "not reproduced",
        "inconclusive",
        "undetermined",
        "reproduced",
        "beaten",
    )
    return min(verdicts, key=order.index)


def met(held: bool) -> Verdict:
    """The verdict on a target of our own."""
    return "met" if held else "missed"


def counted(runs: int) -> str:
    """A number of runs, in words."""
    return f"{runs} run{'' if runs == 1 else 's'}"


def reached(episode: int | None) -> str:
    """When a threshold was reached, in words."""
    return "never" if episode is None else f"at trial {episode}"
