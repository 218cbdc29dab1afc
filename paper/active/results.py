"""The results of the runs that there are, their summaries, and the verdicts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd

from paper.active.learners import LABELS
from paper.active.problems import NAMES
from paper.control.claims import FEWEST, Judged, counted, met

REFERENCE = "gp"  # whose final error the others are to reach
CLAIMS = {"forrester": "M1", "currin": "M2", "park91a": "M3", "cartpole": "M4"}
_SECONDS = ["choice_seconds", "score_seconds"]


def load(out: Path) -> pd.DataFrame:
    """The scores of all finished runs: a row for each run and number of measurements.

    Raises:
        FileNotFoundError: If there is none.
    """
    frames = []
    for path in sorted((out / "runs").glob("*.json")):
        result = json.loads(path.read_text())
        run = {name: result[name] for name in ("problem", "learner", "seed", *_SECONDS)}
        frames.append(pd.DataFrame({**result["scores"], **run}))
    if not frames:
        raise FileNotFoundError(f"There are no results in {out / 'runs'}.")
    ranks = {"problem": list(NAMES).index, "learner": list(LABELS).index}
    order = ["problem", "learner", "seed", "measurements"]
    runs = pd.concat(frames).astype(dict.fromkeys(_SECONDS, float))
    return runs.sort_values(
        order, key=lambda c: c.map(ranks[str(c.name)]) if c.name in ranks else c
    ).reset_index(drop=True)[[*order, "nrmse", "coverage", *_SECONDS]]


def needed(runs: pd.DataFrame, learner: str) -> pd.Series[float]:
    """The measurements with which a learner first errs no more than the reference at its end.

    Args:
        runs: Of one problem.
        learner: The learner.

    Returns:
        A number for each seed that both have; infinity if it never does.
    """
    final = _final(runs, REFERENCE)["nrmse"]
    own = runs[(runs["learner"] == learner) & runs["seed"].isin(final.index)]
    numbers = {
        seed: part.loc[part["nrmse"] <= final[seed], "measurements"].min()
        for seed, part in own.groupby("seed")
    }
    return pd.Series(numbers, dtype=float).fillna(np.inf)


def tabulate(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each problem and learner; ``needed`` is infinite where it is never."""
    rows = []
    for (name, learner), part in runs.groupby(["problem", "learner"], sort=False):
        last = _final(part, str(learner))
        count = needed(runs[runs["problem"] == name], str(learner))
        rows.append(
            {
                "problem": name,
                "learner": learner,
                "runs": len(last),
                "measurements": last["measurements"].max(),
                "nrmse_median": last["nrmse"].median(),
                "nrmse_low": last["nrmse"].quantile(0.25),
                "nrmse_high": last["nrmse"].quantile(0.75),
                "coverage": last["coverage"].mean(),
                "needed": np.median(count) if len(count) else np.nan,
                "reached": np.isfinite(count).sum(),
                "compared": len(count),
                "choice_seconds": last["choice_seconds"].median(),
                "score_seconds": last["score_seconds"].median(),
            }
        )
    return pd.DataFrame(rows)


def verdicts(runs: pd.DataFrame, learner: str = "cka") -> pd.DataFrame:
    """Whether a learner reaches the reference's final error with half the measurements."""
    judged = []
    for name, part in runs.groupby("problem", sort=False):
        count = needed(part, learner)
        text = f"{name}: {LABELS[learner]} reaches the final error of {LABELS[REFERENCE]} with "
        text += "at most half the measurements"
        if len(count) < FEWEST:
            judged.append(Judged(CLAIMS[str(name)], text, "not run", "too few runs of both"))
            continue
        budget, middle = part["measurements"].max(), float(np.median(count))
        reached = f"with {middle:g}" if np.isfinite(middle) else "never"
        measured = f"{counted(len(count))}: {reached} of {budget} (median), "
        measured += f"in {np.isfinite(count).sum()} of them at all"
        judged.append(Judged(CLAIMS[str(name)], text, met(middle <= budget / 2), measured))
    return pd.DataFrame([vars(claim) for claim in judged])


def _final(runs: pd.DataFrame, learner: str) -> pd.DataFrame:
    """The last row of each run of a learner, by seed."""
    return runs[runs["learner"] == learner].groupby("seed").last()
