"""Curves and maps of the runs that there are."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from gpadjust.envs import REAL_ARM, arm_targets, hand_position
from gpadjust.envs.arm_task import START_MEAN
from paper.arm.runs import ARM
from paper.arm.scenarios import MAP_TRIAL
from paper.control.figure import draw_backdrop, draw_mean, one_legend, panels, save

BOUND = 4.3  # cm, all steps: a feedback policy trained on the true system
BOUND_LABEL = "policy trained on the true system, all steps"
HELD = 34.0  # cm, all steps
BACKDROP = "mf"  # in every panel, for comparison
_COLUMNS = 4
_LABELS = ARM.labels
_WORST = 30.0  # cm, the end of the colours
_WIDEST = 10  # cm, the end of the sizes


def draw_curves(evaluations: pd.DataFrame, path: Path) -> None:
    """Draw the hand's error over the trials, mean and standard deviation of each scenario."""
    figure, axes = panels(evaluations, _LABELS, _COLUMNS, (2.9, 2.5))
    draw_backdrop(axes, evaluations, BACKDROP, "all_steps", f"{_LABELS[BACKDROP]}, all steps")
    for name, ax in axes.items():
        own = evaluations[evaluations["scenario"] == name]
        draw_mean(ax, own, "all_steps", "navy", "all steps")
        draw_mean(ax, own, "last_five", "tab:red", "last five")
        ax.axhline(HELD, color="0.5", lw=0.8, ls=":", label="start pose held, all steps")
        ax.axhline(BOUND, color="tab:green", lw=1, ls="--", label=BOUND_LABEL)
        ax.set_ylim(0, 40)
    figure.supxlabel("trial")
    figure.supylabel("hand's RMSE over targets, cm")
    one_legend(figure, axes.values())
    save(figure, path)


def draw_map(maps: pd.DataFrame, path: Path) -> None:
    """Draw the error at each target after trial 9: colour for the mean, size for its spread."""
    maps = maps[maps["trial"] == MAP_TRIAL]
    if maps.empty:
        return
    figure, axes = panels(maps, _LABELS, _COLUMNS, (2.9, 2.0))
    targets = 100 * hand_position(arm_targets()).numpy()
    for name, ax in axes.items():
        own = maps[maps["scenario"] == name]
        by_target = own.groupby("target")["all_steps"]
        mean, sd = by_target.mean().to_numpy(), by_target.std().fillna(0).to_numpy()
        _draw_arm(ax)
        dots = ax.scatter(
            targets[:, 0],
            targets[:, 1],
            c=mean,
            s=6 + 6 * sd.clip(max=_WIDEST),
            cmap="viridis_r",
            vmin=0,
            vmax=_WORST,
            zorder=2,
        )
        ax.set_aspect("equal")
    figure.supxlabel("along the upper arm at 0°, cm")
    figure.supylabel("across, cm")
    label = f"RMSE after trial {MAP_TRIAL}, cm"
    figure.colorbar(dots, ax=[*axes.values()], label=label, shrink=0.9, extend="max")
    sizes = [
        ax.scatter([], [], s=6 + 6 * sd, color="0.4", label=f"sd of runs {sd} cm{more}")
        for sd, more in ((0, ""), (5, ""), (_WIDEST, " or more"))
    ]
    figure.legend(handles=sizes, loc="outside upper center", ncols=3)
    save(figure, path)


def _draw_arm(ax: Axes) -> None:
    """The arm where trials start."""
    upper = REAL_ARM.lengths[0]
    elbow = 100 * upper * np.array([math.cos(START_MEAN[0]), math.sin(START_MEAN[0])])
    hand = 100 * hand_position(arm_targets().new_tensor(START_MEAN)).numpy()
    ax.plot(*np.stack([[0, 0], elbow, hand]).T, color="0.7", lw=4, marker="o", ms=5, zorder=1)
