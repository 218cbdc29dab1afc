"""How often intervals of parameters hold what is best and what is true, and how wide they are."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, fit
from gpadjust.core import GP, SamplingWarning, Stationary, Term
from gpadjust.physics import Physics
from gpadjust.validation import Scores
from paper.common.experiment import Run, Table
from paper.common.orthogonal import Orthogonal
from paper.common.tables import markdown, number
from paper.parameters import Parameters
from paper.parameters.laws import textbook_case


def growing(X: Tensor, Y: Tensor, physics: Physics) -> GP:
    """Make a model of a discrepancy that vanishes at 0 and grows as the input cubed."""
    terms = [Term("rho", mean=1.0, physics=0), Term("growing", Stationary(), physics=1)]
    return GP(X, Y, terms=terms, physics=[physics, lambda X: X[..., :1] ** 3])


def orthogonal(X: Tensor, Y: Tensor, physics: Physics) -> GP:
    """Make a model of a discrepancy that is orthogonal to what parameters change (Plumlee)."""
    return PhysicsMeanGP(X, Y, physics=physics, covar_module=Orthogonal(physics))


MODELS: Mapping[str, Callable[..., GP]] = {
    "physics": CalibratedPhysics,
    "free": PhysicsMeanGP,
    "orthogonal": orthogonal,
    "cka": CKA,
    "vanishing": growing,
}


def run(experiment: Parameters, problem: str, model: str, seed: int) -> Run:
    """Fit a model to a case; return ends of intervals, beside what they are to hold."""
    warnings.simplefilter("ignore", SamplingWarning)
    known = textbook_case(problem, seed)
    fitted: Any = MODELS[model](known.X, known.Y, physics=known.physics)
    begin = time.perf_counter()
    fit(fitted)
    seconds = time.perf_counter() - begin
    low, high = (end.tolist() for end in fitted.physics_parameters.interval())
    best = known.best
    with torch.no_grad():
        mean, variance = fitted.predict(known.X)
        lower, upper = fitted.interval(known.X)
    return {
        "intervals": {name: [low[i], high[i]] for i, name in enumerate(best)},
        "best": best,
        "true": dict(known.true),
        "rmse": Scores.of(mean, variance, known.system).rmse.item(),
        "coverage": _share((lower <= known.system) & (known.system <= upper)),
        "seconds": seconds,
    }


def _share(which: Tensor) -> float:
    return which.double().mean().item()


def tables(runs: Sequence[Run], experiment: Parameters) -> dict[str, Table]:
    """All tables, by name."""
    found = load(runs)
    header = ["", "parameter", "cases", "holds the best", "holds the true", "median width"]
    header += ["RMSE", "coverage", "seconds"]
    shown = {}
    for problem, title in experiment.axes["problem"].items():
        if (found["problem"] == problem).any():
            rows = _rows(found[found["problem"] == problem], experiment)
            shown[problem] = Table(title, markdown(header, rows))
    return shown


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


def _rows(found: pd.DataFrame, experiment: Parameters) -> list[list[str]]:
    rows = []
    for model, label in experiment.axes["model"].items():
        own = found[found["model"] == model]
        for i, (parameter, part) in enumerate(own.groupby("parameter", sort=False)):
            whole = [
                number(part["rmse"].median()),
                number(part["coverage"].mean(), ".2f"),
                number(part["seconds"].median(), ".2f"),
            ]
            of_parameter = [
                *(label if i == 0 else "", str(parameter), f"{len(part)}"),
                number(part["best"].mean(), ".2f"),
                number(part["true"].astype(float).mean(), ".2f", missing="-"),
                number(part["width"].median()),
            ]
            rows.append([*of_parameter, *(whole if i == 0 else ["", "", ""])])
    return rows
