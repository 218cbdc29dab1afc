"""What the library set itself in this experiment, each with the number that decides it.

By the mean over runs, over all steps; an ± is a standard error.
"""

from __future__ import annotations

from functools import partial

import pandas as pd

from paper.arm.results import LAST_TRIAL, tabulate_seconds
from paper.arm.scenarios import PAPER, SCENARIOS
from paper.control.claims import Claim, Finding, met, reached, signed
from paper.control.curves import Curves


def _soon(curves: Curves) -> Finding:
    first = curves.first("cka", 8)
    measured = f"{reached(first)}; at 6 {curves.at('cka', 6):.1f} cm"
    return met(first is not None and first <= 6), measured


def _best(curves: Curves) -> Finding:
    ends = {name: curves.at(name, LAST_TRIAL) for name in PAPER}
    best = min((name for name in PAPER if name != "cka"), key=lambda name: ends[name])
    more, error = curves.more(best, LAST_TRIAL, LAST_TRIAL)
    measured = (
        f"{ends['cka']:.1f} cm; the best of the others {ends[best]:.1f} cm "
        f"({SCENARIOS[best].label}), {signed(more, error, 1)} of CKA's"
    )
    return met(more >= -0.5), measured


def _fast(times: pd.DataFrame, curves: Curves) -> Finding:
    row = _seconds(times, "cka")
    parts = ", ".join(
        f"{part} {row[f'{name}_seconds']:.0f}"
        for part, name in (
            ("fits", "fit"),
            ("model steps", "rollout"),
            ("updates", "sac"),
            ("evaluations", "evaluation"),
        )
    )
    return met(row["cpu_seconds"] < 300), f"{row['cpu_seconds']:.0f} s; of wall time, {parts}"


def _black_box(times: pd.DataFrame, curves: Curves) -> Finding:
    seconds = _seconds(times, "cka-opensim")["cpu_seconds"]
    measured = f"{curves.at('cka-opensim', LAST_TRIAL):.1f} cm at {LAST_TRIAL}, {seconds:.0f} s"
    if curves.seeds("cka", LAST_TRIAL):
        equation = curves.at("cka", LAST_TRIAL)
        measured += f"; with the equation of motion and the same seeds {equation:.1f} cm"
    return "met", measured


def targets(trials: pd.DataFrame, evaluations: pd.DataFrame) -> tuple[Claim, ...]:
    """The targets.

    Args:
        trials: The records, see :func:`~paper.arm.results.load`.
        evaluations: The evaluations, see :func:`~paper.arm.results.load_evaluations`.
    """
    times = tabulate_seconds(trials, evaluations).set_index("scenario")
    return (
        Claim(
            "T1", "Dyna-CKA is at or below 8 cm (all steps) at trial 6 or before", ("cka",), _soon
        ),
        Claim("T2", "at trial 30, Dyna-CKA is the best or within 0.5 cm of the best", PAPER, _best),
        Claim(
            "T3",
            "a run of Dyna-CKA with its evaluations takes less than 300 s of a core's time",
            ("cka",),
            partial(_fast, times),
        ),
        Claim(
            "T4",
            "f_p may be a simulator: a run of Dyna-CKA with OpenSim as f_p ends",
            ("cka-opensim",),
            partial(_black_box, times),
            fewest=1,
        ),
    )


def _seconds(times: pd.DataFrame, name: str) -> pd.Series[float]:
    return times.drop(columns=[c for c in times if not c.endswith("_seconds")]).loc[name]
