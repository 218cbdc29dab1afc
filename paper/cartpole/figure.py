"""The figures of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.control import Control
from paper.control.tables import load_episodes

FLOOR = 0.289  # python -m paper floor
FLOOR_LABEL = "best open loop found from the mean start"
COLORS = {
    "mf": "0.55",
    "mf-best": "0.55",
    "phy": "tab:orange",
    "gp": "tab:red",
    "gp-paper": "tab:red",
    "cka": "navy",
    "rra": "tab:green",
    "rra-paper": "tab:green",
    "oracle": "black",
}
PANELS = {
    "In the paper's form; CKA in ours": ("mf", "phy", "gp-paper", "cka", "rra-paper"),
    "In our form": ("mf-best", "phy", "gp", "cka", "rra", "oracle"),
}


def draw(records: Sequence[Record], experiment: Control) -> list[Path]:
    """Draw the cost of sampled actions over the episodes, learners over each other."""
    episodes, until = load_episodes(records, experiment), experiment.settings.last_model_episode
    figure, axes = panels([*PANELS], 2, (6, 4.2))
    for ax, names in zip(axes, PANELS.values(), strict=True):
        for name in names:
            _learner(ax, episodes[episodes["scenario"] == name], name, experiment.labels[name])
        ax.axhline(FLOOR, color="tab:brown", lw=1, ls="--", label=FLOOR_LABEL)
        ax.axvline(until + 0.5, color="0.5", lw=0.8, ls=":", label="the model's last trial")
        ax.set_ylim(0.15, 1.02)
    figure.supxlabel("trial", fontsize="medium")
    figure.supylabel("cost, median and quartiles", fontsize="medium")
    one_legend(figure, axes, ncols=4)
    return [save(figure, experiment.out / "curves.png")]


def _learner(ax: Axes, own: pd.DataFrame, name: str, label: str) -> None:
    if len(own):
        draw_quartiles(ax, own, "cost", color=COLORS[name], label=label)
