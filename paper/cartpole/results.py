"""The results of the runs that there are, and their summaries."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
from rliable import metrics
from rliable.library import get_interval_estimates

from paper.cartpole.scenarios import SCENARIOS, SETTINGS

MEASURES = {"cost": "sampled", "evaluation": "deterministic"}
WINDOWS = ((1, 6), (13, 25), (41, 50))
THRESHOLDS = (0.5, 0.4)
PARTS = ("fit", "rollout", "sac")
RMSES = ("rmse_x", "rmse_theta", "rmse_x_dot", "rmse_theta_dot")  # m, rad, m/s, rad/s
REFERENCE = "cka"  # which the others are compared with, seed by seed
FEWEST = 4  # runs that a bootstrap interval is given of
_COMPARED = ((1, 25), (41, 50))
_SMOOTHED = 3
_BOOTSTRAPS = 1000


def load(out: Path) -> pd.DataFrame:
    """The records of all finished runs: a row for each scenario, seed and trial (from 1).

    The model's errors stand in a column for each state, ``RMSES``.
    """
    frames = []
    for path in (out / "runs").glob("*.json"):
        result = json.loads(path.read_text())
        if result["scenario"] not in SCENARIOS:
            continue
        frame = pd.DataFrame(result["trials"])
        frame.insert(0, "scenario", result["scenario"])
        frame.insert(1, "seed", result["seed"])
        frame.insert(2, "trial", np.arange(len(frame)) + 1)
        errors = [found or [np.nan] * len(RMSES) for found in frame.pop("rmse")]
        frame[list(RMSES)] = np.array(errors, dtype=float)
        frames.append(frame)
    if not frames:
        raise FileNotFoundError(f"There are no results in {out / 'runs'}.")
    rank = list(SCENARIOS).index
    return (
        pd.concat([frame.astype({"nlpd": float, "coverage": float}) for frame in frames])
        .sort_values(
            ["scenario", "seed", "trial"], key=lambda c: c.map(rank) if c.name == "scenario" else c
        )
        .reset_index(drop=True)
    )


def curve(trials: pd.DataFrame, name: str, measure: str) -> pd.Series[float]:
    """The mean of a measure over the runs of a scenario, by trial."""
    return trials[trials["scenario"] == name].groupby("trial")[measure].mean()


def window(
    trials: pd.DataFrame, name: str, measure: str, first: int, last: int
) -> pd.Series[float]:
    """The mean of a measure over some trials of a scenario, by seed."""
    chosen = trials[(trials["scenario"] == name) & trials["trial"].between(first, last)]
    return chosen.groupby("seed")[measure].mean()


def first_below(curve: pd.Series[float], threshold: float) -> int | None:
    """The first trial at which a curve is not above a threshold."""
    below = curve.index[curve <= threshold]
    return int(below[0]) if len(below) else None


def holds_from(curve: pd.Series[float], threshold: float, until: int) -> int | None:
    """The first trial from which a curve's moving average stays at or below a threshold.

    Of a trial and the two before it, so that one lucky trial does not count.

    Args:
        curve: A measure by trial.
        threshold: What it is not to exceed.
        until: The last trial that is looked at.

    Returns:
        The trial; None if there is none, or the curve ends before ``until``.
    """
    if until not in curve.index:
        return None
    above = curve.rolling(_SMOOTHED).mean().loc[_SMOOTHED:until] > threshold
    first = int(above.index[above].max()) + 1 if above.any() else _SMOOTHED
    return first if first <= until else None


def behind(
    trials: pd.DataFrame, name: str, measure: str, first: int, last: int
) -> tuple[float, float]:
    """How much more a scenario costs than Dyna-CKA with the same seeds: mean, standard error."""
    own, others = (window(trials, n, measure, first, last) for n in (name, REFERENCE))
    more = (own - others).dropna()
    return float(more.mean()), float(more.sem()) if len(more) > 1 else np.nan


def iqm(scores: dict[str, np.ndarray]) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Interquartile means of runs, with the 95 % bootstrap intervals of rliable.

    Of fewer than ``FEWEST`` runs an interval says nothing, and is nan.
    """
    runs = {name: values.reshape(-1, 1) for name, values in scores.items()}
    with warnings.catch_warnings():
        # arch, below rliable, renames the seed's argument, which rliable does not know yet.
        warnings.filterwarnings("ignore", message="random_state is deprecated")
        points, intervals = get_interval_estimates(
            runs,
            lambda x: np.array([metrics.aggregate_iqm(x)]),
            reps=_BOOTSTRAPS,
            random_state=np.random.RandomState(0),
        )
    return (
        {name: float(value[0]) for name, value in points.items()},
        {
            name: value[:, 0] if len(scores[name]) >= FEWEST else np.full(2, np.nan)
            for name, value in intervals.items()
        },
    )


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Summarise the costs: a row for each scenario, for sampled and deterministic actions."""
    names = list(trials["scenario"].unique())
    rows = []
    for measure, label in MEASURES.items():
        ends = {name: window(trials, name, measure, *WINDOWS[-1]).to_numpy() for name in names}
        points, intervals = iqm({name: values for name, values in ends.items() if len(values)})
        for name in names:
            by_trial = curve(trials, name, measure)
            low, high = intervals.get(name, (np.nan, np.nan))
            rows.append(
                {
                    "scenario": name,
                    "actions": label,
                    "runs": trials[trials["scenario"] == name]["seed"].nunique(),
                    **{
                        f"cost_{first}_{last}": by_trial.loc[first:last].mean()
                        for first, last in WINDOWS
                    },
                    "cost_6": by_trial.get(6, np.nan),
                    "iqm": points.get(name, np.nan),
                    "iqm_low": low,
                    "iqm_high": high,
                    **_compared(trials, name, measure),
                    **{f"first_{t}": first_below(by_trial, t) for t in THRESHOLDS},
                    "holds_0.5": holds_from(by_trial, 0.5, _until(name)),
                }
            )
    table = pd.DataFrame(rows)
    return table.astype(dict.fromkeys([*(f"first_{t}" for t in THRESHOLDS), "holds_0.5"], "Int64"))


def _compared(trials: pd.DataFrame, name: str, measure: str) -> dict[str, float]:
    """How far behind Dyna-CKA a scenario is, which is not said of Dyna-CKA itself."""
    columns: dict[str, float] = {}
    for first, last in _COMPARED:
        found = (np.nan, np.nan)
        if name != REFERENCE:
            found = behind(trials, name, measure, first, last)
        columns |= dict(
            zip((f"behind_{first}_{last}", f"behind_{first}_{last}_se"), found, strict=True)
        )
    return columns


def _until(name: str) -> int:
    """The last trial that a model serves, or of all for a model-free learner."""
    if SCENARIOS[name].dynamics is None:
        return SETTINGS.num_trials
    return SETTINGS.model_until


def tabulate_time(trials: pd.DataFrame) -> pd.DataFrame:
    """Mean seconds of a run in each part, its updates, and how well the model foresaw trials.

    Scores are over the trials from the second, which is the first that a learnt model foresees.
    """
    trials = trials.assign(total_seconds=sum(trials[f"{part}_seconds"] for part in PARTS))
    sums = [*(f"{part}_seconds" for part in PARTS), "total_seconds", "updates", "left_bounds"]
    by_run = trials.groupby(["scenario", "seed"], sort=False)[sums].sum()
    table = by_run.groupby("scenario", sort=False).mean()
    scores = trials[trials["trial"] > 1].groupby("scenario", sort=False)
    table["nlpd_median"] = scores["nlpd"].median()
    table["coverage"] = scores["coverage"].mean()
    table[list(RMSES)] = scores[list(RMSES)].median()
    return table.reset_index()
