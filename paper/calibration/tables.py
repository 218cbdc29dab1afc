"""What the intervals hold, and what that costs in accuracy and time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.calibration import LABELS, METHODS, PUMP, Calibration, label
from paper.calibration.claims import ROW, other_methods, targets
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown

_REFERENCE = "map"


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each run."""
    return pd.DataFrame([{k: v for k, v in r.items() if k != "settings"} for r in records])


def tables(records: Sequence[Record], experiment: Calibration) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    methods = [name for name in METHODS if name in set(runs["method"])]
    pairs = runs[runs["problem"] != PUMP]
    judged = targets(runs, other_methods(experiment))
    found = {"targets": Table("Targets", claims_table("target", {"": judged}))}
    found["summary"] = Table("All rows", _summary(pairs, methods))
    for name, how, title in (
        ("coverage", "mean", "Mean coverage of the central 95 % interval"),
        ("half", "mean", "Mean coverage of the central 50 % interval"),
        ("nrmse", "median", "Median RMSE / sd of the truth"),
        ("nlpd", "mean", "Mean NLPD, nats, less the logarithm of the truth's sd"),
        ("seconds", "median", "Median seconds"),
    ):
        found[name] = Table(title, _by_method(runs, name, how, methods))
    return found


def _summary(runs: pd.DataFrame, methods: Sequence[str]) -> str:
    """Over the rows: what this project set itself for its default."""
    by_row = runs.groupby([*ROW, "method"], sort=False)
    mean = by_row[["coverage", "half", "nlpd", "warned"]].mean().unstack()
    median = by_row[["nrmse", "seconds"]].median().unstack()
    logs = np.log(runs.pivot_table(index=[*ROW, "seed"], columns="method", values="nrmse"))
    rows = []
    for method in methods:
        own = mean.xs(method, axis=1, level=1)
        seeds = set(runs[runs["method"] == method]["seed"])  # of which others may have more
        beside = runs[(runs["method"] == _REFERENCE) & runs["seed"].isin(seeds)].groupby(
            ROW, sort=False
        )
        cells = [
            f"{own['coverage'].mean():.3f}",
            f"{own['coverage'].min():.2f}",
            f"{own['half'].mean():.2f}",
            f"{own['nlpd'].mean():.2f}",
        ]
        if _REFERENCE in methods:
            ratio = (logs[method] - logs[_REFERENCE]).dropna()
            # Two means of the same numbers may differ in their last digit.
            gap = (own["nlpd"] - beside["nlpd"].mean()).round(9)
            worst = median["nrmse"][method] / beside["nrmse"].median()
            times = median["seconds"][method] / beside["seconds"].median()
            cells += [
                f"{np.exp(ratio.mean()):.2f}",
                f"{worst.max():.2g} ({(worst > 1.3).sum()} above 1.3)",
                f"{(gap < 0).sum()} of {len(gap)}",
                f"{gap.max():+.2f}",
                f"{times.median():.1f}",
            ]
        cells.append(f"{own['warned'].mean():.3f}")
        rows.append([LABELS[method], *cells])
    head = ["95 % hold", "least of a row", "50 % hold", "NLPD"]
    if _REFERENCE in methods:
        head += ["RMSE / that of the most likely", "largest of a row", "NLPD lower in rows"]
        head += ["largest loss of NLPD", "time / that of the most likely"]
    return markdown(["", *head, "share of warnings"], rows)


def _by_method(runs: pd.DataFrame, column: str, how: str, methods: Sequence[str]) -> str:
    rows = []
    for (name, n, noise), part in runs.groupby(ROW, sort=False):
        values = part.groupby("method")[column].agg(how)[[*methods]]
        rows.append([label(name, n, noise), *(f"{value:.2g}" for value in values)])
    return markdown(["", *(LABELS[name] for name in methods)], rows)
