"""Figures of a record of a machine and of its identification.

They need matplotlib, ``pip install gpadjust[plot]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import torch

from gpadjust.dynamics.plots import going_on, labels, plot_free_run
from gpadjust.records.identification import IDENTIFIED, Identification
from gpadjust.records.records import Record, Records
from gpadjust.states import StateSpec
from gpadjust.validation.plots import BLUE, GREY, given_axes, tidy

__all__ = ["plot_identification", "plot_record"]


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
        TypeError: If ``record`` is no :class:`Record`, or ``spec`` no :class:`StateSpec`.
        ValueError: If the record has not the columns of the spec, a unit is of an unknown name,
            or the number of ``axes`` is another one.
    """
    Records([record], spec)  # checks types and columns
    names, stretches = [*spec.states, *spec.actions], record.stretches()
    called = labels(spec, units)
    if axes is None:
        figure = plt.figure(figsize=(7, 1.4 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)
    axes, values = given_axes(axes, (len(names),)), torch.cat([record.states, record.actions], -1)
    for i, (name, ax) in enumerate(zip(names, axes, strict=True)):
        style = "default" if i < spec.state_dim else "steps-post"
        for rows in stretches:
            times, line = record.times[rows], going_on(values[rows, i], i in spec.angle_columns)
            ax.plot(times, line, color=BLUE, lw=1.1, drawstyle=style)
            known = torch.nn.functional.pad(~line.isnan(), (1, 1))
            if (alone := known[1:-1] & ~known[:-2] & ~known[2:]).any():
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
    run, step = others.pop(IDENTIFIED), identification.step
    defaults: dict[str, Any] = {"others": others, "step": step}
    return plot_free_run(run, identification.windows, **defaults | options)
