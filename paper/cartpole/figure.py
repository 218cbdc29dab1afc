"""The curves of the runs that there are."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper.cartpole.scenarios import SCENARIOS
from paper.control.figure import one_legend, save

FLOOR = 0.315
FLOOR_LABEL = "best open loop, known system (feedback can be lower)"
BACKDROP = "oracle"  # in every panel, for comparison
_COLUMNS = 5


def draw_curves(trials: pd.DataFrame, model_until: int, path: Path) -> None:
    """Draw the cost over the trials, mean and standard deviation, a panel for each scenario.

    A deterministic policy is evaluated after the updates that follow a trial, and so is drawn at
    the next one, the first that is made with what it has learnt.
    """
    names = list(trials["scenario"].unique())
    columns = min(_COLUMNS, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(2.8 * columns, 2.5 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    backdrop = trials[trials["scenario"] == BACKDROP].groupby("trial")["cost"].mean()
    for ax, name in zip(axes.flat, names, strict=False):
        _curve_panel(ax, trials[trials["scenario"] == name], SCENARIOS[name].label)
        if name != BACKDROP and len(backdrop):
            label = f"{SCENARIOS[BACKDROP].label}, sampled, mean"
            ax.plot(backdrop.index, backdrop, color="0.55", lw=1.2, label=label, zorder=1.5)
        ax.axhline(FLOOR, color="tab:green", lw=1, ls="--", label=FLOOR_LABEL)
        if SCENARIOS[name].dynamics is not None:
            label = "the model's last trial"
            ax.axvline(model_until + 0.5, color="0.5", lw=0.8, ls=":", label=label)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax in axes.flat[max(0, len(names) - columns) : len(names)]:
        ax.tick_params(labelbottom=True)
    axes[0, 0].set_ylim(0.15, 1.02)
    figure.supxlabel("trial")
    figure.supylabel("mean cost of a trial")
    one_legend(figure, list(axes.flat[: len(names)]))
    save(figure, path)


def _curve_panel(ax: Axes, trials: pd.DataFrame, title: str) -> None:
    by_trial = trials.groupby("trial")
    mean, sd = by_trial["cost"].mean(), by_trial["cost"].std().fillna(0)
    ax.fill_between(
        mean.index, mean - sd, mean + sd, color="navy", alpha=0.15, lw=0, label="sampled, sd"
    )
    ax.plot(mean.index, mean, color="navy", lw=1.4, label="sampled actions, mean of runs")
    evaluation = by_trial["evaluation"].mean()
    label = "deterministic, mean of runs"
    ax.plot(evaluation.index + 1, evaluation, color="tab:red", lw=1, label=label)
    ax.set_title(f"{title} ({trials['seed'].nunique()})", loc="left", fontsize=10)
