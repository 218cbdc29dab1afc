"""The figures of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from paper.cartpole.tables import MEASURES, WINDOWS
from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.control import Control
from paper.control.figures import draw_iqm, draw_time
from paper.control.tables import cost_of_a_run, load_episodes

FLOOR = 0.294
FLOOR_LABEL = "best open loop found, known system (feedback can be lower)"
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
    "As the paper has them": ("mf", "phy", "gp-paper", "cka", "rra-paper"),
    "As we would do it": ("mf-best", "phy", "gp", "cka", "rra", "oracle"),
}


def draw(records: Sequence[Record], experiment: Control) -> list[Path]:
    """Draw all figures; return their files."""
    episodes, out, labels = load_episodes(records, experiment), experiment.out, experiment.labels
    return [
        _curves(episodes, experiment, out / "curves.png"),
        draw_iqm(
            episodes,
            labels,
            {measure: f"{label} actions" for measure, label in MEASURES.items()},
            {(first, last): f"trials {first}-{last}" for first, last in WINDOWS[1:]},
            (FLOOR, FLOOR_LABEL),
            "cost",
            out / "iqm.png",
        ),
        draw_time(cost_of_a_run(episodes), labels, out / "time.png"),
    ]


def _curves(episodes: pd.DataFrame, experiment: Control, path: Path) -> Path:
    """The cost of sampled actions over the episodes, learners over each other."""
    figure, axes = panels([*PANELS], 2, (6, 4.2))
    for ax, names in zip(axes, PANELS.values(), strict=True):
        for name in names:
            _learner(ax, episodes[episodes["scenario"] == name], name, experiment.labels[name])
        ax.axhline(FLOOR, color="tab:brown", lw=1, ls="--", label=FLOOR_LABEL)
        until = experiment.settings.last_model_episode + 0.5
        ax.axvline(until, color="0.5", lw=0.8, ls=":", label="the model's last trial")
        ax.set_ylim(0.15, 1.02)
    figure.supxlabel("trial", fontsize="medium")
    figure.supylabel("cost, median and quartiles", fontsize="medium")
    one_legend(figure, axes, ncols=4)
    return save(figure, path)


def _learner(ax: Axes, own: pd.DataFrame, name: str, label: str) -> None:
    if len(own):
        draw_quartiles(ax, own, "cost", color=COLORS[name], label=label)
