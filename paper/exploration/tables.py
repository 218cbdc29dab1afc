"""The tables and the figure of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from paper.common.curves import Curves
from paper.common.experiment import Record, Table
from paper.common.figures import one_legend, save
from paper.common.tables import markdown, number, numbers
from paper.control import Control
from paper.control.tables import load_episodes, seconds_of_a_run
from paper.exploration import EXPLORERS, MODELS, REFERENCE

MEASURES = {
    "error": "error on swing-ups",
    "error_random": "error on random trials",
    "evaluation": "cost of the deterministic policy",
}
_DIGITS = {"error": 3, "error_random": 3, "evaluation": 2}
_SHOWN = (1, 2, 4, 6, 10, 15)  # episodes
_WINDOWS = ((2, 6), (7, 15))  # over which the learners are compared
_COLORS = {"random": "0.55", "sac": "navy", "info": "tab:red", "info-3": "tab:orange"}


def load(records: Sequence[Record], experiment: Control) -> pd.DataFrame:
    """A row for each scenario, seed and episode (from 1)."""
    episodes = load_episodes(records, experiment)
    plan = episodes.get("plan_seconds", pd.Series(0.0, episodes.index))
    return episodes.assign(plan_seconds=plan.fillna(0.0))


def tables(records: Sequence[Record], experiment: Control) -> dict[str, Table]:
    """All tables, by the names of their markers."""
    episodes = load(records, experiment)
    found = {
        name: Table(f"Mean {label}, after trials", _means(episodes, name, experiment))
        for name, label in MEASURES.items()
    }
    seconds = seconds_of_a_run(episodes, ("plan", "fit", "rollout", "update", "cpu"))
    header = ["of a run", "plans, s", "fits, s", "model steps, s", "updates, s", "CPU, s"]
    text = numbers(seconds.rename(index=experiment.labels), header, ".0f")
    found["seconds"] = Table("Median seconds", text)
    return {f"exploration:{name}": table for name, table in found.items()}


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


def draw(records: Sequence[Record], experiment: Control, path: Path) -> Path:
    """Draw each measure after each episode, mean and standard error: a row of panels for a model."""
    episodes = load(records, experiment)
    there_are = set(episodes["scenario"].str.partition("-")[0])
    models = {name: label for name, (label, _) in MODELS.items() if name in there_are}
    figure = Figure(figsize=(11, 2.6 * len(models) + 0.8), layout="constrained")
    axes = figure.subplots(len(models), len(MEASURES), sharex=True, sharey="col", squeeze=False)
    for row, (model, model_label) in zip(axes, models.items(), strict=True):
        for ax, (measure, label) in zip(row, MEASURES.items(), strict=True):
            for explorer, (explorer_label, _) in EXPLORERS.items():
                own = episodes[episodes["scenario"] == f"{model}-{explorer}"]
                if own.empty:
                    continue
                by_episode = own.groupby("episode")[measure]
                mean, error = by_episode.mean(), by_episode.sem().fillna(0)
                color, low, high = _COLORS[explorer], mean - error, mean + error
                ax.fill_between(mean.index, low, high, color=color, alpha=0.2, lw=0)
                ax.plot(mean.index, mean, color=color, lw=1.4, label=explorer_label)
            if measure != "evaluation":
                ax.set_yscale("log")
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            ax.set_title(f"{model_label}: {label}", loc="left", fontsize=10)
    figure.supxlabel("real trials", fontsize="medium")
    one_legend(figure, axes.flatten())
    return save(figure, path)
