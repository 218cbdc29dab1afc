"""Curves and maps of the runs that there are."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpadjust.envs import REAL_ARM, arm_targets, hand_position
from gpadjust.envs.arm_task import START_MEAN
from paper.arm.claims import MAP_TRIAL
from paper.arm.scenarios import SCENARIOS
from paper.control.figure import one_legend, save

BOUND = 4.3  # cm, all steps: a feedback policy trained on the true system
BOUND_LABEL = "policy trained on the true system, all steps"
HELD = 34.0  # cm, all steps
BACKDROP = "mf"  # in every panel, for comparison
_COLUMNS = 4
_WORST = 30.0  # cm, the end of the colours


def draw_curves(evaluations: pd.DataFrame, path: Path) -> None:
    """Draw the hand's error over the trials, mean and standard deviation of each scenario."""
    names = list(evaluations["scenario"].unique())
    figure, axes = _panels(names, 2.9, 2.5)
    backdrop = evaluations[evaluations["scenario"] == BACKDROP].groupby("trial")["all_steps"].mean()
    for ax, name in zip(axes, names, strict=True):
        own = evaluations[evaluations["scenario"] == name]
        by_trial = own.groupby("trial")
        for measure, color, label in (
            ("all_steps", "navy", "all steps"),
            ("last_five", "tab:red", "last five"),
        ):
            mean, sd = by_trial[measure].mean(), by_trial[measure].std().fillna(0)
            low, high = mean - sd, mean + sd
            ax.fill_between(mean.index, low, high, color=color, alpha=0.13, lw=0)
            label = f"{label}: mean, sd of runs"
            ax.plot(mean.index, mean, color=color, lw=1.4, marker=".", ms=4, label=label)
        if name != BACKDROP and len(backdrop):
            label = f"{SCENARIOS[BACKDROP].label}, all steps"
            ax.plot(backdrop.index, backdrop, color="0.55", lw=1.2, label=label, zorder=1.5)
        ax.axhline(HELD, color="0.5", lw=0.8, ls=":", label="start pose held, all steps")
        ax.axhline(BOUND, color="tab:green", lw=1, ls="--", label=BOUND_LABEL)
        ax.set_title(f"{SCENARIOS[name].label} ({own['seed'].nunique()})", loc="left", fontsize=10)
        ax.tick_params(labelbottom=True)
    axes[0].set_ylim(0, 40)
    figure.supxlabel("trial")
    figure.supylabel("hand's RMSE over targets, cm")
    one_legend(figure, axes)
    save(figure, path)


def draw_map(maps: pd.DataFrame, path: Path) -> None:
    """Draw the error at each target after trial 9: colour for the mean, size for its spread."""
    maps = maps[maps["trial"] == MAP_TRIAL]
    names = list(maps["scenario"].unique())
    figure, axes = _panels(names, 2.9, 2.0)
    targets = 100 * hand_position(arm_targets()).numpy()
    dots = None
    for ax, name in zip(axes, names, strict=True):
        own = maps[maps["scenario"] == name]
        by_target = own.groupby("target")["all_steps"]
        mean, sd = by_target.mean().to_numpy(), by_target.std().fillna(0).to_numpy()
        _draw_arm(ax)
        dots = ax.scatter(
            targets[:, 0],
            targets[:, 1],
            c=mean,
            s=6 + 6 * sd,
            cmap="viridis_r",
            vmin=0,
            vmax=_WORST,
            zorder=2,
        )
        ax.set_title(f"{SCENARIOS[name].label} ({own['seed'].nunique()})", loc="left", fontsize=10)
        ax.set_aspect("equal")
        ax.tick_params(labelbottom=True)
    figure.supxlabel("along the upper arm at 0°, cm")
    figure.supylabel("across, cm")
    if dots is not None:
        label = f"RMSE after trial {MAP_TRIAL}, cm"
        figure.colorbar(dots, ax=axes, label=label, shrink=0.9, extend="max")
        sizes = [
            axes[0].scatter([], [], s=6 + 6 * sd, color="0.4", label=f"sd of runs {sd} cm")
            for sd in (0, 5, 10)
        ]
        figure.legend(handles=sizes, loc="outside upper center", ncols=3)
    save(figure, path)


def _draw_arm(ax: Axes) -> None:
    """The arm where trials start."""
    upper = REAL_ARM.lengths[0]
    elbow = 100 * upper * np.array([math.cos(START_MEAN[0]), math.sin(START_MEAN[0])])
    hand = 100 * hand_position(arm_targets().new_tensor(START_MEAN)).numpy()
    ax.plot(*np.stack([[0, 0], elbow, hand]).T, color="0.7", lw=4, marker="o", ms=5, zorder=1)


def _panels(names: list[str], width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each name; sizes in inches."""
    number = max(1, len(names))
    columns = min(_COLUMNS, number)
    rows = math.ceil(number / columns)
    size = (max(9.0, width * columns), height * rows + 0.8)  # as wide as the legend
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    return figure, list(axes.flat[: len(names)])
