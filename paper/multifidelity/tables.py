"""The tables, the comparisons of the methods on the same data sets, and a claim of the paper.

U1 is that of the paper's abstract: the uncertainty of CKA and RRA is more accurate than that of a
Gaussian process and of AR1. It is judged by how far the coverage of the 95 % interval is from 95 %,
paired by pair and data set; that of both is to be less far than that of either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy import stats

from paper.common.claims import Judged, all_of, within
from paper.common.experiment import Record, Table
from paper.common.statistics import Difference
from paper.common.tables import best_in_bold, claims_table, markdown, number
from paper.multifidelity import FIRST_LOOK, METHODS, Multifidelity

_PAIRED = ("GP", "Phy", "AR1", "SMT MFK")  # which CKA is compared with
_ADJUSTED, _OTHERS = ("CKA", "RRA"), ("GP", "AR1")  # of U1


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each run, the pairs in the order in which they were run, the methods as listed."""
    runs = pd.DataFrame([{k: v for k, v in r.items() if k != "settings"} for r in records])
    ranks = {"pair": list(runs["pair"].unique()).index, "method": METHODS.index}
    order = ["pair", "per_input", "method", "seed"]
    return runs.sort_values(
        order, key=lambda c: c.map(ranks[str(c.name)]) if c.name in ranks else c
    ).reset_index(drop=True)


def tables(records: Sequence[Record], experiment: Multifidelity) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    found = {"short": Table("Five observations per input", _short(runs))}
    for name, column, how, title in (
        ("nrmse", "nrmse", "median", "Median RMSE / sd of the truth"),
        ("nlpd", "nlpd", "median", "Median NLPD"),
        ("nlpd-mean", "nlpd", "mean", "Mean NLPD"),
        ("crps", "crps", "median", "Median CRPS / sd of the truth"),
        ("coverage", "coverage", "mean", "Mean coverage of the central 95 % interval"),
        ("seconds", "seconds", "median", "Median seconds"),
    ):
        bold = name not in ("coverage", "seconds")
        found[name] = Table(title, _by_method(runs, column, how, bold))
    title = "RMSE of CKA / that of others on the same data sets, geometric mean (Wilcoxon's p)"
    found["paired"] = Table(title, _paired(runs))
    judged = {f"N = {size} d": [judge_intervals(part)] for size, part in runs.groupby("per_input")}
    found["claims"] = Table("Claim on the intervals", claims_table("claim", judged))
    return found


def first_look(records: Sequence[Record]) -> str | None:
    """The scores of the first runs as they are."""
    if len(records) < FIRST_LOOK:
        return None
    rows = [
        [r["pair"], f"{r['N']}", r["method"], f"{r['seed']}", f"{r['nrmse']:.2g}"] for r in records
    ]
    return "The first runs\n\n" + markdown(["", "N", "method", "seed", "RMSE / sd"], rows)


def judge_intervals(runs: pd.DataFrame) -> Judged:
    """U1, on the runs of one size."""
    text = "CKA and RRA quantify uncertainty more accurately than GP and AR1"
    coverage = runs.pivot_table(index=["pair", "seed"], columns="method", values="coverage")
    if not {*_ADJUSTED, *_OTHERS} <= set(coverage):
        return Judged("U1", text, "not run", "not all four methods were run")
    mean = coverage.mean()
    said = ", ".join(f"{name} {mean[name]:.2f}" for name in (*_ADJUSTED, *_OTHERS))
    away = (coverage - 0.95).abs()
    found = [Difference.of(away[ours] - away[o]) for ours in _ADJUSTED for o in _OTHERS]
    return Judged("U1", text, all_of(*(within(d, high=0) for d in found)), f"95 % hold {said}")


def _by_method(runs: pd.DataFrame, column: str, how: str, bold: bool) -> str:
    """One score: a row for each pair and number of observations, a column for each method."""
    methods = list(runs["method"].unique())
    rows = []
    for (name, N), part in runs.groupby(["pair", "N"], sort=False):
        values = part.groupby("method")[column].agg(how)[methods]
        rows.append([f"{name}, N = {N}", *_cells(values, bold)])
    return markdown(["", *methods], rows)


def _short(runs: pd.DataFrame) -> str:
    """The median errors with the fewest observations per input; coverage and time over all pairs.

    The last two are means and medians over the pairs.
    """
    runs = runs[runs["per_input"] == runs["per_input"].min()]
    methods = list(runs["method"].unique())
    rows = []
    for (name, N), part in runs.groupby(["pair", "N"], sort=False):
        values = part.groupby("method")["nrmse"].median()[methods]
        rows.append([f"{name}, N = {N}", *_cells(values, bold=True)])
    by_pair = runs.groupby(["method", "pair"])
    seconds = by_pair["seconds"].median().groupby("method").median()
    for label, values in (
        ("mean coverage of 95 %", runs.groupby("method")["coverage"].mean()),
        ("median seconds", seconds),
    ):
        rows.append([label, *_cells(values[methods], bold=False)])
    return markdown(["median RMSE / sd", *methods], rows)


def _paired(runs: pd.DataFrame) -> str:
    others = [name for name in _PAIRED if name in set(runs["method"])]
    rows = []
    for (name, N), part in runs.groupby(["pair", "N"], sort=False):
        logs = np.log(part.pivot(index="seed", columns="method", values="nrmse"))
        cells = []
        for other in others:
            gap = (logs["CKA"] - logs[other]).dropna() if "CKA" in logs else pd.Series(dtype=float)
            p = stats.wilcoxon(gap).pvalue if gap.abs().sum() > 0 else np.nan
            cells.append(f"{number(np.exp(gap.mean()), '.2g')} ({number(p, '.2g', '-')})")
        rows.append([f"{name}, N = {N}", *cells])
    return markdown(["CKA /", *others], rows)


def _cells(values: pd.Series[float], bold: bool) -> list[str]:
    return best_in_bold(values) if bold else [f"{value:.2g}" for value in values]
