"""How often intervals of parameters cover the best and the true value, and how wide they are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import torch

from paper.common.experiment import Run, Table, fitted
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, groups, of, part_of, table
from paper.common.verdicts import scores_of
from paper.parameters import TEXTBOOK, Parameters
from paper.parameters.laws import case, textbook_case


def run(experiment: Parameters, problem: str, model: str, seed: int) -> Run:
    """Fit a model to a case; return ends of intervals, and the values that they should cover."""
    known = textbook_case(problem, seed) if problem in TEXTBOOK else case(problem, seed)
    made = LEARNERS[model].make(known.X, known.Y, physics=known.physics)
    seconds = fitted(made)
    names, ends = [*known.physics.unknowns], torch.stack(made.physics_parameters.interval(), -1)
    low, high = made.interval(known.X)
    scores = scores_of(made.predict(known.X).mean, low, high, known.system)
    results = {
        "intervals": dict(zip(names, ends.tolist(), strict=True)),
        "true": dict(known.true),
        "rmse": scores["rmse"],
        "coverage": scores["coverage"],
        "seconds": seconds,
    }
    return results | ({"best": known.best} if problem in TEXTBOOK else {})


def tables(runs: Sequence[Run], experiment: Parameters) -> dict[str, Table]:
    """Return a row for each parameter of each model; laws whose parameters fold in one table."""
    found, axes = load(runs), experiment.axes
    columns: dict[str, Cell] = {
        "cases": len,
        "covers the best": of("best", "mean", ".2f"),
        "covers the true": of("true", "mean", ".2f"),
        "median width": of("width", "median"),
        "RMSE": of("rmse", "median"),
        "coverage": of("coverage", "mean", ".2f"),
        "seconds": of("seconds", "median", ".2f"),
    }
    tables = {}
    for problem in TEXTBOOK:
        own = part_of(found, problem=problem)
        rows = groups(own, ["model", "parameter"], lambda m, p: f"{axes['model'][m]}, {p}")
        text = table(rows, columns, "model, parameter")
        tables[problem] = Table(axes["problem"][problem], text)
    laws = found[~found["problem"].isin(TEXTBOOK)]
    text = table(groups(laws, "problem", axes["problem"]), columns, "law")
    return tables | {"laws": Table("Right laws, calibrated physics, all parameters", text)}


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """Return a row for each parameter of each case and model."""
    rows = []
    for run in runs:
        shared = {key: run[key] for key in ("problem", "model", "rmse", "coverage", "seconds")}
        for name, (low, high) in run["intervals"].items():
            row = {**shared, "parameter": name, "width": high - low}
            for what in ("true", "best"):
                values: dict[str, float] = run[what if what in run else "true"]
                row[what] = float(low <= values[name] <= high) if name in values else None
            rows.append(row)
    return pd.DataFrame(rows)
