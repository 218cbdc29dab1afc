"""The figures that control experiments share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper.control.curves import Curves
from paper.control.results import PARTS, iqm

_DPI = {"savefig.dpi": 110}
_COLORS = ("navy", "tab:red")


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file."""
    with mpl.rc_context(_DPI):
        figure.savefig(path)


def panels(
    records: pd.DataFrame, labels: Mapping[str, str], columns: int, size: tuple[float, float]
) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a panel for each scenario, its name and number of runs above it.

    Args:
        records: A row for each scenario, seed and trial.
        labels: The names of the scenarios.
        columns: Panels in a row.
        size: Of a panel, in inches.
    """
    runs = records.groupby("scenario", sort=False)["seed"].nunique()
    columns = min(columns, len(runs))
    rows = math.ceil(len(runs) / columns)
    width = max(9.0, size[0] * columns)  # as wide as the legend
    figure = Figure(figsize=(width, size[1] * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flatten()
    for ax in axes[len(runs) :]:
        ax.set_visible(False)
    for ax, (name, number) in zip(axes, runs.items(), strict=False):
        ax.set_title(f"{labels[str(name)]} ({number})", loc="left", fontsize=10)
        ax.tick_params(labelbottom=True)
    return figure, dict(zip(map(str, runs.index), axes, strict=False))


def draw_mean(ax: Axes, records: pd.DataFrame, measure: str, color: str, label: str) -> None:
    """Draw the mean over runs by trial, and a standard deviation to either side."""
    by_trial = records.groupby("trial")[measure]
    mean, sd = by_trial.mean(), by_trial.std().fillna(0)
    ax.fill_between(mean.index, mean - sd, mean + sd, color=color, alpha=0.14, lw=0)
    ax.plot(mean.index, mean, color=color, lw=1.4, label=f"{label}: mean, sd of runs")


def draw_backdrop(
    axes: Mapping[str, Axes], records: pd.DataFrame, name: str, measure: str, label: str
) -> None:
    """Draw the mean of a scenario into the panels of all others, for comparison."""
    mean = records[records["scenario"] == name].groupby("trial")[measure].mean()
    for other, ax in axes.items():
        if other != name and len(mean):
            ax.plot(mean.index, mean, color="0.55", lw=1.2, label=label, zorder=1.5)


def one_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """A legend above a figure, of the lines in any of its panels, of which not all have all."""
    handles = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=3)


def draw_iqm(
    trials: pd.DataFrame,
    labels: Mapping[str, str],
    measures: Mapping[str, str],
    windows: Mapping[tuple[int, int], str],
    line: tuple[float, str],
    unit: str,
    path: Path,
) -> None:
    """Draw interquartile means over runs with 95 % bootstrap intervals, for some trials.

    Too few runs for an interval have a dot alone.

    Args:
        trials: A row for each scenario, seed and trial.
        labels: The names of the scenarios.
        measures: Two columns, and what they are called.
        windows: First and last trial, and the title of their panel.
        line: A value to compare with, and what it is.
        unit: What the measures are.
        path: The file.
    """
    names = list(trials["scenario"].unique())
    figure = Figure(figsize=(11, 0.32 * len(names) + 1.6), layout="constrained")
    axes = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    for ax, ((first, last), title) in zip(axes, windows.items(), strict=True):
        for shift, color, (measure, label) in zip(
            (-0.14, 0.14), _COLORS, measures.items(), strict=True
        ):
            curves = Curves(trials, measure)
            scores = {n: curves.window(n, first, last).to_numpy() for n in names}
            scores = {name: values for name, values in scores.items() if len(values)}
            if not scores:
                continue
            points, intervals = iqm(scores)
            at = np.array([names.index(name) for name in scores]) + shift
            middle = np.array([points[name] for name in scores])
            low, high = np.stack([intervals[name] for name in scores]).T
            ax.errorbar(
                middle, at, xerr=[middle - low, high - middle], fmt="o", ms=4, capsize=3,
                color=color, label=label,
            )  # fmt: skip
        ax.axvline(line[0], color="tab:green", lw=1, ls="--", label=line[1])
        ax.set_title(title, loc="left")
        ax.grid(axis="y", alpha=0.3)
    runs = trials.groupby("scenario")["seed"].nunique()
    axes[0].set_yticks(range(len(names)), [f"{labels[name]} ({runs[name]})" for name in names])
    axes[0].invert_yaxis()
    figure.supxlabel(f"IQM of the {unit}, 95 % interval", fontsize="medium")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    save(figure, path)


def draw_time(table: pd.DataFrame, labels: Mapping[str, str], path: Path) -> None:
    """Draw what the seconds of a run are spent on.

    Args:
        table: A row for each scenario, with the median seconds of each part.
        labels: The names of the scenarios.
        path: The file.
    """
    described = {
        "fit": ("fits of the model", "tab:orange"),
        "rollout": ("steps in the model", "tab:green"),
        "sac": ("SAC's updates", "navy"),
        "evaluation": ("evaluations", "0.6"),
    }
    parts = [*PARTS, *(["evaluation"] if "evaluation_seconds" in table else [])]
    names = [labels[name] for name in table["scenario"]]
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
    save(figure, path)
