"""Errors over measurements: a panel for each problem."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from paper.active import LABELS, Active
from paper.active.tables import REFERENCE, load
from paper.common.claims import counted
from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save

COLORS = {
    "phy": "tab:brown",
    "random": "0.6",
    "sobol": "black",
    "gp": "tab:orange",
    "cka": "tab:blue",
    "both": "tab:green",
    "rho": "tab:purple",
}
TITLES = {"forrester": "Forrester, reading B", "cartpole": "cart-pole transitions"}


def draw(records: Sequence[Record], experiment: Active) -> list[Path]:
    """Draw the median and the quartiles of the error over the number of measurements."""
    runs = load(records)
    by_problem = {str(name): part for name, part in runs.groupby("problem", sort=False)}
    titles = [
        f"{TITLES.get(name, name)} ({counted(part['seed'].nunique())})"
        for name, part in by_problem.items()
    ]
    figure, axes = panels(titles, 2, (5, 3.3), share=False, width=8)
    for ax, part in zip(axes, by_problem.values(), strict=True):
        _panel(ax, part)
    for ax in axes[::2]:
        ax.set_ylabel("RMSE / sd of the truth")
    figure.supxlabel("measurements, those of the initial design included", fontsize="medium")
    one_legend(figure, axes)
    return [save(figure, experiment.out / "errors.png")]


def _panel(ax: Axes, runs: pd.DataFrame) -> None:
    for name, part in runs.groupby("learner", sort=False):
        learner, errors = str(name), part.groupby("measurements")["nrmse"].median()
        if learner == "f_p":
            ax.axhline(errors.iloc[0], color="tab:red", lw=1.2, ls="--", label=LABELS[learner])
            continue
        color, label = COLORS[learner], LABELS[learner]
        draw_quartiles(ax, part, "nrmse", by="measurements", color=color, label=label)
        if learner == REFERENCE:
            ax.axhline(errors.iloc[-1], color=color, lw=1, ls=":", label="its final error")
    budget = runs["measurements"].max()
    ax.axvline(budget / 2, color="0.7", lw=1, ls="--", zorder=0, label="half the measurements")
    ax.set_yscale("log")
    ax.grid(axis="y", color="0.9", lw=0.6)
    ax.set_axisbelow(True)
