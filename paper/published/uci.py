"""Yacht, energy and concrete: errors and densities, and published ones on the same splits.

Published numbers are test errors and log likelihoods over twenty splits of nine tenths of the rows.
Splits, scores and methods were fixed before the first run; formulas and priors were tried on
splits of our own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import pandas as pd

from paper.common.experiment import Run, Table
from paper.common.tables import Cell, frame, groups, mean_error, of, part_of, table
from paper.common.verdicts import paired
from paper.published import TABLES, Uci, published
from paper.published.rivals import RIVALS, judged, ours
from paper.published.uci_tables import physics, split


def run(experiment: Uci, name: str, share: float, method: str, seed: int) -> Run:
    """Fit a method to the training rows of a split; return its scores on the test rows."""
    fitted, data = RIVALS.get(method) or ours(method), split(name, share, seed)
    scores = judged(fitted, data, physics(name), seed=seed, is_centred=method == "gp")
    del scores["mae"]
    return scores


def tables(runs: Sequence[Run], experiment: Uci) -> dict[str, Table]:
    """Return all tables, by name."""
    found = frame(runs)
    methods = groups(found, "method", experiment.axes["method"])
    cells = {
        f"{name}, {label}": {"table": name, "share": share}
        for name in TABLES
        for share, label in experiment.axes["share"].items()
    }

    def of_gp(own: pd.DataFrame) -> Cell:
        return lambda part: paired(
            own, "rmse", "method", part["method"].iloc[0], "gp", ratio=True
        ).ratio()

    shown: dict[str, tuple[str, Callable[..., Cell]]] = {
        "rivals": (
            "RMSE by a tenth and nine tenths of the rows",
            partial(mean_error, "rmse", ".3g", counted=True),
        ),
        "gp": (
            "RMSE in that of the GP, geometric mean and 95 % interval over the splits",
            lambda **cell: of_gp(part_of(found, **cell)),
        ),
        "coverage": ("95 % coverage", partial(of, "coverage", "mean", ".2f")),
        "seconds": ("Seconds of a fit", partial(of, "seconds", "median", ".2g")),
    }
    full = {f"{what}, {name}": mean_error(score, form, counted=True, table=name)
            for score, what, form in (("rmse", "RMSE", ".3f"), ("density", "log likelihood", ".2f"))
            for name in TABLES}  # fmt: skip
    rows = groups(part_of(found, share=0.9), "method", experiment.axes["method"])
    more = [[label, *cells] for label, cells in published("uci").items()]
    text = table(rows, {**full, "source": lambda part: "this run"}, "method", more)
    title = "RMSE and log likelihood by nine tenths of the rows, and published ones"
    return {"published": Table(title, text)} | {
        name: Table(
            title,
            table(methods, {label: make(**cell) for label, cell in cells.items()}, "method"),
        )
        for name, (title, make) in shown.items()
    }
