"""How often intervals of parameters hold what is best and what is true, and how wide they are."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd
import torch

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, fit
from gpadjust.core import GP, SamplingWarning
from gpadjust.validation import Scores
from paper.common.experiment import Run, Table
from paper.common.tables import Cell, groups, number, of, table
from paper.parameters import TEXTBOOK, Parameters
from paper.parameters.laws import case, textbook_case

MODELS: Mapping[str, Callable[..., GP]] = {
    "physics": CalibratedPhysics,
    "free": PhysicsMeanGP,
    "cka": CKA,
}


def run(experiment: Parameters, problem: str, model: str, seed: int) -> Run:
    """Fit a model to a case; return ends of intervals, beside what they are to hold."""
    warnings.simplefilter("ignore", SamplingWarning)
    known = textbook_case(problem, seed) if problem in TEXTBOOK else case(problem, seed)
    fitted: Any = MODELS[model](known.X, known.Y, physics=known.physics)
    begin = time.perf_counter()
    fit(fitted)
    seconds = time.perf_counter() - begin
    low, high = (end.tolist() for end in fitted.physics_parameters.interval())
    best = known.best if problem in TEXTBOOK else dict(known.true)
    with torch.no_grad():
        mean, variance = fitted.predict(known.X)
        lower, upper = fitted.interval(known.X)
    inside = (lower <= known.system) & (known.system <= upper)
    return {
        "intervals": {name: [low[i], high[i]] for i, name in enumerate(best)},
        "best": best,
        "true": dict(known.true),
        "rmse": Scores.compute(mean, variance, known.system).rmse.item(),
        "coverage": inside.double().mean().item(),
        "seconds": seconds,
    }


def tables(runs: Sequence[Run], experiment: Parameters) -> dict[str, Table]:
    """A row for each parameter of each model; the laws whose parameters fold in one table."""
    found, axes = load(runs), experiment.axes
    columns: dict[str, Cell] = {
        "cases": len,
        "holds the best": of("best", "mean", ".2f"),
        "holds the true": lambda own: number(own["true"].astype(float).mean(), ".2f"),
        "median width": of("width", "median"),
        "RMSE": of("rmse", "median"),
        "coverage": of("coverage", "mean", ".2f"),
        "seconds": of("seconds", "median", ".2f"),
    }
    tables = {}
    for problem in TEXTBOOK:
        own = found[found["problem"] == problem]
        rows = groups(own, ["model", "parameter"], lambda m, p: f"{axes['model'][m]}, {p}")
        text = table(rows, columns, "model, parameter")
        tables[problem] = Table(axes["problem"][problem], text)
    laws = found[~found["problem"].isin(TEXTBOOK)]
    text = table(groups(laws, "problem", axes["problem"]), columns, "law")
    return tables | {"laws": Table("Right laws, calibrated physics, all parameters", text)}


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each parameter of each case and model."""
    rows = []
    for run in runs:
        for name, (low, high) in run["intervals"].items():
            row = {key: run[key] for key in ("problem", "model", "rmse", "coverage", "seconds")}
            best, true = run["best"][name], run["true"].get(name)
            row |= {"parameter": name, "width": high - low, "best": float(low <= best <= high)}
            rows.append({**row, "true": None if true is None else float(low <= true <= high)})
    return pd.DataFrame(rows)
