"""The curves of the runs that there are."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from paper.control.figure import one_legend, save
from paper.exploration.results import MEASURES
from paper.exploration.scenarios import EXPLORERS, MODELS, model_of

_COLORS = {"random": "0.55", "sac": "navy", "info": "tab:red", "info-3": "tab:orange"}


def draw_curves(trials: pd.DataFrame, path: Path) -> None:
    """Draw each measure after each trial, mean and standard error: a row of panels for a model."""
    there_are = set(trials["scenario"].map(model_of))
    models = {name: label for name, (label, _) in MODELS.items() if name in there_are}
    figure = Figure(figsize=(11, 2.6 * len(models) + 0.8), layout="constrained")
    axes = figure.subplots(len(models), len(MEASURES), sharex=True, sharey="col", squeeze=False)
    for row, (model, model_label) in zip(axes, models.items(), strict=True):
        for ax, (measure, label) in zip(row, MEASURES.items(), strict=True):
            for explorer, (explorer_label, *_) in EXPLORERS.items():
                own = trials[trials["scenario"] == f"{model}-{explorer}"]
                if own.empty:
                    continue
                by_trial = own.groupby("trial")[measure]
                mean, error = by_trial.mean(), by_trial.sem().fillna(0)
                color = _COLORS[explorer]
                low, high = mean - error, mean + error
                ax.fill_between(mean.index, low, high, color=color, alpha=0.2, lw=0)
                ax.plot(mean.index, mean, color=color, lw=1.4, label=explorer_label)
            if measure != "evaluation":
                ax.set_yscale("log")
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            ax.set_title(f"{model_label}: {label}", loc="left", fontsize=10)
    figure.supxlabel("real trials")
    one_legend(figure, axes.flatten())
    save(figure, path)
