"""The figure of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from paper.common.curves import load_trials
from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.planning import LEARNERS, SYSTEMS, Planning

COLORS = {
    "cka": "navy",
    "phymean": "tab:purple",
    "phy": "tab:orange",
    "fitted": "tab:brown",
    "gp": "tab:red",
    "rra": "tab:green",
    "search": "tab:cyan",
    "oracle": "black",
}


def draw(records: Sequence[Record], experiment: Planning) -> list[Path]:
    """Draw the cost of the trials, models over each other, a panel for each system."""
    trials = load_trials(records)
    systems = [name for name in SYSTEMS if name in set(trials["system"])]
    figure, axes = panels([SYSTEMS[name] for name in systems], 2, (4.2, 3), width=8.4)
    for ax, system in zip(axes, systems, strict=True):
        for name, label in LEARNERS.items():
            own = trials[(trials["system"] == system) & (trials["scenario"] == name)]
            if len(own):
                draw_quartiles(ax, own, "cost", color=COLORS[name], label=label)
        ax.set_xticks(range(1, experiment.settings_of(system).trials + 1))
    figure.supxlabel("trial", fontsize="medium")
    figure.supylabel("cost, median and quartiles", fontsize="medium")
    one_legend(figure, axes, ncols=4)
    return [save(figure, experiment.out / "planning.png")]
