"""The results of the runs that there are, and their summaries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from paper.arm.scenarios import SCENARIOS, SETTINGS
from paper.control.curves import Curves
from paper.control.results import (
    in_order,
    iqm,
    load_trials,
    of_run,
    results,
    seconds_of_a_run,
    tabulate_time,
)

MEASURES = {"all_steps": "all steps", "last_five": "last five steps"}
SHOWN = (3, 6, 9, 12, 18, 24, 30)  # trials
THRESHOLDS = (10, 8)  # cm
RMSES = ("rmse_theta_s", "rmse_theta_e", "rmse_theta_s_dot", "rmse_theta_e_dot")  # rad, rad/s
WINDOWS = ((3, 9), (24, 30))
LAST_TRIAL = SETTINGS.num_trials
_NAMES = list(SCENARIOS)


def load(out: Path) -> pd.DataFrame:
    """The records of all finished runs: a row for each scenario, seed and trial (from 1)."""
    return load_trials(out, _NAMES, RMSES)


def load_evaluations(out: Path) -> pd.DataFrame:
    """The evaluations of all finished runs: a row for each scenario, seed and trial (from 0).

    Columns ``all_steps`` and ``last_five`` are the hand's root mean square distance over all
    targets in cm, those with ``_100`` over the paper's hundred.
    """
    frames = [of_run(pd.DataFrame(r["evaluations"]), r) for r in results(out, _NAMES)]
    return in_order(frames, _NAMES)


def load_maps(out: Path) -> pd.DataFrame:
    """The errors at each target, in cm: a row for each scenario, seed, mapped trial and target."""
    frames = []
    for result in results(out, _NAMES):
        for trial, errors in result["maps"].items():
            frame = pd.DataFrame({"trial": int(trial), "target": range(121), **errors})
            frames.append(of_run(frame, result))
    if not frames:
        columns = ["scenario", "seed", "trial", "target", *MEASURES]
        return pd.DataFrame(columns=columns)
    return in_order(frames, _NAMES)


def tabulate(evaluations: pd.DataFrame) -> pd.DataFrame:
    """Summarise the evaluations: a row for each scenario, over all steps and over the last."""
    rows = []
    for measure, label in MEASURES.items():
        curves, hundred = Curves(evaluations, measure), Curves(evaluations, f"{measure}_100")
        ends = {n: curves.window(n, LAST_TRIAL, LAST_TRIAL).to_numpy() for n in curves.names}
        points, intervals = iqm({name: values for name, values in ends.items() if len(values)})
        for name in curves.names:
            low, high = intervals.get(name, (np.nan, np.nan))
            rows.append(
                {
                    "scenario": name,
                    "steps": label,
                    "runs": len(curves.seeds(name)),
                    **{f"at_{trial}": curves.at(name, trial) for trial in SHOWN},
                    "sd": curves.spread(name).loc[3:].mean(),
                    "hundred": hundred.at(name, LAST_TRIAL),
                    "iqm": points.get(name, np.nan),
                    "iqm_low": low,
                    "iqm_high": high,
                    **curves.more_columns(name, WINDOWS),
                    **{f"first_{t}": curves.first(name, t) for t in THRESHOLDS},
                }
            )
    return pd.DataFrame(rows).astype({f"first_{t}": "Int64" for t in THRESHOLDS})


def tabulate_seconds(trials: pd.DataFrame, evaluations: pd.DataFrame) -> pd.DataFrame:
    """Median seconds of a run in each part, and how well the model foresaw trials."""
    table = tabulate_time(trials, RMSES).set_index("scenario")
    seconds = seconds_of_a_run(evaluations, ["evaluation"])["evaluation_seconds"]
    table.insert(3, "evaluation_seconds", seconds)
    table["total_seconds"] += seconds
    return table.reset_index()


def tabulate_memory(evaluations: pd.DataFrame) -> pd.DataFrame:
    """What the previous action as an input brings: a row for each learner that has both forms.

    Errors are over all steps, in cm, of the seeds that both forms have; differences are less than
    without it, with their standard errors.
    """
    rows = []
    every = Curves(evaluations, "all_steps")
    for name in SCENARIOS:
        remembering = f"{name}-memory"
        if not {name, remembering} <= set(every.names):
            continue
        curves = every.restricted(every.seeds(name) & every.seeds(remembering))
        row = {"scenario": name, "runs": len(curves.seeds(name))}
        for first, last in WINDOWS:
            row[f"without_{first}_{last}"] = curves.window(name, first, last).mean()
            row[f"with_{first}_{last}"] = curves.window(remembering, first, last).mean()
            gap = curves.more(remembering, first, last, reference=name)
            row[f"more_{first}_{last}"], row[f"more_{first}_{last}_se"] = gap
        rows.append(row)
    return pd.DataFrame(rows)
