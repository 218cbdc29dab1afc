"""The figure of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from paper.common.experiment import Record
from paper.common.figures import one_legend, save
from paper.control import Control
from paper.exploration import EXPLORERS, MODELS
from paper.exploration.tables import MEASURES, load

_COLORS = {"random": "0.55", "sac": "navy", "info": "tab:red", "info-3": "tab:orange"}


def draw(records: Sequence[Record], experiment: Control) -> list[Path]:
    """Draw each measure after each episode, mean and standard error: a row for each model."""
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
    return [save(figure, experiment.out / "curves.png")]
