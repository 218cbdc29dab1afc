"""The tables of the runs that there are, and the verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from paper.active import LABELS, PROBLEMS, Active
from paper.common.claims import FEWEST, Judged, counted, met
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown, settings_table

REFERENCE = "gp"  # whose final error the others are to reach
ALONE = "f_p"  # what needs no measurement
CLAIMS = {"forrester": "M1", "currin": "M2", "park91a": "M3", "cartpole": "M4"}
_SECONDS = ["choice_seconds", "score_seconds"]


def load(records: Sequence[Record]) -> pd.DataFrame:
    """The scores: a row for each run and number of measurements."""
    frames = [
        pd.DataFrame(
            {**r["scores"], **{name: r[name] for name in ("problem", "learner", "seed", *_SECONDS)}}
        ).astype(dict.fromkeys(["coverage", *_SECONDS], float))
        for r in records
    ]
    ranks = {"problem": PROBLEMS.index, "learner": list(LABELS).index}
    order = ["problem", "learner", "seed", "measurements"]
    runs = pd.concat(frames)
    return runs.sort_values(
        order, key=lambda c: c.map(ranks[str(c.name)]) if c.name in ranks else c
    ).reset_index(drop=True)


def tables(records: Sequence[Record], experiment: Active) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    table = tabulate(runs)
    seconds = table["choice_seconds"].map("{:.2g}".format)
    seconds += table["score_seconds"].map(" + {:.2g}".format)
    columns: dict[str, Any] = {
        problem: asdict(experiment.settings_of(problem)) for problem in PROBLEMS
    }
    found = {"settings": Table("Settings", settings_table(columns))}
    found["claims"] = Table("Targets", claims_table("target", {"": verdicts(runs)}))
    for name, title, cells in (
        ("errors", "Median final error", table["nrmse"].map("{:.2g}".format)),
        ("needed", "Measurements that reach the final error of `gp`", table.apply(_count, axis=1)),
        ("coverage", "Final coverage of 95 %", table["coverage"].map("{:.2f}".format)),
        ("seconds", "Seconds of choices + scores", seconds),
    ):
        found[name] = Table(title, _by_learner(table.assign(cell=cells.replace("nan", ""))))
    return found


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
                "nrmse": last["nrmse"].median(),
                "coverage": last["coverage"].mean(),
                "needed": np.median(count) if len(count) else np.nan,
                "reached": np.isfinite(count).sum(),
                "compared": len(count),
                "choice_seconds": last["choice_seconds"].median(),
                "score_seconds": last["score_seconds"].median(),
            }
        )
    return pd.DataFrame(rows)


def verdicts(runs: pd.DataFrame, learner: str = "cka") -> list[Judged]:
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
        alone = int((needed(part, ALONE) == 0).sum())
        if alone:
            measured += f"; f_p alone does it without any in {alone}"
        judged.append(Judged(CLAIMS[str(name)], text, met(middle <= budget / 2), measured))
    return judged


def _final(runs: pd.DataFrame, learner: str) -> pd.DataFrame:
    """The last row of each run of a learner, by seed."""
    return runs[runs["learner"] == learner].groupby("seed").last()


def _by_learner(table: pd.DataFrame) -> str:
    """A row for each learner, a column for each problem."""
    cells = table.pivot(index="learner", columns="problem", values="cell").fillna("")
    problems = list(table["problem"].unique())
    rows = [
        [label, *cells.loc[name, problems]] for name, label in LABELS.items() if name in cells.index
    ]
    return markdown(["", *problems], rows)


def _count(row: pd.Series[float]) -> str:
    """A number of measurements, and in how many runs if not in all."""
    if np.isnan(row["needed"]):
        return ""
    text = f"{row['needed']:g}" if np.isfinite(row["needed"]) else "never"
    return (
        text
        if row["reached"] == row["compared"]
        else text + (f" ({row['reached']} of {row['compared']})" if row["reached"] else "")
    )
