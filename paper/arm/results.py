"""The results of the runs that there are, and their summaries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from paper.arm.scenarios import SCENARIOS
from paper.control.results import (
    compared,
    curve,
    first_below,
    in_order,
    iqm,
    load_trials,
    of_run,
    results,
    tabulate_time,
    window,
)

MEASURES = {"all_steps": "all steps", "last_five": "last five steps"}
SHOWN = (3, 6, 9, 12, 18, 24, 30)  # trials
THRESHOLDS = (10, 8)  # cm
RMSES = ("rmse_theta_s", "rmse_theta_e", "rmse_theta_s_dot", "rmse_theta_e_dot")  # rad, rad/s
WINDOWS = ((3, 9), (24, 30))
LAST = 30
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


def spread(evaluations: pd.DataFrame, name: str, measure: str) -> pd.Series[float]:
    """The standard deviation of a measure over the runs of a scenario, by trial."""
    return evaluations[evaluations["scenario"] == name].groupby("trial")[measure].std()


def tabulate(evaluations: pd.DataFrame) -> pd.DataFrame:
    """Summarise the evaluations: a row for each scenario, over all steps and over the last."""
    names = list(evaluations["scenario"].unique())
    rows = []
    for measure, label in MEASURES.items():
        ends = {name: window(evaluations, name, measure, LAST, LAST).to_numpy() for name in names}
        points, intervals = iqm({name: values for name, values in ends.items() if len(values)})
        for name in names:
            by_trial = curve(evaluations, name, measure)
            low, high = intervals.get(name, (np.nan, np.nan))
            hundred = curve(evaluations, name, f"{measure}_100")
            rows.append(
                {
                    "scenario": name,
                    "steps": label,
                    "runs": evaluations[evaluations["scenario"] == name]["seed"].nunique(),
                    **{f"at_{trial}": by_trial.get(trial, np.nan) for trial in SHOWN},
                    "sd": spread(evaluations, name, measure).loc[3:].mean(),
                    "hundred": hundred.get(LAST, np.nan),
                    "iqm": points.get(name, np.nan),
                    "iqm_low": low,
                    "iqm_high": high,
                    **compared(evaluations, name, measure, WINDOWS),
                    **{f"first_{t}": first_below(by_trial, t) for t in THRESHOLDS},
                }
            )
    return pd.DataFrame(rows).astype({f"first_{t}": "Int64" for t in THRESHOLDS})


def tabulate_seconds(trials: pd.DataFrame, evaluations: pd.DataFrame) -> pd.DataFrame:
    """Mean seconds of a run in each part, and how well the model foresaw trials."""
    table = tabulate_time(trials, RMSES).set_index("scenario")
    by_run = evaluations.groupby(["scenario", "seed"], sort=False)["evaluation_seconds"].sum()
    seconds = by_run.groupby("scenario", sort=False).mean()
    table.insert(3, "evaluation_seconds", seconds)
    table["total_seconds"] += seconds
    return table.reset_index()
