"""Curves and maps of the runs that there are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from gpadjust.systems.reaching import START_MEAN, arm_targets, hand_position
from gpadjust.systems.torque_arm import REAL_ARM
from paper.arm.claims import MAP_AFTER
from paper.arm.tables import MEASURES, load_evaluations, load_maps
from paper.common.experiment import Record
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.control import Control

BOUND = 4.1  # cm, all steps: python -m paper floor
BOUND_LABEL = "1,000 trials of SAC on the true arm, all steps"
HELD = 34.0  # cm, all steps
BACKDROP = "mf"  # in every panel, for comparison
_COLUMNS = 4
_WORST = 60  # cm, the end of the colours
_WIDEST = 10  # cm, the end of the sizes


def draw(records: Sequence[Record], experiment: Control) -> list[Path]:
    """Draw curves and maps; return their files."""
    maps = load_maps(records, experiment)
    maps = maps[maps["episode"] == MAP_AFTER]
    found = [_curves(load_evaluations(records, experiment), experiment)]
    return found if maps.empty else [*found, _map(maps, experiment)]


def _titles(rows: pd.DataFrame, experiment: Control) -> dict[str, str]:
    """The title of the panel of each scenario, with the number of its runs."""
    runs = rows.groupby("scenario", sort=False)["seed"].nunique()
    return {str(name): f"{experiment.labels[str(name)]} ({n})" for name, n in runs.items()}


def _curves(evaluations: pd.DataFrame, experiment: Control) -> Path:
    """The hand's error over the episodes, median and quartiles of each scenario."""
    titles = _titles(evaluations, experiment)
    figure, axes = panels([*titles.values()], _COLUMNS, (2.9, 2.5), width=9)
    backdrop = evaluations[evaluations["scenario"] == BACKDROP]
    for name, ax in zip(titles, axes, strict=True):
        own = evaluations[evaluations["scenario"] == name]
        if name != BACKDROP and len(backdrop):
            label = f"{experiment.labels[BACKDROP]}, all steps, median"
            draw_quartiles(ax, backdrop, "all_steps", color="0.55", label=label, band=False)
        for measure, color in (("last_five", "tab:red"), ("all_steps", "navy")):
            label = f"{MEASURES[measure]}: median, quartiles"
            draw_quartiles(ax, own, measure, color=color, label=label)
        ax.axhline(HELD, color="0.5", lw=0.8, ls=":", label="start pose held, all steps")
        ax.axhline(BOUND, color="tab:green", lw=1, ls="--", label=BOUND_LABEL)
        ax.set_ylim(bottom=0)
    figure.supxlabel("trial", fontsize="medium")
    figure.supylabel("hand's RMSE over targets, cm", fontsize="medium")
    one_legend(figure, axes)
    return save(figure, experiment.out / "curves.png")


def _map(maps: pd.DataFrame, experiment: Control) -> Path:
    """The error at each target after some episodes: colour for the mean, size for its spread."""
    titles = _titles(maps, experiment)
    figure, axes = panels([*titles.values()], _COLUMNS, (2.9, 2.0))
    targets = 100 * hand_position(arm_targets()).numpy()
    for name, ax in zip(titles, axes, strict=True):
        by_target = maps[maps["scenario"] == name].groupby("target")["all_steps"]
        mean, sd = by_target.mean().to_numpy(), by_target.std().fillna(0).to_numpy()
        draw_arm(ax)
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
    figure.supxlabel("along the upper arm at 0°, cm", fontsize="medium")
    figure.supylabel("across, cm", fontsize="medium")
    label = f"RMSE after trial {MAP_AFTER}, cm"
    figure.colorbar(dots, ax=axes, label=label, shrink=0.9, extend="max")
    sizes = [
        ax.scatter([], [], s=6 + 6 * sd, color="0.4", label=f"sd of runs {sd} cm{more}")
        for sd, more in ((0, ""), (5, ""), (_WIDEST, " or more"))
    ]
    figure.legend(handles=sizes, loc="outside upper center", ncols=3)
    return save(figure, experiment.out / "map.png")


def draw_arm(ax: Axes) -> None:
    """The arm where episodes start."""
    upper = REAL_ARM.lengths[0]
    elbow = 100 * upper * np.array([math.cos(START_MEAN[0]), math.sin(START_MEAN[0])])
    hand = 100 * hand_position(arm_targets().new_tensor(START_MEAN)).numpy()
    ax.plot(*np.stack([[0, 0], elbow, hand]).T, color="0.7", lw=4, marker="o", ms=5, zorder=1)
