"""Figures of a record of a machine, of its identification, and of what its equations lack.

They need matplotlib, ``pip install gpadjust[plot]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import torch

from gpadjust.checks import checked_half_width
from gpadjust.dynamics.plots import going_on, labels, plot_free_run
from gpadjust.records.identification import IDENTIFIED, Identification
from gpadjust.records.lack import Lack
from gpadjust.records.records import Record, Records
from gpadjust.states import StateSpec
from gpadjust.validation.plots import BLUE, DOTS, GREY, given_axes, legend, tidy

__all__ = ["plot_identification", "plot_lack", "plot_record"]


def plot_record(
    record: Record,
    spec: StateSpec,
    *,
    units: Mapping[str, str] | None = None,
    axes: Any = None,
) -> Any:
    """Draw a record over time, a panel for each state and each action.

    Lines end where a stretch does: gaps are grey, and a dotted line is where a segment begins.
    Segments whose clock starts again lie over each other. Dots are rows without neighbours. Angles
    go on without jumps, from within half a turn at the beginning of a stretch.

    Args:
        record: The record.
        spec: The entries of its states and actions.
        units: Units for the labels, by the names of states and actions and ``"time"``, such as
            ``{"omega": "rad/s"}``. Default: rad of angles, and s.
        axes: As many axes as states and actions. Default: a new figure.

    Returns:
        An array of these axes; ``axes[0].figure`` is the figure.

    Raises:
        TypeError: If ``record`` is not a :class:`Record`, or ``spec`` not a :class:`StateSpec`.
        ValueError: If the record does not have the columns of the spec, a unit is of an unknown
            name, or the number of ``axes`` is another one.
    """
    Records([record], spec)  # checks types and columns
    names = [*spec.states, *spec.actions]
    stretches = record.stretches()
    called = labels(spec, units)
    if axes is None:
        figure = plt.figure(figsize=(7, 1.4 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)
    axes = given_axes(axes, (len(names),))
    values = torch.cat([record.states, record.actions], -1)
    for i, (name, ax) in enumerate(zip(names, axes, strict=True)):
        style = "default" if i < spec.state_dim else "steps-post"
        for rows in stretches:
            times = record.times[rows]
            line = going_on(values[rows, i], i in spec.angle_columns)
            ax.plot(times, line, color=BLUE, lw=1.1, drawstyle=style)
            is_number = torch.nn.functional.pad(~line.isnan(), (1, 1))
            alone = is_number[1:-1] & ~is_number[:-2] & ~is_number[2:]
            if alone.any():
                ax.plot(times[alone], line[alone], ".", color=BLUE, ms=3)
        for before, after in pairwise(stretches):
            end, start = (float(record.times[k]) for k in (before.stop - 1, after.start))
            if end < start:
                ax.axvspan(end, start, color=GREY, alpha=0.2, lw=0)
            if record.segments[before.start] != record.segments[after.start]:
                ax.axvline(start, color=GREY, lw=0.8, ls=":")
        ax.set(ylabel=called[name])
        tidy(ax)
    axes[-1].set(xlabel=called["time"])
    axes[0].figure.align_ylabels(list(axes))
    return axes


def plot_identification(identification: Identification, **options: Any) -> Any:
    """Draw the free runs that judge an identification, beside the measurements.

    Options and axes are those of :func:`~gpadjust.dynamics.plots.plot_free_run`.
    """
    others = {**identification.runs}
    run = others.pop(IDENTIFIED)
    defaults: dict[str, Any] = {"others": others, "step": identification.step}
    return plot_free_run(run, identification.windows, **defaults | options)


def plot_lack(lack: Lack, *, units: Mapping[str, str] | None = None, ax: Any = None) -> Any:
    """Draw the residual of an equation over what it depends on, with its means in bins.

    Args:
        lack: What the equations lack, as of :attr:`Identification.lack`.
        units: Units for the labels, as of :func:`plot_record`.
        ax: Axes to draw on. Default: a new figure.

    Returns:
        The axes.
    """
    spec = lack.spec
    called = labels(spec, units)
    units = {**dict.fromkeys(spec.angles, "rad"), **(units or {})}
    unit, time = units.get(lack.state, ""), units.get("time", "s")
    rate = f"{unit}²" if unit.endswith(f"/{time}") else f"{unit or 1}/{time}"
    if ax is None:
        ax = plt.figure(figsize=(5, 3), layout="constrained").subplots()
    half = checked_half_width(0.95) * lack.sd
    ax.plot(lack.at, lack.residual, **{**DOTS, "ms": 3, "color": "0.7"}, label="each step")
    ax.axhline(0.0, color=GREY, lw=1, ls="--")
    bars: dict[str, Any] = {"color": BLUE, "fmt": "o-", "ms": 4, "lw": 1.3, "capsize": 2}
    ax.errorbar(lack.middles, lack.means, half, **bars, label="mean, 95 %")
    ends = lack.residual.quantile(lack.residual.new_tensor([0.02, 0.98]))
    low, high = torch.cat([ends, lack.means - half, lack.means + half]).aminmax()
    room = 0.1 * float(high - low)
    ax.set_ylim(min(float(low), 0.0) - room, max(float(high), 0.0) + room)
    over = called[lack.over]
    if lack.lag is not None:
        over = f"{lack.over}, {lack.lag:.2g} late, less {lack.over}"
    ax.set(xlabel=over, ylabel=f"{lack.state}' lacks, in {rate}")
    legend(ax)
    return ax
