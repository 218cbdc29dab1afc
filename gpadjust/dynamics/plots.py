"""Figures of free runs with measured states.

They need matplotlib, ``pip install gpadjust[plot]``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_choice
from gpadjust.dynamics.base import FreeRun
from gpadjust.dynamics.trajectories import Windows
from gpadjust.states import StateSpec
from gpadjust.validation.plots import BAND, BLUE, RED, axes_of, legend, tidy

__all__ = ["plot_free_run"]

_OTHERS = (RED, "#009E73", "#CC79A7")  # distinct for the colour-blind, too
_SHOWN = 3  # windows by default
_MARGIN = 0.35  # above and below, as a share of the measured range


def plot_free_run(
    run: FreeRun,
    windows: Windows,
    *,
    rows: Sequence[int] | None = None,
    states: Sequence[str] | None = None,
    others: Mapping[str, FreeRun] | None = None,
    step: float | None = None,
    units: Mapping[str, str] | None = None,
    axes: Any = None,
) -> Any:
    """Draw free runs with their intervals and measured states, a column for each window.

    The axes cover measured states and the mean of the run, with a margin of a third. A wider
    interval, and the means of others, may leave them. Angles begin within half a turn, and continue
    without jumps.

    Args:
        run: Free runs of all the windows.
        windows: The windows, as of :meth:`Trajectories.windows`.
        rows: The numbers of the windows to draw. Default: three, evenly spaced.
        states: The names of the states to draw, a row of panels each. Default: all that move.
        others: Free runs of other dynamics, by their names in the legend, of which the means are
            drawn.
        step: The time of a step. Default: the step of the spec; without one, numbers of steps.
        units: Units for the labels, as of :func:`gpadjust.records.plots.plot_record`.
        axes: ``len(states) x len(rows)`` axes. Default: a new figure.

    Returns:
        An array of the axes; show or save the figure with ``axes.flat[0].figure``.

    Raises:
        ValueError: If windows and runs do not agree, a name is unknown, or the number of ``axes``
            is wrong.
        IndexError: If a window does not exist.
    """
    spec = run.spec
    shape = tuple(windows.measured.shape)
    runs = {"free run": run, **(others or {})}
    for name, other in runs.items():
        if other.mean.shape != shape:
            raise ValueError(
                f"Expected {name} of these windows, w x T x state_dim {shape}, got runs of shape "
                f"{tuple(other.mean.shape)}; pass windows and runs of all of them, and choose by "
                "`rows`."
            )
    if rows is None:
        rows = np.linspace(0, shape[0] - 1, min(shape[0], _SHOWN)).round().astype(int).tolist()
    names = [spec.states[i] for i in spec.moving] if states is None else list(states)
    for name in names:
        check_choice("state", name, spec.states)
    step = step or spec.step
    axis_labels = labels(spec, units)
    grid = axes_of(axes, len(names), len(rows), 2.5)
    times = (step or 1) * np.arange(shape[1] + 1)
    for name, line in zip(names, grid, strict=True):
        i = spec.states.index(name)
        line[0].set(ylabel=axis_labels[name])
        for row, ax in zip(rows, line, strict=True):
            recorded = windows.states[row, :, i]
            measured = going_on(recorded, i in spec.angle_columns)
            # Runs and measurements of an angle begin in the same turn.
            low, high, *means = (
                torch.cat([measured[:1], values[row, :, i] - recorded[0] + measured[0]])
                for values in (run.lower, run.upper, *(other.mean for other in runs.values()))
            )
            # The interval begins at step 1: a run does not have its particles at the start.
            label = f"{100 * run.level:g} %"
            ax.fill_between(times[1:], low[1:], high[1:], **BAND, label=label)
            ax.plot(times, means[0], color=BLUE, lw=1.5, label="free run")
            for k, (label, mean) in enumerate(zip([*runs][1:], means[1:], strict=True)):
                ax.plot(times, mean, "--", color=_OTHERS[k % len(_OTHERS)], lw=1.3, label=label)
            # Below the lines, and some fifty of them, so that the run is seen.
            every = max(1, len(times) // 50)
            dots = {"color": "black", "ms": 3, "zorder": 1.5, "markevery": every}
            ax.plot(times, measured, "o", **dots, label="measured")
            shown = torch.cat([means[0], measured[~measured.isnan()]])
            margin = float(_MARGIN * (shown.max() - shown.min()))
            if margin > 0:
                ax.set_ylim(float(shown.min()) - margin, float(shown.max()) + margin)
            tidy(ax)
    for ax in grid[-1]:
        ax.set(xlabel=axis_labels["time"] if step else "steps")
    if axes is None:
        handles, texts = grid[0, 0].get_legend_handles_labels()
        place: Any = {"ncols": min(len(texts), 2 * len(rows)), "loc": "outside upper center"}
        grid[0, 0].figure.legend(handles, texts, frameon=False, **place)
    else:
        legend(grid[0, 0])
    return grid


def going_on(values: Tensor, is_angle: bool) -> Tensor:
    """Return a state over time, ``n`` with NaN; an angle without jumps, from within half a turn."""
    values = values.clone()
    is_measured = ~values.isnan()
    if is_angle and is_measured.any():
        path = torch.from_numpy(np.unwrap(values[is_measured].numpy()))
        values[is_measured] = path - 2 * math.pi * (path[0] / (2 * math.pi)).round()
    return values


def labels(spec: StateSpec, units: Mapping[str, str] | None) -> dict[str, str]:
    """Return labels of axes, by the names of states and actions and "time"."""
    names = (*spec.states, *spec.actions, "time")
    for name in units or {}:
        check_choice("name in units", name, names)
    units = {"time": "s", **dict.fromkeys(spec.angles, "rad"), **(units or {})}
    return {name: f"{name} in {units[name]}" if units.get(name) else name for name in names}
