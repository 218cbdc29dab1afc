"""The curves of the runs that there are."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from paper.cartpole.runs import CART_POLE
from paper.control.figure import draw_backdrop, draw_mean, one_legend, panels, save

FLOOR = 0.315
FLOOR_LABEL = "best open loop, known system (feedback can be lower)"
BACKDROP = "oracle"  # in every panel, for comparison


def draw_curves(trials: pd.DataFrame, model_until: int, path: Path) -> None:
    """Draw the cost over the trials, mean and standard deviation, a panel for each scenario.

    A deterministic policy is evaluated after the updates that follow a trial, and so is drawn at
    the next one, the first that is made with what it has learnt.
    """
    figure, axes = panels(trials, CART_POLE.labels, columns=5, size=(2.8, 2.5))
    label = f"{CART_POLE.labels[BACKDROP]}, sampled, mean"
    draw_backdrop(axes, trials, BACKDROP, "cost", label)
    for name, ax in axes.items():
        own = trials[trials["scenario"] == name]
        draw_mean(ax, own, "cost", "navy", "sampled actions")
        evaluation = own.groupby("trial")["evaluation"].mean()
        label = "deterministic, mean of runs"
        ax.plot(evaluation.index + 1, evaluation, color="tab:red", lw=1, label=label)
        ax.axhline(FLOOR, color="tab:green", lw=1, ls="--", label=FLOOR_LABEL)
        if CART_POLE.scenarios[name].dynamics is not None:
            label = "the model's last trial"
            ax.axvline(model_until + 0.5, color="0.5", lw=0.8, ls=":", label=label)
        ax.set_ylim(0.15, 1.02)
    figure.supxlabel("trial")
    figure.supylabel("mean cost of a trial")
    one_legend(figure, axes.values())
    save(figure, path)
