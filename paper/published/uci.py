"""Yacht, energy and concrete: errors and densities beside published ones, on the same splits.

Published numbers are test errors and log likelihoods over twenty splits of nine tenths of the rows.
Splits, scores and methods were fixed before the first run; formulas and priors were tried on
splits of our own.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import pandas as pd
import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.core import SamplingWarning
from gpadjust.physics import Physics, PhysicsWarning
from gpadjust.validation import score
from paper.common.experiment import Run, Table
from paper.common.tables import Cell, frame, groups, markdown, number, table
from paper.common.verdicts import Difference, paired
from paper.published import TABLES, Uci
from paper.published.rivals import RIVALS, Predict
from paper.published.uci_tables import physics, split


class Row(NamedTuple):
    """A published row: RMSE and log likelihood of each table, and where they are from."""

    rmse: tuple[float | None, ...]
    density: tuple[float | None, ...]
    source: str


PUBLISHED = {
    "MC dropout, tuned by grid": Row(
        (0.666, 0.539, 4.83),
        (-1.25, -1.21, -2.94),
        "computed from the results of each split in yaringal/DropoutUncertaintyExps, 6eb4497",
    ),
    "probabilistic backpropagation": Row(
        (1.02, 1.80, 5.67), (-1.63, -2.04, -3.16), "Lakshminarayanan et al. 2017, table 1"
    ),
    "deep ensembles": Row(
        (1.58, 2.09, 6.03), (-1.18, -1.38, -3.06), "Lakshminarayanan et al. 2017, table 1"
    ),
    "deep GP of two layers": Row(
        (None, None, None),
        (-1.39, -1.32, -3.13),
        "Bui et al. 2016, as in Izmailov et al. 2019, supplement, table 2; splits of their own",
    ),
    "subspace inference": Row(
        (0.972, 1.598, 5.194),
        (-0.225, -1.563, -3.007),
        "Izmailov et al. 2019, supplement, tables 2 and 3; splits of their own; the likelihood of "
        "the yacht could not be reproduced (issue 5 of wjmaddox/drbayes)",
    ),
    "NGBoost": Row(
        (0.50, 0.46, 5.06),
        (-0.20, -0.60, -3.04),
        "Duan et al. 2020, as in the paper of WGBoost, table 1; splits of their own",
    ),
    "WGBoost": Row(
        (0.48, 0.42, 4.15), (-0.16, -0.53, -2.83), "its paper, table 1; splits of their own"
    ),
}
"""Published numbers, as a copy of the paper or its files have them."""


_MODELS: dict[str, Callable[..., Any]] = {
    "formula": CalibratedPhysics,
    "phymean": PhysicsMeanGP,
    "cka": CKA,
    "gp": lambda X, Y, physics: ZeroMeanGP(X, Y),
}


def ours(method: str, X: Tensor, Y: Tensor, physics: Physics, *, seed: int) -> Predict:
    """Fit one of our models by the default; return its predictions of observations."""
    model = _MODELS[method](X, Y, physics=physics)
    fit(model, seed=seed)
    return lambda test: model.posterior(test, observation_noise=True)


def run(experiment: Uci, name: str, share: float, method: str, seed: int) -> Run:
    """Fit a method to the training rows of a split; return its scores on the test rows."""
    for category in (SamplingWarning, PhysicsWarning, OptimizationWarning):
        warnings.simplefilter("ignore", category)
    X, Y, test_X, test_Y = split(name, share, seed)
    shift = Y.mean() if method == "gp" else torch.zeros(())
    fitted = RIVALS.get(method, partial(ours, method))
    begin = time.perf_counter()
    predict = fitted(X, Y - shift, physics(name), seed=seed)
    seconds = time.perf_counter() - begin
    with torch.no_grad():
        scores = score(predict(test_X), test_Y - shift)
    return {
        "rows": len(X),
        "rmse": scores.rmse.item(),
        "density": -scores.nlpd.item(),
        "coverage": scores.coverage.item(),
        "seconds": seconds,
    }


def tables(runs: Sequence[Run], experiment: Uci) -> dict[str, Table]:
    """All tables, by name."""
    found = frame(runs)
    cells = {
        f"{table}, {label}": found[(found["table"] == table) & (found["share"] == share)]
        for table in TABLES
        for share, label in experiment.axes["share"].items()
    }
    methods = groups(found, "method", experiment.axes["method"])

    def by_cell(show: Callable[[pd.DataFrame, str], str]) -> dict[str, Cell]:
        return {cell: _restricted(own, show) for cell, own in cells.items()}

    def of_gp(own: pd.DataFrame, method: str) -> str:
        return paired(own, "rmse", "method", method, "gp", ratio=True).ratio()

    def hold(own: pd.DataFrame, method: str) -> str:
        return number(own[own["method"] == method]["coverage"].mean(), ".2f")

    def seconds(own: pd.DataFrame, method: str) -> str:
        return number(own[own["method"] == method]["seconds"].median(), ".2g")

    def rmse(own: pd.DataFrame, method: str) -> str:
        return _mean(own[own["method"] == method], "rmse", ".3g")

    return {
        "published": Table(
            "RMSE and log likelihood by nine tenths of the rows, beside published ones",
            _beside_published(found, experiment),
        ),
        "rivals": Table(
            "RMSE by a tenth and nine tenths of the rows", table(methods, by_cell(rmse), "method")
        ),
        "gp": Table(
            "RMSE in that of the GP, geometric mean and 95 % interval over the splits",
            table(methods, by_cell(of_gp), "method"),
        ),
        "coverage": Table("95 % hold", table(methods, by_cell(hold), "method")),
        "seconds": Table("Seconds of a fit", table(methods, by_cell(seconds), "method")),
    }


def _restricted(own: pd.DataFrame, show: Callable[[pd.DataFrame, str], str]) -> Cell:
    return lambda part: show(own, part["method"].iloc[0])


def _mean(part: pd.DataFrame, column: str, form: str) -> str:
    """The mean with its standard error, and the number of splits."""
    of = Difference.of(part[column])
    return "" if not of.n else f"{of.mean:{form}} ± {of.error:{form}} ({of.n})"


def _beside_published(found: pd.DataFrame, experiment: Uci) -> str:
    full = found[found["share"] == 0.9]
    rows = []
    for label, part in groups(full, "method", experiment.axes["method"]).items():
        each = [part[part["table"] == table] for table in TABLES]
        cells = [_mean(own, "rmse", ".3f") for own in each]
        rows.append([label, *cells, *(_mean(own, "density", ".2f") for own in each), "this run"])
    for label, row in PUBLISHED.items():
        numbers = ["" if value is None else f"{value:g}" for value in (*row.rmse, *row.density)]
        rows.append([label, *numbers, row.source])
    header = [f"RMSE, {name}" for name in TABLES] + [f"log likelihood, {name}" for name in TABLES]
    return markdown(["method", *header, "source"], rows)
