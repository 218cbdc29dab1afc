"""The tables, and the paper's claims about this experiment, each with the number that decides it.

"Slightly" is within 20 %, "about 30 %" 20 to 40 %, "about 50 %" 40 to 60 %; beyond, in the claim's
favour, a claim is beaten. Differences are paired by data set and relative to the mean of what they
are compared with; a claim is inconclusive if its bound lies in their 95 % interval (of Student's t;
of spreads by the bootstrap). Best is who is not above the lowest mean by more than this interval.
F7 is undetermined under the paper's protocol if the closed form, with the lengthscales and ridges
of the grid, gives both verdicts: the paper does not say which it took.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd

from paper.common.claims import Judged, Verdict, all_of, reproduced, within
from paper.common.experiment import Record, Table
from paper.common.statistics import Difference, bootstrap
from paper.common.tables import claims_table, markdown, number
from paper.forrester import FIRST_LOOK, Forrester

NAMES = ("Zero-mean GP", "Phy-mean GP", "GP-bias", "GP-scale", "AR1", "CKA", "RRA")
PROTOCOLS: tuple[Literal["paper", "gpadjust"], ...] = ("paper", "gpadjust")
READINGS = ("B", "A")
_COLUMNS = ("rmse", "nlpd", "crps", "coverage", "seconds")
_ABOUT_HALF = (0.4, 0.6)  # below the physics mean


def load(records: Sequence[Record]) -> pd.DataFrame:
    """The scores: a row for each reading, protocol, seed and model."""
    parts = [
        pd.DataFrame({name: record[name] for name in ("model", *_COLUMNS)}).assign(
            **{name: record[name] for name in ("reading", "protocol", "seed")}
        )
        for record in records
    ]
    return pd.concat(parts).astype(dict.fromkeys(_COLUMNS, float)).reset_index(drop=True)


def first_look(records: Sequence[Record]) -> str | None:
    """The errors on the first data sets."""
    runs = load(records)
    runs = runs[(runs["reading"] == "B") & (runs["protocol"] != "closed form")]
    sets = runs.groupby("protocol")["seed"].nunique()
    if len(sets) < 2 or sets.min() < FIRST_LOOK:
        return None
    return f"The first {sets.min()} data sets, reading B\n\n" + errors(runs)


def tables(records: Sequence[Record], experiment: Forrester) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    by_reading = {reading: runs[runs["reading"] == reading] for reading in READINGS}
    grid = runs[runs["protocol"] == "closed form"]
    found = {"rmse": Table("Reading B, mean / median RMSE", errors(by_reading["B"]))}
    for reading, part in by_reading.items():
        for protocol in PROTOCOLS:
            title = f"Reading {reading} of the crude function, protocol {protocol}"
            scored = part[part["protocol"] == protocol]
            found[f"{reading}:{protocol}"] = Table(title, _scores(scored))
    for reading, part in by_reading.items():
        judged = {
            f"protocol {p}": judge(
                part[part["protocol"] == p], grid if (reading, p) == ("B", "paper") else None
            )
            for p in PROTOCOLS
        }
        title = f"Claims, on reading {reading}"
        found[f"claims-{reading}"] = Table(title, claims_table("claim", judged))
    title = "The closed form of RRA, reading B: mean RMSE less that of Phy-mean GP"
    found["grid"] = Table(title, _grid(_wide(by_reading["B"], "paper"), grid))
    return found


def errors(runs: pd.DataFrame) -> str:
    """Mean and median errors of one reading, a column for each protocol."""
    by_model = runs.groupby(["protocol", "model"])["rmse"]
    mean, median = by_model.mean(), by_model.median()
    rows = [
        [name, *(f"{mean[p, name]:.3g} / {median[p, name]:.3g}" for p in PROTOCOLS)]
        for name in runs[runs["protocol"] == "paper"]["model"].unique()
    ]
    return markdown(["mean / median RMSE", "paper's protocol", '`fit(model, "map")`'], rows)


def judge(runs: pd.DataFrame, grid: pd.DataFrame | None = None) -> list[Judged]:
    """Judge the claims on the runs of one reading and protocol.

    Args:
        runs: Of all models.
        grid: Of the closed form, if it is to be judged whether F7 is determined.
    """
    rmse = runs.pivot(index="seed", columns="model", values="rmse")
    mean, sd = rmse.mean(), rmse.std()

    def change(model: str, reference: str) -> Difference:
        return Difference.of(rmse[model] - rmse[reference]) / mean[reference]

    def slightly_below(model: str, reference: str) -> Verdict:
        found = change(model, reference)
        verdict = within(found, high=0)
        return "beaten" if verdict == "reproduced" and found.mean < -0.2 else verdict

    def below_by(model: str, least: float, most: float) -> Verdict:
        found = change(model, "Phy-mean GP")
        verdict = within(found, high=-least)
        return "beaten" if verdict == "reproduced" and found.mean < -most else verdict

    def wider(model: str, reference: str) -> Verdict:
        if sd[model] == 0 or sd[reference] == 0 or len(rmse) < 4:
            return reproduced(sd[model] > sd[reference])
        low, high = bootstrap(
            [rmse[model], rmse[reference]],
            lambda x, y, axis: np.std(x, axis=axis, ddof=1) - np.std(y, axis=axis, ddof=1),
            paired=True,
        )
        return "reproduced" if low > 0 else "not reproduced" if high < 0 else "inconclusive"

    gap = (rmse["GP-bias"] - rmse["Phy-mean GP"]).abs().max()
    best = mean[list(NAMES)].idxmin()
    behind = Difference.of(rmse["RRA"] - rmse[best])
    among_best = best == "RRA" or behind.low <= 0
    f7 = below_by("RRA", *_ABOUT_HALF) if among_best else "not reproduced"
    f7_text = f"{_percent(change('RRA', 'Phy-mean GP'))}; the best is {best}"
    if best != "RRA" and among_best:
        f7_text += ", within the interval of their difference"
    if grid is not None and len(grid):
        changes = [part.mean for part in _closed_form(rmse, grid).values()]
        f7_text += f"; the closed form gives {min(changes):+.0%} to {max(changes):+.0%} on the grid"
        if min(changes) <= -_ABOUT_HALF[0] <= max(changes):
            f7 = "undetermined"
    spread = f"sd {sd['GP-scale']:.3g} against {sd['Zero-mean GP']:.3g}"
    found: list[tuple[str, str, Verdict, str]] = [
        (
            "F1",
            "zero-mean GP slightly below f_p",
            slightly_below("Zero-mean GP", "f_p"),
            f"{_percent(change('Zero-mean GP', 'f_p'))} of f_p's RMSE",
        ),
        (
            "F2",
            "GP-scale slightly below zero-mean GP, with the larger spread",
            all_of(slightly_below("GP-scale", "Zero-mean GP"), wider("GP-scale", "Zero-mean GP")),
            f"{_percent(change('GP-scale', 'Zero-mean GP'))}, {spread}",
        ),
        (
            "F3",
            "Phy-mean GP and GP-bias are the same model",
            reproduced(bool(gap <= 1e-9)),
            f"RMSEs differ by {gap:.1g} at most",
        ),
        (
            "F4",
            "Phy-mean GP and AR1 below GP-scale",
            all_of(*(within(change(m, "GP-scale"), high=0) for m in ("Phy-mean GP", "AR1"))),
            f"{mean['Phy-mean GP']:.3g} and {mean['AR1']:.3g} against {mean['GP-scale']:.3g}",
        ),
        (
            "F5",
            "AR1 has the largest spread of Phy-mean GP, GP-bias and AR1",
            wider("AR1", "Phy-mean GP"),
            f"sd {sd['AR1']:.3g} against {sd['Phy-mean GP']:.3g}",
        ),
        (
            "F6",
            "CKA about 30 % below Phy-mean GP",
            below_by("CKA", 0.2, 0.4),
            _percent(change("CKA", "Phy-mean GP")),
        ),
        ("F7", "RRA about 50 % below Phy-mean GP, the best", f7, f7_text),
    ]
    return [Judged(*claim) for claim in found]


def _percent(difference: Difference) -> str:
    return difference.text(".1%")


def _wide(runs: pd.DataFrame, protocol: str) -> pd.DataFrame:
    """The errors of a protocol: a row for each seed, a column for each model."""
    chosen = runs[runs["protocol"] == protocol]
    return chosen.pivot(index="seed", columns="model", values="rmse")


def _closed_form(rmse: pd.DataFrame, grid: pd.DataFrame) -> dict[str, Difference]:
    """The change of each cell of the grid from the physics mean."""
    cells = _wide(grid, "closed form").drop(columns="f_p")
    reference = rmse["Phy-mean GP"]
    return {str(cell): Difference.of(cells[cell] - reference) / reference.mean() for cell in cells}


def _grid(rmse: pd.DataFrame, grid: pd.DataFrame) -> str:
    """A row for each lengthscale, a column for each ridge."""
    if grid.empty:
        return "No results yet."
    cells: dict[str, dict[str, str]] = {}
    found: dict[str, Any] = _closed_form(rmse, grid)
    for cell in grid["model"].unique():
        if cell != "f_p":
            lengthscale, ridge = cell.split(", ")
            cells.setdefault(lengthscale, {})[ridge] = found[cell].text(".0%")
    ridges = list(next(iter(cells.values())))
    rows = [[lengthscale, *of.values()] for lengthscale, of in cells.items()]
    return markdown(["lengthscale", *(f"ridge {ridge}" for ridge in ridges)], rows)


def _scores(runs: pd.DataFrame) -> str:
    groups = runs.groupby("model", sort=False)
    found = {
        "RMSE mean": groups["rmse"].mean(),
        "sd": groups["rmse"].std(),
        "median": groups["rmse"].median(),
        "NLPD": groups["nlpd"].mean(),
        "CRPS": groups["crps"].mean(),
        "coverage": groups["coverage"].mean(),
        "fit, s": groups["seconds"].median(),
    }
    rows = [
        [str(name), *(number(values[name]) for values in found.values())]
        for name in runs["model"].unique()
    ]
    return markdown(["", *found], rows)
