"""Errors, intervals and times by pair, and the targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.common.claims import met
from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.polynomials import METHODS, POLYNOMIALS, Polynomials

_LEAST = 1e-4  # sd of the truth: errors below it are alike


def tables(records: Sequence[Record], experiment: Polynomials) -> dict[str, Table]:
    """All tables, by name."""
    runs = pd.DataFrame([{k: v for k, v in r.items() if k != "settings"} for r in records])
    runs["log"] = runs["nrmse"].clip(lower=_LEAST).map(np.log)
    is_polynomial = [POLYNOMIALS.get(p) == n for p, n in zip(runs["pair"], runs["n"], strict=True)]
    ours, textbook = runs[is_polynomial], runs[~np.array(is_polynomial)]
    title = "Geometric mean of RMSE / sd of the truth; 95 % hold; CPU seconds"
    found = {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(ours, runs))),
        "pairs": Table(title, _by_pair(ours)),
    }
    if len(textbook):
        found["textbook"] = Table(f"{title}: textbook pairs", _by_pair(textbook))
    return found


def _by_pair(runs: pd.DataFrame) -> str:
    methods = [method for method in METHODS if method in {*runs["method"]}]
    rows = []
    for (name, n), part in runs.groupby(["pair", "n"], sort=False):
        own = part.groupby("method")
        error, held = np.exp(own["log"].mean()), own["coverage"].mean()
        cells = [f"{error[method]:.2g} ({held[method]:.2f})" for method in methods]
        rows.append([f"{name}, N = {n}", *cells])
    held, seconds = (
        runs.groupby("method")[column].agg(how)
        for column, how in (("coverage", "mean"), ("seconds", "median"))
    )
    rows.append(["95 % hold, mean", *(f"{held[method]:.2f}" for method in methods)])
    rows.append(["CPU seconds, median", *(f"{seconds[method]:.2g}" for method in methods)])
    return markdown(["RMSE / sd (95 % hold)", *(METHODS[m] for m in methods)], rows)


def _ratios(runs: pd.DataFrame, method: str) -> pd.Series[float]:
    """Logarithms of the error over MFK's, by pair and size, on the same data sets."""
    logs = runs.pivot_table(index=["pair", "n", "seed"], columns="method", values="log", sort=False)
    if not {method, "mfk"} <= {*logs}:
        return pd.Series(dtype=float)
    gap: pd.Series[float] = (logs[method] - logs["mfk"]).dropna()
    return gap.groupby(["pair", "n"], sort=False).mean()


def _targets(ours: pd.DataFrame, runs: pd.DataFrame) -> list[list[str]]:
    rows = []
    cka, ar1 = _ratios(ours, "cka"), _ratios(runs, "ar1")
    if len(cka):
        each = np.exp(cka)
        said = ", ".join(f"{name} {ratio:.2g}" for (name, _), ratio in each.items())
        text = "CKA: error at most twice MFK's on each pair"
        verdict = met(bool((each <= 2).all()))
        rows.append(["N1", text, f"**{verdict}**: mean {np.exp(cka.mean()):.2g}; {said}"])
        held = ours[ours["method"] == "cka"]["coverage"].mean()
        text = "CKA: 95 % hold .90 on the mean of all"
        rows.append(["N2", text, f"**{met(bool(held >= 0.9))}**: {held:.3f}"])
    if len(ar1):
        mean, both = np.exp(ar1.mean()), _ratios(ours, "ar1")
        text = "AR1: error at most 1.1 times MFK's on all pairs, geometric mean"
        parts = f"near-polynomials {np.exp(both.mean()):.2g}"
        rows.append(["N3", text, f"**{met(bool(mean <= 1.1))}**: {mean:.2f}; {parts}"])
    return rows
