"""Tables and figure of the learners that swing up a cart-pole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from paper.cartpole import SCENARIOS, Control
from paper.cartpole.claims import CLAIMS
from paper.cartpole.control import foresight, load, summary
from paper.common.experiment import Run, Table
from paper.common.figures import curves as draw_curves
from paper.common.tables import claims_table
from paper.common.verdicts import Curves, judge

FLOOR = 0.289  # of the best open loop that was found
MEASURES = {"cost": "sampled", "evaluation": "deterministic"}
WINDOWS = ((1, 6), (13, 25), (41, 50))
_PANELS = {
    "In the paper's form; CKA in ours": ("mf", "phy", "gp-paper", "cka", "rra-paper"),
    "In our form": ("mf-best", "phy", "gp", "cka", "rra", "oracle"),
}


def tables(runs: Sequence[Run], experiment: Control) -> dict[str, Table]:
    """All tables, by name."""
    episodes = load(runs, "episodes", experiment)
    last = experiment.settings.episodes
    of = {measure: Curves(episodes, measure, by="scenario") for measure in MEASURES}
    judged = {f"{MEASURES[m]} actions": judge(CLAIMS, of[m], last) for m in MEASURES}
    found = {"claims": Table("Claims", claims_table("claim", judged))}
    for measure, actions in MEASURES.items():
        text = summary(
            of[measure],
            experiment.labels,
            _columns(of[measure]),
            windows=((1, 6), (1, 25), (41, 50)),
            thresholds=(0.5, 0.4),
            digits=2,
        )
        found[actions] = Table(f"Cost, {actions} actions", text)
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    return found


def _columns(curves: Curves) -> dict[str, Callable[[str], Any]]:
    """Mean costs."""

    def over(first: int, last: int) -> Callable[[str], float]:
        return lambda name: float(curves.mean(name).loc[first:last].mean())

    first, *others = WINDOWS
    return {
        "trials {}-{}".format(*first): over(*first),
        "at 6": lambda name: curves.mean_at(name, 6),
        **{"{}-{}".format(*window): over(*window) for window in others},
    }


def draw(runs: Sequence[Run], experiment: Control) -> list[Path]:
    """Draw the cost of sampled actions over the episodes, learners over each other."""
    episodes, until = load(runs, "episodes", experiment), experiment.settings.last_model_episode
    floor = {"color": "tab:brown", "lw": 1, "ls": "--", "label": "best open loop, mean start"}

    def finish(ax: Any, title: str, own: pd.DataFrame) -> None:
        ax.axhline(FLOOR, **floor)
        ax.axvline(until + 0.5, color="0.5", lw=0.8, ls=":", label="the model's last trial")
        ax.set_ylim(0.15, 1.02)

    return [
        draw_curves(
            experiment.out / "curves.png",
            {title: episodes[episodes["scenario"].isin(names)] for title, names in _PANELS.items()},
            "cost",
            {name: (SCENARIOS[name].label, SCENARIOS[name].color) for name in SCENARIOS},
            by="scenario",
            labels=("trial", "cost, median and quartiles"),
            size=(6, 4.2),
            finish=finish,
        )
    ]
