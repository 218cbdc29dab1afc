"""Tables and figure of the learners that swing up a cart-pole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from paper.cartpole import SCENARIOS, Control
from paper.cartpole.claims import CLAIMS, LAST, SERVES
from paper.cartpole.control import (
    cost_of_a_run,
    foresight,
    load,
    summary,
    updates_table,
)
from paper.common.experiment import Run, Table
from paper.common.figures import curves as draw_curves
from paper.common.tables import claims_table, numbers
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
    found = {"updates": Table("Updates", updates_table(experiment))}
    judged = {f"{MEASURES[m]} actions": judge(CLAIMS, of[m], last) for m in MEASURES}
    found["claims"] = Table("Claims", claims_table("claim", judged))
    for measure, actions in MEASURES.items():
        text = summary(
            of[measure],
            experiment.labels,
            _columns(of[measure]),
            end=WINDOWS[-1],
            windows=((1, 6), (1, 25), (41, 50)),
            thresholds=(0.5, 0.4),
            digits=2,
            texts={"holds 0.5 from": partial(_holds, of[measure], experiment)},
        )
        found[actions] = Table(f"Cost, {actions} actions", text)
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    parts = {
        "fit_seconds": "fits, s",
        "rollout_seconds": "model steps, s",
        "update_seconds": "updates, s",
        "total_seconds": "all, s",
        "updates": "updates",
    }
    times = cost_of_a_run(episodes).rename(index=experiment.labels)[list(parts)]
    found["time"] = Table("Seconds", numbers(times, ["of a run", *parts.values()], ".0f"))
    return found


def _holds(curves: Curves, experiment: Control, name: str) -> str:
    model_free = experiment.known[name].kind == "none"
    first = holds_from(curves.mean(name), 0.5, LAST if model_free else SERVES)
    return "never" if first is None else f"{first}"


def holds_from(curve: pd.Series[float], threshold: float, until: int) -> int | None:
    """The first episode from which a curve's moving average stays at or below a threshold.

    Of an episode and the two before it, so that one lucky one does not count.

    Args:
        curve: A measure by episode.
        threshold: What it is not to exceed.
        until: The last episode that is looked at.

    Returns:
        The episode; None if there is none, or the curve ends before ``until``.
    """
    if until not in curve.index:
        return None
    above = curve.rolling(3).mean().loc[3:until] > threshold
    first = int(above.index[above].max()) + 1 if above.any() else 3
    return first if first <= until else None


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
