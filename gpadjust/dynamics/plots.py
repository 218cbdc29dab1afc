"""Figures of free runs beside what was measured.

Each function draws on the axes that it is given, or on those of a new figure, and returns them;
show or save the figure with ``axes.flat[0].figure``. They need matplotlib,
``pip install gpadjust[plot]``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from torch import Tensor

from gpadjust.dynamics.free_run import FreeRun
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
        An array of these axes.

    Raises:
        TypeError: If a run is no :class:`FreeRun`, or ``windows`` are no :class:`Windows`.
        ValueError: If runs are not of these windows, a name is unknown, there is no such window, or
            the number of ``axes`` is another one.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec, Trajectories
        >>> spec = StateSpec(["x"], ["v"])
        >>> times = 0.1 * torch.arange(41, dtype=torch.float64).unsqueeze(-1)
        >>> x, v = times.sin(), times.cos()
        >>> windows = Trajectories(x[:-1], v[:-1], x[1:], torch.zeros(40)).windows(20)
        >>> dynamics = PhysicsDynamics(spec, physics=lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> run = dynamics.free_run(windows.initial_states, windows.actions)
        >>> plot_free_run(run, windows, step=0.1, units={"x": "m"}).shape
        (1, 2)
    """
    others = dict(others or {})
    _check_runs({"run": run, **others}, windows)
    spec, num_windows = run.spec, len(run.mean)
    if rows is None:
        rows = torch.linspace(0, num_windows - 1, min(num_windows, _SHOWN)).round().int().tolist()
    if not len(rows) or any(row not in range(-num_windows, num_windows) for row in rows):
        raise ValueError(
            f"Expected rows as numbers of windows from 0 to {num_windows - 1}, got {rows!r}."
        )
    names = [spec.states[i] for i in spec.moving] if states is None else list(states)
    check_names("states", names, spec.states)
    called, step = labels(spec, units), spec.step if step is None else step
    grid = axes_of(axes, len(names), len(rows), 2.5)
    times = (1 if step is None else step) * np.arange(run.mean.shape[1] + 1)
    for name, line in zip(names, grid, strict=True):
        i = spec.states.index(name)
        for row, ax in zip(rows, line, strict=True):
            _draw_free_run(ax, times, run, windows, others, (int(row), i))
        line[0].set(ylabel=called[name])
    for ax in grid[-1]:
        ax.set(xlabel="steps" if step is None else called["time"])
    if axes is None:
        handles, texts = grid[0, 0].get_legend_handles_labels()
        where: dict[str, Any] = {"ncols": len(texts), "loc": "outside upper center"}
        grid[0, 0].figure.legend(handles, texts, frameon=False, **where)
    else:
        legend(grid[0, 0])
    return grid


def _draw_free_run(
    ax: Axes,
    times: np.ndarray,
    run: FreeRun,
    windows: Windows,
    others: Mapping[str, FreeRun],
    at: tuple[int, int],
) -> None:
    """Draw one state of one window, ``at = (row, column)``."""
    (row, i), spec = at, run.spec
    recorded = windows.states[row, :, i]
    measured = going_on(recorded, i in spec.angle_columns)
    turns = recorded[:1] - measured[:1]

    def path(values: Tensor) -> Tensor:
        return torch.cat([recorded[:1], values[row, :, i]]) - turns

    low, high, mean = path(run.lower), path(run.upper), path(run.mean)
    # Where particles start is not known here: the interval is that from the first step on.
    ax.fill_between(times[1:], low[1:], high[1:], **BAND, label=f"{100 * run.level:g} %")
    ax.plot(times, mean, color=BLUE, lw=1.5, label="free run")
    for k, (label, other) in enumerate(others.items()):
        ax.plot(times, path(other.mean), "--", color=_OTHERS[k % len(_OTHERS)], lw=1.3, label=label)
    ax.plot(times, measured, "o", color="black", ms=3, label="measured")
    held = torch.cat([mean, measured[~measured.isnan()]])
    low, high = held.min(), held.max()
    if high > low:
        room = _ROOM * (high - low)
        ax.set_ylim(float(low - room), float(high + room))
    tidy(ax)


def _check_runs(runs: Mapping[str, FreeRun], windows: Windows) -> None:
    """Raise an error unless these are free runs of the windows."""
    if not isinstance(windows, Windows):
        raise TypeError(
            f"Expected windows as Windows, got {type(windows).__name__}; pass "
            "`records.windows(length)`, or `Windows(initial_states, actions, measured)`."
        )
    for name, run in runs.items():
        if not isinstance(run, FreeRun):
            raise TypeError(
                f"Expected {name} as a FreeRun, got {type(run).__name__}; pass "
                "`dynamics.free_run(windows.initial_states, windows.actions)`."
            )
        if run.mean.shape != windows.measured.shape:
            raise ValueError(
                f"Expected {name} of these windows, w x T x state_dim "
                f"{tuple(windows.measured.shape)}, got runs of shape {tuple(run.mean.shape)}; pass "
                "windows and runs of all of them, and choose by `rows`."
            )


def going_on(values: Tensor, is_angle: bool) -> Tensor:
    """One state over time, ``n`` with NaN; an angle without jumps, at first within half a turn."""
    values, known = values.clone(), ~values.isnan()
    if is_angle and known.any():
        path = torch.from_numpy(np.unwrap(values[known].numpy()))
        values[known] = path - 2 * math.pi * (path[0] / (2 * math.pi)).round()
    return values


def labels(spec: StateSpec, units: Mapping[str, str] | None) -> dict[str, str]:
    """Labels of axes, by the names of states and actions and "time"."""
    names = (*spec.states, *spec.actions, "time")
    units = {"time": "s", **dict.fromkeys(spec.angles, "rad"), **(units or {})}
    check_names("units", units, names)
    return {name: f"{name} in {units[name]}" if units.get(name) else name for name in names}


def check_names(argument: str, names: Any, known: Sequence[str]) -> None:
    """Raise a ValueError unless there are names, all of them known."""
    unknown = [name for name in names if name not in known]
    if unknown or not len(names):
        found = repr(unknown[0]) if unknown else "none"
        raise ValueError(f"Expected {argument} of {', '.join(known)}, found {found}.")
