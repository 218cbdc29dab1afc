"""Regrets over trials: a panel for each problem."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from paper.common.claims import counted
from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.optimisation import LABELS, Optimisation
from paper.optimisation.tables import regrets

COLORS = {"ax": "tab:orange", "cka": "tab:blue", "cka-few": "tab:green", "map": "tab:purple"}
TITLES = {"six_hump_camelback": "six-hump camelback", "reactor": "reactor, by-product limited"}


def draw(records: Sequence[Record], experiment: Optimisation) -> list[Path]:
    """Draw the median and the quartiles of the regret over the trials."""
    settings = experiment.settings
    runs = regrets(records, settings.trials)
    by_problem = {str(name): part for name, part in runs.groupby("problem", sort=False)}
    titles = [
        f"{TITLES.get(name, name)} ({counted(part['seed'].nunique())})"
        for name, part in by_problem.items()
    ]
    figure, axes = panels(titles, 3, (4, 3), share=False, width=8)
    for ax, part in zip(axes, by_problem.values(), strict=True):
        for name, own in part.groupby("learner", sort=False):
            # A regret is not followed below the threshold, at which a run ends.
            shown = own.assign(regret=own["regret"].clip(settings.regret, 2.0))
            learner = str(name)
            draw_quartiles(
                ax, shown, "regret", by="trial", color=COLORS[learner], label=LABELS[learner]
            )
        ax.axvline(settings.initial + 0.5, color="0.7", lw=1, ls="--", zorder=0)
        ax.set_yscale("log")
        ax.grid(axis="y", color="0.9", lw=0.6)
        ax.set_axisbelow(True)
    for ax in axes[::3]:
        ax.set_ylabel("regret")
    figure.supxlabel("trials; dashed: where Ax's initial design ends", fontsize="medium")
    one_legend(figure, axes)
    return [save(figure, experiment.out / "regrets.png")]
