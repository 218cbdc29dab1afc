"""Coverage, widths, warnings and seconds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.common.claims import Verdict, met
from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.ridges import FOLDS, MODELS, NINE, RIDGES, Ridges

_OFF = 0.2  # difference of distribution functions, above which an answer is off


def tables(records: Sequence[Record], experiment: Ridges) -> dict[str, Table]:
    """All tables, by name."""
    runs = pd.DataFrame([_judged(record) for record in records])
    header = [
        "",
        "",
        "cases",
        "true values in",
        "compared",
        "reference holds",
        "width / reference's",
        "off",
        "warned if off",
        "warned else",
        "effective size",
        "seconds",
    ]
    rows = []
    for problem in (*RIDGES, NINE, *FOLDS):
        for model, label in MODELS.items():
            own = runs[(runs["problem"] == problem) & (runs["model"] == model)]
            if len(own):
                rows.append([problem if model == "physics" else "", label, *_row(own)])
    return {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(runs))),
        "cases": Table("Intervals of parameters", markdown(header, rows)),
    }


def _judged(record: Record) -> Record:
    low, high = np.array(record["interval"])
    true = np.array(record["true"])
    found = {name: record[name] for name in ("problem", "model", "size", "warned", "seconds")}
    found |= {"held": ((low <= true) & (true <= high)).mean(), "width": np.nan, "right": np.nan}
    found["off"] = np.nan if record["distance"] is None else float(record["distance"] > _OFF)
    if record["reference"] is not None:
        first, last = np.array(record["reference"])
        found["width"] = np.log((high - low) / (last - first)).mean()
        found["right"] = ((first <= true) & (true <= last)).mean()
    return found


def _row(own: pd.DataFrame) -> list[str]:
    compared = own.dropna(subset="off")
    off = compared["off"] == 1
    return [
        f"{len(own)}",
        f"{own['held'].mean():.2f}",
        f"{len(compared)}",
        f"{compared['right'].mean():.2f}" if len(compared) else "",
        f"{np.exp(compared['width'].mean()):.2f}" if len(compared) else "",
        f"{off.sum()}" if len(compared) else "",
        f"{compared['warned'][off].sum()}" if off.any() else "",
        f"{compared['warned'][~off].sum()}" if len(compared) else f"({own['warned'].sum()})",
        f"{own['size'].median():.0f}",
        f"{own['seconds'].median():.2f} to {own['seconds'].max():.2f}",
    ]


def _targets(runs: pd.DataFrame) -> list[list[str]]:
    rows = []

    def enter(name: str, text: str, verdict: Verdict, numbers: list[str]) -> None:
        rows.append([name, text, f"**{verdict}**: {', '.join(numbers)}"])

    ridges = runs[runs["problem"].isin(RIDGES)]
    models = [model for model in MODELS if model in {*ridges["model"]}]
    if models:
        held = {m: ridges[ridges["model"] == m]["held"].mean() for m in models}
        enter(
            "P1",
            "ridges: 95 % intervals hold .90 to .98 of the true values",
            met(all(0.9 <= each <= 0.98 for each in held.values())),
            [f"{MODELS[m]} {each:.3f}" for m, each in held.items()],
        )
        groups = ridges.dropna(subset="width").groupby(["problem", "model"], sort=False)
        widths = np.exp(groups["width"].mean())
        if len(widths):
            enter(
                "P2",
                "ridges: widths .9 to 1.15 of the reference's, each problem and model",
                met(bool(widths.between(0.9, 1.15).all())),
                [f"{widths.min():.2f} to {widths.max():.2f}"],
            )
    compared = runs.dropna(subset="off")
    off = compared["off"] == 1
    if len(compared):
        warned = int(compared["warned"][off].sum())
        enter(
            "P3",
            f"a warning in 9 of 10 cases that are off (distribution functions by {_OFF:g})",
            met(warned >= 0.9 * off.sum()) if off.any() else "undetermined",
            [f"{warned} of {off.sum()}"],
        )
        rarely = int(compared["warned"][~off].sum())
        enter(
            "P4",
            "a warning in fewer than 1 of 20 that are not",
            met(rarely < 0.05 * (~off).sum()),
            [f"{rarely} of {(~off).sum()}"],
        )
    for name, problems, most in (("P5", RIDGES[:3], 2.0), ("P6", (NINE,), 5.0)):
        own = runs[runs["problem"].isin(problems)]
        if len(own):
            parameters = "two parameters" if name == "P5" else "nine"
            enter(
                name,
                f"{parameters}: at most {most:g} s of CPU time a fit",
                met(own["seconds"].max() <= most),
                [f"{own['seconds'].median():.2f}, at most {own['seconds'].max():.2f}"],
            )
    return rows
