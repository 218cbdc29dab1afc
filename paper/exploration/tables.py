"""The tables of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.curves import Curves
from paper.common.experiment import Record, Table
from paper.common.tables import markdown, number, numbers, settings_table
from paper.control import Control
from paper.control.tables import load_episodes, seconds_of_a_run
from paper.exploration import EXPLORERS, PLANS, REFERENCE

MEASURES = {
    "error": "error on swing-ups",
    "error_random": "error on random trials",
    "evaluation": "cost of the deterministic policy",
}
_DIGITS = {"error": 3, "error_random": 3, "evaluation": 2}
_SHOWN = (1, 2, 4, 6, 10, 15)  # episodes
_WINDOWS = ((2, 6), (7, 15))  # over which the learners are compared


def load(records: Sequence[Record], experiment: Control) -> pd.DataFrame:
    """A row for each scenario, seed and episode (from 1)."""
    episodes = load_episodes(records, experiment)
    plan = episodes.get("plan_seconds", pd.Series(0.0, episodes.index))
    return episodes.assign(plan_seconds=plan.fillna(0.0))


def tables(records: Sequence[Record], experiment: Control) -> dict[str, Table]:
    """All tables, by name."""
    episodes = load(records, experiment)
    found = {
        name: Table(f"Mean {label}, after trials", _means(episodes, name, experiment))
        for name, label in MEASURES.items()
    }
    seconds = seconds_of_a_run(episodes, ("plan", "fit", "rollout", "update", "cpu"))
    header = ["of a run", "plans, s", "fits, s", "model steps, s", "updates, s", "CPU, s"]
    text = numbers(seconds.rename(index=experiment.labels), header, ".0f")
    found["seconds"] = Table("Median seconds", text)
    plans = {name: getattr(experiment.settings, name) for name in PLANS[1:]}
    found["plans"] = Table("Plans", settings_table({"value": plans}))
    return found


def _means(episodes: pd.DataFrame, measure: str, experiment: Control) -> str:
    """Means over the runs, and differences to SAC's episodes with the same model and seeds."""
    curves, form = Curves(episodes, measure), f".{_DIGITS[measure]}f"
    header = ["", "runs", *(f"after trial {episode}" for episode in _SHOWN)]
    header += [f"{first}-{last}, less {EXPLORERS[REFERENCE][0]}" for first, last in _WINDOWS]
    rows = []
    for name in curves.names:
        reference = f"{name.partition('-')[0]}-{REFERENCE}"
        gaps = [curves.paired_difference(name, *window, reference) for window in _WINDOWS]
        cells = [number(curves.mean_at(name, episode), form) for episode in _SHOWN]
        cells += [gap.text(form) for gap in gaps]
        rows.append([experiment.labels[name], f"{len(curves.seeds(name))}", *cells])
    return markdown(header, rows)
