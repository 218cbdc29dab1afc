"""Figures of free runs beside what was measured.

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

_OTHERS = (RED, "#009E73", "#CC79A7")  # told apart by the colour-blind, too
_SHOWN = 3  # windows, unless they are chosen
_ROOM = 0.35  # of the range that is measured, above it and below


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
    """Draw free runs with their intervals beside what was measured: a column for each window.

    Axes hold what was measured and the run's mean, with a third more; an interval that is wider,
    and others' means, leave them. Angles begin within half a turn, and go on without jumps.

    Args:
        run: Free runs of all the windows.
        windows: The windows, as of :meth:`Trajectories.windows`.
        rows: The numbers of those to draw. Default: three, evenly spread.
        states: The names of the states to draw, a row of panels each. Default: all that move.
        others: Free runs of other dynamics, by what the legend calls them: their means are drawn.
        step: The time of a step. Default: that of the spec, and without one steps are counted.
        units: Units for the labels, as of :func:`gpadjust.records.plots.plot_record`.
        axes: ``len(states) x len(rows)`` axes. Default: a new figure.

    Returns:
        An array of these axes; show or save the figure with ``axes.flat[0].figure``.

    Raises:
        ValueError: If runs are not of these windows, a name is unknown, or the number of ``axes``
            is another one.
        IndexError: If there is no such window.
    """
    spec, shape, runs = run.spec, tuple(windows.measured.shape), {"free run": run, **(others or {})}
    for name, each in runs.items():
        if each.mean.shape != shape:
            raise ValueError(
                f"Expected {name} of these windows, w x T x state_dim {shape}, got runs of shape "
                f"{tuple(each.mean.shape)}; pass windows and runs of all of them, and choose by "
                "`rows`."
            )
    if rows is None:
        rows = np.linspace(0, shape[0] - 1, min(shape[0], _SHOWN)).round().astype(int).tolist()
    names = [spec.states[i] for i in spec.moving] if states is None else list(states)
    for name in names:
        check_choice("state", name, spec.states)
    called, step = labels(spec, units), spec.step if step is None else step
    grid = axes_of(axes, len(names), len(rows), 2.5)
    times = (1 if step is None else step) * np.arange(shape[1] + 1)
    for name, line in zip(names, grid, strict=True):
        i = spec.states.index(name)
        line[0].set(ylabel=called[name])
        for row, ax in zip(rows, line, strict=True):
            recorded = windows.states[row, :, i]
            measured = going_on(recorded, i in spec.angle_columns)
            low, high, *means = (
                torch.cat([measured[:1], values[row, :, i] - recorded[0] + measured[0]])
                for values in (run.lower, run.upper, *(each.mean for each in runs.values()))
            )
            # Where particles start is not known here: the interval is that from step 1 on.
            label = f"{100 * run.level:g} %"
            ax.fill_between(times[1:], low[1:], high[1:], **BAND, label=label)
            ax.plot(times, means[0], color=BLUE, lw=1.5, label="free run")
            for k, (label, mean) in enumerate(zip([*runs][1:], means[1:], strict=True)):
                ax.plot(times, mean, "--", color=_OTHERS[k % len(_OTHERS)], lw=1.3, label=label)
            ax.plot(times, measured, "o", color="black", ms=3, label="measured")
            shown = torch.cat([means[0], measured[~measured.isnan()]])
            room = float(_ROOM * (shown.max() - shown.min()))
            if room > 0:
                ax.set_ylim(float(shown.min()) - room, float(shown.max()) + room)
            tidy(ax)
    for ax in grid[-1]:
        ax.set(xlabel="steps" if step is None else called["time"])
    if axes is None:
        handles, texts = grid[0, 0].get_legend_handles_labels()
        where: dict[str, Any] = {
            "ncols": min(len(texts), 2 * len(rows)),
            "loc": "outside upper center",
        }
        grid[0, 0].figure.legend(handles, texts, frameon=False, **where)
    else:
        legend(grid[0, 0])
    return grid


def going_on(values: Tensor, is_angle: bool) -> Tensor:
    """Return a state over time, ``n`` with NaN; an angle without jumps, from within half a turn."""
    values, known = values.clone(), ~values.isnan()
    if is_angle and known.any():
        path = torch.from_numpy(np.unwrap(values[known].numpy()))
        values[known] = path - 2 * math.pi * (path[0] / (2 * math.pi)).round()
    return values


def labels(spec: StateSpec, units: Mapping[str, str] | None) -> dict[str, str]:
    """Return labels of axes, by the names of states and actions and "time"."""
    names = (*spec.states, *spec.actions, "time")
    for name in units or {}:
        check_choice("name in units", name, names)
    units = {"time": "s", **dict.fromkeys(spec.angles, "rad"), **(units or {})}
    return {name: f"{name} in {units[name]}" if units.get(name) else name for name in names}
