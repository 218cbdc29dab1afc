"""Errors over measurements: a panel for each problem."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper.active.learners import LABELS
from paper.active.results import REFERENCE
from paper.control.claims import counted
from paper.control.figure import one_legend, save

COLORS = {
    "random": "0.6",
    "sobol": "black",
    "gp": "tab:orange",
    "cka": "tab:blue",
    "both": "tab:green",
    "rho": "tab:purple",
}


def draw(runs: pd.DataFrame, titles: dict[str, str], path: Path) -> None:
    """Draw the median and the quartiles of the error over the number of measurements.

    Args:
        runs: The scores of all runs.
        titles: The titles of the problems, by name.
        path: Where to save the PNG.
    """
    names = list(runs["problem"].unique())
    columns = min(2, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(max(8.0, 5 * columns), 3.3 * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax, name in zip(axes, names, strict=False):
        part = runs[runs["problem"] == name]
        _panel(ax, part)
        runs_of = counted(part["seed"].nunique())
        ax.set_title(f"{titles[name]} ({runs_of})", loc="left", fontsize=10)
    for ax in axes[::columns]:
        ax.set_ylabel("RMSE / sd of the truth")
    figure.supxlabel("measurements, those of the initial design included", fontsize="medium")
    one_legend(figure, axes)
    save(figure, path)


def _panel(ax: Axes, runs: pd.DataFrame) -> None:
    for learner, part in runs.groupby("learner", sort=False):
        errors = part.groupby("measurements")["nrmse"]
        low, middle, high = (errors.quantile(q) for q in (0.25, 0.5, 0.75))
        color = COLORS[str(learner)]
        ax.fill_between(middle.index, low, high, color=color, alpha=0.15, lw=0)
        ax.plot(middle.index, middle, color=color, lw=1.6, label=LABELS[str(learner)])
        if learner == REFERENCE:
            ax.axhline(middle.iloc[-1], color=color, lw=1, ls=":")
    budget = runs["measurements"].max()
    ax.axvline(budget / 2, color="0.7", lw=1, ls="--", zorder=0, label="half the measurements")
    ax.set_yscale("log")
    ax.grid(axis="y", color="0.9", lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
