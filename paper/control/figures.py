"""The figures that control experiments share."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from paper.common.curves import Curves
from paper.common.figures import save
from paper.common.statistics import interquartile_mean
from paper.control.tables import PARTS

_COLORS = ("navy", "tab:red")


def draw_iqm(
    episodes: pd.DataFrame,
    labels: Mapping[str, str],
    measures: Mapping[str, str],
    windows: Mapping[tuple[int, int], str],
    line: tuple[float, str],
    unit: str,
    path: Path,
) -> Path:
    """Draw interquartile means over runs with 95 % bootstrap intervals, for some episodes.

    Too few runs for an interval have a dot alone.

    Args:
        episodes: A row for each scenario, seed and episode.
        labels: The names of the scenarios.
        measures: Two columns, and what they are called.
        windows: First and last episode, and the title of their panel.
        line: A value to compare with, and what it is.
        unit: What the measures are.
        path: The file.
    """
    names = list(episodes["scenario"].unique())
    figure = Figure(figsize=(11, 0.32 * len(names) + 1.6), layout="constrained")
    axes = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    for ax, ((first, last), title) in zip(axes, windows.items(), strict=True):
        for shift, color, (measure, label) in zip(
            (-0.14, 0.14), _COLORS, measures.items(), strict=True
        ):
            curves = Curves(episodes, measure)
            found = [interquartile_mean(curves.window(name, first, last)) for name in names]
            middle, low, high = np.array(found).T
            at = np.arange(len(names)) + shift
            ax.errorbar(
                middle, at, xerr=[middle - low, high - middle], fmt="o", ms=4, capsize=3,
                color=color, label=label,
            )  # fmt: skip
        ax.axvline(line[0], color="tab:green", lw=1, ls="--", label=line[1])
        ax.set_title(title, loc="left")
        ax.grid(axis="y", alpha=0.3)
    runs = episodes.groupby("scenario")["seed"].nunique()
    axes[0].set_yticks(range(len(names)), [f"{labels[name]} ({runs[name]})" for name in names])
    axes[0].invert_yaxis()
    figure.supxlabel(f"IQM of the {unit}, 95 % interval", fontsize="medium")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return save(figure, path)


def draw_time(table: pd.DataFrame, labels: Mapping[str, str], path: Path) -> Path:
    """Draw what the seconds of a run are spent on.

    Args:
        table: A row for each scenario, with the median seconds of each part.
        labels: The names of the scenarios.
        path: The file.
    """
    described = {
        "fit": ("fits of the model", "tab:orange"),
        "rollout": ("steps in the model", "tab:green"),
        "update": ("SAC's updates", "navy"),
        "evaluation": ("evaluations", "0.6"),
    }
    parts = [*PARTS, *(["evaluation"] if "evaluation_seconds" in table else [])]
    names = [labels[name] for name in table.index]
    figure = Figure(figsize=(8, 0.3 * len(names) + 1.4), layout="constrained")
    ax = figure.subplots()
    left = np.zeros(len(table))
    for part in parts:
        label, color = described[part]
        seconds = table[f"{part}_seconds"].to_numpy()
        ax.barh(names, seconds, left=left, color=color, label=label)
        left += seconds
    ax.invert_yaxis()
    ax.set_xlim(left=0)
    ax.set_xlabel("seconds of a run of all trials, median of the runs")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=len(parts))
    return save(figure, path)
