"""Tables, curves and maps of learners that reach with an arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from gpadjust.systems.reaching import START_MEAN, arm_targets, hand_position
from gpadjust.systems.torque_arm import REAL_ARM
from paper.arm.claims import LAST, MAP_AFTER, claims, targets
from paper.cartpole import Control
from paper.cartpole.control import (
    cost_of_a_run,
    foresight,
    load,
    seconds_of_a_run,
    summary,
    updates_table,
)
from paper.common.experiment import Run, Table
from paper.common.figures import draw_quartiles, one_legend, panels, save
from paper.common.tables import claims_table, markdown, numbers
from paper.common.verdicts import Curves, judge

MEASURES = {"all_steps": "all steps", "last_five": "last five steps"}
WINDOWS = ((3, 9), (24, 30))
_SHOWN = (3, 6, 9, 12, 18, 24, 30)  # episodes


def load_maps(runs: Sequence[Run], experiment: Control) -> pd.DataFrame:
    """The errors in cm: a row for each scenario, seed, mapped episode and target."""
    frames = [
        pd.DataFrame(
            {
                **{"scenario": each["scenario"], "seed": each["seed"], "episode": int(episode)},
                **{"target": range(len(errors["all_steps"])), **errors},
            }
        )
        for name in experiment.known
        for each in runs
        if each["scenario"] == name
        for episode, errors in each["maps"].items()
    ]
    columns = ["scenario", "seed", "episode", "target", *MEASURES]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


def times(episodes: pd.DataFrame, evaluations: pd.DataFrame) -> pd.DataFrame:
    """The seconds of a run, evaluations included, and its updates."""
    table = cost_of_a_run(episodes)
    seconds = seconds_of_a_run(evaluations, ["evaluation"])["evaluation_seconds"]
    table.insert(3, "evaluation_seconds", seconds)
    table["total_seconds"] += seconds
    return table


def tables(runs: Sequence[Run], experiment: Control) -> dict[str, Table]:
    """All tables, by name."""
    episodes, maps = load(runs, "episodes", experiment), load_maps(runs, experiment)
    evaluations = load(runs, "evaluations", experiment)
    of = {measure: Curves(evaluations, measure, by="scenario") for measure in MEASURES}
    every, seconds = of["all_steps"], times(episodes, evaluations)
    found = {"updates": Table("Updates", updates_table(experiment))}
    about = claims(episodes, maps)
    judged = {MEASURES[m]: judge(about, of[m], LAST) for m in MEASURES}
    found["claims"] = Table("Claims", claims_table("claim", judged))
    judged = {"": judge(targets(seconds), every, LAST)}
    found["targets"] = Table("Targets, all steps", claims_table("target", judged))
    for name, measure in (("all", "all_steps"), ("last", "last_five")):
        hundred = Curves(evaluations, f"{measure}_100", by="scenario")
        columns: dict[str, Callable[[str], Any]] = {
            **{f"at {e}": partial(_at, of[measure], e) for e in _SHOWN},
            "sd of runs": partial(_spread, of[measure]),
            f"100 targets, at {LAST}": partial(_at, hundred, LAST),
        }
        text = summary(
            of[measure],
            experiment.labels,
            columns,
            end=(LAST, LAST),
            windows=WINDOWS,
            thresholds=(10, 8),
            digits=1,
        )
        found[name] = Table(f"Hand's error in cm, {MEASURES[measure]}", text)
    found["memory"] = Table("With and without the previous action, cm", _memory(every, experiment))
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    parts = {
        "fit_seconds": "fits, s",
        "rollout_seconds": "model steps, s",
        "update_seconds": "updates, s",
        "evaluation_seconds": "evaluations, s",
        "total_seconds": "sum, s",
        "cpu_seconds": "core's time, s",
        "updates": "updates",
    }
    rows = seconds.rename(index=experiment.labels)[list(parts)]
    found["time"] = Table("Seconds", numbers(rows, ["of a run", *parts.values()], ".0f"))
    return found


def _at(curves: Curves, episode: int, name: str) -> float:
    return curves.mean_at(name, episode)


def _spread(curves: Curves, name: str) -> float:
    """The standard deviation over runs, averaged over the evaluations from episode 3."""
    return float(curves.spread(name).loc[3:].mean())


def _memory(every: Curves, experiment: Control) -> str:
    """Errors with and without the previous action as an input, of the seeds that both have."""
    header, rows = ["", "runs"], []
    for first, last in WINDOWS:
        header += [f"{first}-{last} without", "with", "difference"]
    for name in experiment.known:
        remembering = f"{name}-memory"
        if not {name, remembering} <= set(every.names):
            continue
        curves = every.restricted(every.seeds(name) & every.seeds(remembering))
        cells = [experiment.labels[name], f"{len(curves.seeds(name))}"]
        for window in WINDOWS:
            cells += [f"{curves.window(n, *window).mean():.1f}" for n in (name, remembering)]
            gap = curves.paired_difference(remembering, *window, reference=name)
            cells.append(gap.text(".1f"))
        rows.append(cells)
    return markdown(header, rows)


BOUND = 4.1  # cm, all steps: python -m paper floor
BOUND_LABEL = "1,000 trials of SAC on the true arm, all steps"
HELD = 34.0  # cm, all steps
BACKDROP = "mf"  # in every panel, for comparison
_COLUMNS = 4
_WORST = 60  # cm, the end of the colours
_WIDEST = 10  # cm, the end of the sizes


def draw(runs: Sequence[Run], experiment: Control) -> list[Path]:
    """Draw curves and maps; return their files."""
    maps = load_maps(runs, experiment)
    maps = maps[maps["episode"] == MAP_AFTER]
    found = [_curves(load(runs, "evaluations", experiment), experiment)]
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
