"""The results of the runs that there are, and how they are summarised."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rliable import metrics
from rliable.library import get_interval_estimates

PARTS = ("fit", "rollout", "sac")
FEWEST = 4  # runs that a bootstrap interval is given of
_BOOTSTRAPS = 1000


def results(out: Path, scenarios: Sequence[str]) -> Iterator[dict[str, Any]]:
    """What the files of all finished runs of some scenarios hold.

    Raises:
        FileNotFoundError: If there is none.
    """
    found = False
    for path in (out / "runs").glob("*.json"):
        result = json.loads(path.read_text())
        if result["scenario"] in scenarios:
            found = True
            yield result
    if not found:
        raise FileNotFoundError(f"There are no results in {out / 'runs'}.")


def load_trials(out: Path, scenarios: Sequence[str], rmses: Sequence[str]) -> pd.DataFrame:
    """The records of all finished runs: a row for each scenario, seed and trial (from 1).

    The model's errors stand in a column for each state, ``rmses``.
    """
    frames = []
    for result in results(out, scenarios):
        frame = pd.DataFrame(result["trials"])
        frame.insert(0, "trial", np.arange(len(frame)) + 1)
        errors = [found or [np.nan] * len(rmses) for found in frame.pop("rmse")]
        frame[list(rmses)] = np.array(errors, dtype=float)
        frames.append(of_run(frame.astype({"nlpd": float, "coverage": float}), result))
    return in_order(frames, scenarios)


def of_run(frame: pd.DataFrame, result: dict[str, Any]) -> pd.DataFrame:
    """Say in a table of whose run it is; the table itself is changed."""
    frame.insert(0, "scenario", result["scenario"])
    frame.insert(1, "seed", result["seed"])
    return frame


def in_order(frames: Sequence[pd.DataFrame], scenarios: Sequence[str]) -> pd.DataFrame:
    """Tables as one, sorted by scenario (as listed), seed and trial."""
    rank = list(scenarios).index
    return (
        pd.concat(frames)
        .sort_values(
            ["scenario", "seed", "trial"],
            key=lambda c: c.map(rank) if c.name == "scenario" else c,
            kind="stable",
        )
        .reset_index(drop=True)
    )


def iqm(scores: dict[str, np.ndarray]) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Interquartile means of runs, with the 95 % bootstrap intervals of rliable.

    Of fewer than ``FEWEST`` runs an interval says nothing, and is nan.
    """
    runs = {name: values.reshape(-1, 1) for name, values in scores.items()}
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002  rliable draws from the global generator, whatever it is given
    try:
        points, intervals = get_interval_estimates(
            runs, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=_BOOTSTRAPS
        )
    finally:
        np.random.set_state(state)  # noqa: NPY002
    return (
        {name: float(value[0]) for name, value in points.items()},
        {
            name: value[:, 0] if len(scores[name]) >= FEWEST else np.full(2, np.nan)
            for name, value in intervals.items()
        },
    )


def seconds_of_a_run(rows: pd.DataFrame, parts: Sequence[str]) -> pd.DataFrame:
    """Medians over the runs of the seconds in each part that there is: a row for each scenario.

    Args:
        rows: Those of the runs, with a column ``..._seconds`` for each part.
        parts: Their names.
    """
    columns = [f"{part}_seconds" for part in parts if f"{part}_seconds" in rows]
    by_run = rows.groupby(["scenario", "seed"], sort=False)[columns].sum()
    return by_run.groupby("scenario", sort=False).median()


def tabulate_time(trials: pd.DataFrame, rmses: Sequence[str]) -> pd.DataFrame:
    """Seconds of a run in each part, its updates, and how well the model foresaw trials.

    ``cpu_seconds`` are of the whole run on its core, the others of wall time; they are medians over
    the runs, as a run may have been suspended. Scores are over the trials from the second, which is
    the first that a learnt model foresees.
    """
    trials = trials.assign(total_seconds=sum(trials[f"{part}_seconds"] for part in PARTS))
    table = seconds_of_a_run(trials, (*PARTS, "total", "cpu"))
    by_run = trials.groupby(["scenario", "seed"], sort=False)[["updates", "left_bounds"]].sum()
    table[["updates", "left_bounds"]] = by_run.groupby("scenario", sort=False).mean()
    scores = trials[trials["trial"] > 1].groupby("scenario", sort=False)
    table["nlpd_median"] = scores["nlpd"].median()
    table["coverage"] = scores["coverage"].mean()
    table[list(rmses)] = scores[list(rmses)].median()
    return table.reset_index()
