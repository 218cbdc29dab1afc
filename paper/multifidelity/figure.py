"""All runs at a glance: a panel for each pair, a row for each method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from paper.common.experiment import Record
from paper.common.figures import panels, save
from paper.multifidelity import Multifidelity
from paper.multifidelity.tables import load

COLUMNS = {
    "nrmse": "RMSE / sd of the truth",
    "nlpd": "negative log predictive density, nats",
    "coverage": "coverage of the central 95 % interval",
}
COLORS = ("tab:orange", "tab:blue")  # of the smaller and the larger number of observations


def draw(records: Sequence[Record], experiment: Multifidelity) -> list[Path]:
    """Draw three scores of all runs, with the medians."""
    runs = load(records)
    return [_draw(runs, column, experiment.out / f"{column}.png") for column in COLUMNS]


def _draw(runs: pd.DataFrame, column: str, path: Path) -> Path:
    methods = list(runs["method"].unique())
    names = list(runs["pair"].unique())
    figure, axes = panels(names, 3, (3.6, 0.6 + 0.3 * len(methods)), share=False, width=9)
    for ax, name in zip(axes, names, strict=True):
        if _panel(ax, runs[runs["pair"] == name], column, methods):
            ax.set_title(f"{name} (beyond 10 logarithmic)", loc="left", fontsize=10)
    for i, ax in enumerate(axes):
        ax.tick_params(labelleft=i % 3 == 0)
    figure.supxlabel(COLUMNS[column], fontsize="medium")
    per_input = sorted(runs["per_input"].unique())
    handles = [
        Line2D([], [], color=color, marker="|", ms=11, mew=2.5, lw=0, label=f"N = {size} d")
        for size, color in zip(per_input, COLORS, strict=False)
    ]
    dot = Line2D([], [], color="0.5", marker="o", ms=3.5, lw=0, label="a run")
    median = Line2D([], [], color="0.5", marker="|", ms=11, mew=2.5, lw=0, label="median")
    figure.legend(handles=[*handles, dot, median], loc="outside upper right", ncols=4)
    return save(figure, path)


def _panel(ax: Axes, runs: pd.DataFrame, column: str, methods: list[str]) -> bool:
    """Draw a pair; tell whether the axis turns logarithmic beyond 10."""
    bent = False
    for row, method in enumerate(methods):
        if row % 2 == 0:
            ax.axhspan(row - 0.5, row + 0.5, color="0.95", lw=0, zorder=-1)
        by_size = runs[runs["method"] == method].groupby("per_input")[column]
        for (_, values), color, offset in zip(by_size, COLORS, (-0.2, 0.2), strict=False):
            y = row + offset
            ax.plot(values, [y] * len(values), "o", color=color, ms=3.5, mew=0, alpha=0.5)
            ax.plot(values.median(), y, "|", color=color, ms=11, mew=2.5)
    ax.set_yticks(range(len(methods)), methods)
    ax.set_ylim(len(methods) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    if column == "nrmse":
        ax.set_xscale("log")
        decades = math.log10(runs[column].max() / runs[column].min())
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if decades > 2 else (1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    elif column == "nlpd":
        ax.margins(x=0.08)
        if runs[column].abs().max() > 20:
            bent = True
            ax.set_xscale("symlog", linthresh=10)
    else:
        ax.set_xlim(-0.03, 1.03)
        ax.axvline(0.95, color="0.3", lw=1, ls="--", zorder=0)
    ax.grid(axis="x", color="0.85", lw=0.6)
    ax.set_axisbelow(True)
    return bent
