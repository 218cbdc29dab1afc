"""Figures of the runs that there are."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper.cartpole.results import MEASURES, PARTS, iqm, tabulate_time, window
from paper.cartpole.scenarios import SCENARIOS

FLOOR = 0.315
FLOOR_LABEL = "best open loop, known system (feedback can be lower)"
BACKDROP = "oracle"  # in every panel, for comparison
_COLUMNS = 5
_DPI = {"savefig.dpi": 110}


def draw_curves(trials: pd.DataFrame, model_until: int, path: Path) -> None:
    """Draw the cost over the trials, mean and standard deviation, a panel for each scenario.

    A deterministic policy is evaluated after the updates that follow a trial, and so is drawn at
    the next one, the first that is made with what it has learnt.
    """
    names = list(trials["scenario"].unique())
    columns = min(_COLUMNS, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(2.8 * columns, 2.5 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    backdrop = trials[trials["scenario"] == BACKDROP].groupby("trial")["cost"].mean()
    for ax, name in zip(axes.flat, names, strict=False):
        _curve_panel(ax, trials[trials["scenario"] == name], SCENARIOS[name].label)
        if name != BACKDROP and len(backdrop):
            label = f"{SCENARIOS[BACKDROP].label}, sampled, mean"
            ax.plot(backdrop.index, backdrop, color="0.55", lw=1.2, label=label, zorder=1.5)
        ax.axhline(FLOOR, color="tab:green", lw=1, ls="--", label=FLOOR_LABEL)
        if SCENARIOS[name].dynamics is not None:
            label = "the model's last trial"
            ax.axvline(model_until + 0.5, color="0.5", lw=0.8, ls=":", label=label)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax in axes.flat[max(0, len(names) - columns) : len(names)]:
        ax.tick_params(labelbottom=True)
    axes[0, 0].set_ylim(0.15, 1.02)
    figure.supxlabel("trial")
    figure.supylabel("mean cost of a trial")
    # Not every panel has all lines.
    handles = {
        label: handle
        for ax in axes.flat[: len(names)]
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=3)
    with mpl.rc_context(_DPI):
        figure.savefig(path)


def _curve_panel(ax: Axes, trials: pd.DataFrame, label: str) -> None:
    by_trial = trials.groupby("trial")
    mean, sd = by_trial["cost"].mean(), by_trial["cost"].std().fillna(0)
    ax.fill_between(
        mean.index, mean - sd, mean + sd, color="navy", alpha=0.15, lw=0, label="sampled, sd"
    )
    ax.plot(mean.index, mean, color="navy", lw=1.4, label="sampled actions, mean of runs")
    evaluation = by_trial["evaluation"].mean()
    label = "deterministic, mean of runs"
    ax.plot(evaluation.index + 1, evaluation, color="tab:red", lw=1, label=label)
    ax.set_title(f"{label} ({trials['seed'].nunique()})", loc="left", fontsize=10)


def draw_iqm(trials: pd.DataFrame, windows: tuple[tuple[int, int], ...], path: Path) -> None:
    """Draw interquartile means over runs with 95 % bootstrap intervals, for some trials.

    Too few runs for an interval have a dot alone.
    """
    names = list(trials["scenario"].unique())
    figure = Figure(figsize=(11, 0.32 * len(names) + 1.6), layout="constrained")
    axes = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    for ax, (first, last) in zip(axes, windows, strict=True):
        for shift, color, (measure, label) in zip(
            (-0.14, 0.14), ("navy", "tab:red"), MEASURES.items(), strict=True
        ):
            scores = {n: window(trials, n, measure, first, last).to_numpy() for n in names}
            scores = {name: values for name, values in scores.items() if len(values)}
            if not scores:
                continue
            points, intervals = iqm(scores)
            at = np.array([names.index(name) for name in scores]) + shift
            middle = np.array([points[name] for name in scores])
            low, high = np.stack([intervals[name] for name in scores]).T
            ax.errorbar(
                middle, at, xerr=[middle - low, high - middle], fmt="o", ms=4, capsize=3,
                color=color, label=f"{label} actions",
            )  # fmt: skip
        ax.axvline(FLOOR, color="tab:green", lw=1, ls="--", label=FLOOR_LABEL)
        ax.set_title(f"trials {first}-{last}", loc="left")
        ax.set_xlabel("IQM of the cost, 95 % interval")
        ax.grid(axis="y", alpha=0.3)
    runs = trials.groupby("scenario")["seed"].nunique()
    labels = [f"{SCENARIOS[name].label} ({runs[name]})" for name in names]
    axes[0].set_yticks(range(len(names)), labels)
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    with mpl.rc_context(_DPI):
        figure.savefig(path)


def draw_time(trials: pd.DataFrame, path: Path) -> None:
    """Draw what the seconds of a run are spent on."""
    table = tabulate_time(trials)
    labels = [SCENARIOS[name].label for name in table["scenario"]]
    figure = Figure(figsize=(8, 0.3 * len(labels) + 1.4), layout="constrained")
    ax = figure.subplots()
    left = np.zeros(len(table))
    described = {
        "fit": "fits of the model",
        "rollout": "steps in the model",
        "sac": "SAC's updates",
    }
    for part, color in zip(PARTS, ("tab:orange", "tab:green", "navy"), strict=True):
        seconds = table[f"{part}_seconds"].to_numpy()
        ax.barh(labels, seconds, left=left, color=color, label=described[part])
        left += seconds
    ax.invert_yaxis()
    ax.set_xlim(left=0)
    ax.set_xlabel("seconds of a run of all trials, mean")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    with mpl.rc_context(_DPI):
        figure.savefig(path)
