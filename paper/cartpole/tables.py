"""The tables of the runs that there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pandas as pd

from paper.cartpole import SCENARIOS, Settings
from paper.cartpole.claims import CLAIMS, TARGETS
from paper.common.claims import judge
from paper.common.curves import Curves
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, numbers
from paper.control import Control
from paper.control.tables import (
    cost_of_a_run,
    foresight,
    load_episodes,
    short_summary,
    summary,
    updates_table,
)

MEASURES = {"cost": "sampled", "evaluation": "deterministic"}
WINDOWS = ((1, 6), (13, 25), (41, 50))
_COMPARED = ((1, 6), (1, 25), (41, 50))
_SHORT = ("mf-best", "phy", "gp", "cka", "rra", "oracle")  # the learners of the main README
_SMOOTHED = 3


def tables(records: Sequence[Record], experiment: Control) -> dict[str, Table]:
    """All tables, by name."""
    episodes = load_episodes(records, experiment)
    last = experiment.settings.episodes
    of = {measure: Curves(episodes, measure) for measure in MEASURES}
    found = {"updates": Table("Updates", updates_table(experiment))}
    for name, kind, claims in (("claims", "claim", CLAIMS), ("targets", "target", TARGETS)):
        judged = {f"{MEASURES[m]} actions": judge(claims, of[m], last) for m in MEASURES}
        found[name] = Table(name.capitalize(), claims_table(kind, judged))
    for measure, actions in MEASURES.items():
        found[actions] = Table(f"Cost, {actions} actions", _costs(of[measure], experiment))
    labels = {name: SCENARIOS[name].label for name in _SHORT}
    short = short_summary(of["cost"], labels, _columns(of["cost"]), "mean cost", 0.5, "", 2)
    found["short"] = Table("Cost, sampled actions", short)
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
    above = curve.rolling(_SMOOTHED).mean().loc[_SMOOTHED:until] > threshold
    first = int(above.index[above].max()) + 1 if above.any() else _SMOOTHED
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


def _costs(curves: Curves, experiment: Control) -> str:
    settings = Settings()

    def holds(name: str) -> str:
        model_free = experiment.known[name].model is None
        until = settings.episodes if model_free else settings.last_model_episode
        first = holds_from(curves.mean(name), 0.5, until)
        return "never" if first is None else f"{first}"

    return summary(
        experiment,
        curves,
        _columns(curves),
        end=WINDOWS[-1],
        windows=_COMPARED,
        thresholds=(0.5, 0.4),
        digits=2,
        texts={"holds 0.5 from": holds},
    )
