"""The results of the runs that there are, and their summaries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from paper.cartpole.results import RMSES
from paper.control.curves import Curves
from paper.control.results import load_trials, seconds_of_a_run
from paper.exploration.scenarios import REFERENCE, SCENARIOS, model_of

MEASURES = {
    "error": "error on swing-ups",
    "error_random": "error on random trials",
    "evaluation": "cost of the deterministic policy",
}
SHOWN = (1, 2, 4, 6, 10, 15)  # trials
WINDOWS = ((2, 6), (7, 15))  # over which the learners are compared
_PARTS = ("plan", "fit", "rollout", "sac", "cpu")


def load(out: Path) -> pd.DataFrame:
    """The records of all finished runs: a row for each scenario, seed and trial (from 1)."""
    trials = load_trials(out, list(SCENARIOS), RMSES)
    plan = trials["plan_seconds"] if "plan_seconds" in trials else pd.Series(0.0, trials.index)
    return trials.assign(plan_seconds=plan.fillna(0.0))


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Means over the runs: a row for each measure and scenario, in the order of these.

    Columns ``less_<first>_<last>`` have the mean difference to the trials of SAC with the same
    model and seeds, ``..._se`` its standard error; nan for these themselves.
    """
    rows = []
    for measure in MEASURES:
        curves = Curves(trials, measure)
        for name in curves.names:
            reference = f"{model_of(name)}-{REFERENCE}"
            row = {"measure": measure, "scenario": name, "runs": len(curves.seeds(name))}
            row |= {f"at_{trial}": curves.at(name, trial) for trial in SHOWN}
            for first, last in WINDOWS:
                found = (np.nan, np.nan)
                if name != reference and reference in curves.names:
                    found = curves.more(name, first, last, reference)
                column = f"less_{first}_{last}"
                row |= dict(zip((column, f"{column}_se"), found, strict=True))
            rows.append(row)
    return pd.DataFrame(rows)


def tabulate_seconds(trials: pd.DataFrame) -> pd.DataFrame:
    """Median seconds of a run in plans, fits, model steps and updates; ``cpu`` of one core's."""
    return seconds_of_a_run(trials, _PARTS).reset_index()
