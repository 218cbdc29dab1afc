"""The results of the runs that there are, and their summaries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from paper.cartpole.scenarios import SCENARIOS, SETTINGS
from paper.control.curves import Curves
from paper.control.results import iqm, load_trials

MEASURES = {"cost": "sampled", "evaluation": "deterministic"}
WINDOWS = ((1, 6), (13, 25), (41, 50))
THRESHOLDS = (0.5, 0.4)
RMSES = ("rmse_x", "rmse_theta", "rmse_x_dot", "rmse_theta_dot")  # m, rad, m/s, rad/s
_COMPARED = ((1, 25), (41, 50))
_SMOOTHED = 3


def load(out: Path) -> pd.DataFrame:
    """The records of all finished runs: a row for each scenario, seed and trial (from 1).

    The model's errors stand in a column for each state, ``RMSES``.
    """
    return load_trials(out, list(SCENARIOS), RMSES)


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


def tabulate(trials: pd.DataFrame) -> pd.DataFrame:
    """Summarise the costs: a row for each scenario, for sampled and deterministic actions."""
    rows = []
    for measure, label in MEASURES.items():
        curves = Curves(trials, measure)
        ends = {name: curves.window(name, *WINDOWS[-1]).to_numpy() for name in curves.names}
        points, intervals = iqm({name: values for name, values in ends.items() if len(values)})
        for name in curves.names:
            by_trial = curves.mean(name)
            low, high = intervals.get(name, (np.nan, np.nan))
            rows.append(
                {
                    "scenario": name,
                    "actions": label,
                    "runs": len(curves.seeds(name)),
                    **{
                        f"cost_{first}_{last}": by_trial.loc[first:last].mean()
                        for first, last in WINDOWS
                    },
                    "cost_6": by_trial.get(6, np.nan),
                    "iqm": points.get(name, np.nan),
                    "iqm_low": low,
                    "iqm_high": high,
                    **curves.more_columns(name, _COMPARED),
                    **{f"first_{t}": curves.first(name, t) for t in THRESHOLDS},
                    "holds_0.5": holds_from(by_trial, 0.5, _until(name)),
                }
            )
    table = pd.DataFrame(rows)
    return table.astype(dict.fromkeys([*(f"first_{t}" for t in THRESHOLDS), "holds_0.5"], "Int64"))


def _until(name: str) -> int:
    """The last trial that a model serves, or of all for a model-free learner."""
    if SCENARIOS[name].dynamics is None:
        return SETTINGS.num_trials
    return SETTINGS.model_until
