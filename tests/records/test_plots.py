"""Figures of records: gaps and segments."""

import math

import matplotlib as mpl
import numpy as np
import pytest
import torch

from gpadjust.records import Record
from gpadjust.records.plots import plot_record
from gpadjust.states import StateSpec

mpl.use("Agg")
SPEC = StateSpec(["theta", "v"], ["u"], angles=["theta"])


def turning(num_rows=31, first=7.0, **options):
    """A record of an angle that turns at a rate of 7, from -pi to pi, and v of which none is."""
    times = 0.1 * torch.arange(num_rows, dtype=torch.float64)
    angle = first + 7 * times
    states = torch.stack([torch.atan2(angle.sin(), angle.cos()), torch.full_like(times, torch.nan)])
    return Record(times, states.T, torch.ones(num_rows, 1).double(), **options)


def test_a_record_shows_its_gaps_and_segments():
    record = turning(segments=["a"] * 12 + ["b"] * 19)
    record.states[::3, 1] = 2.0
    rows = torch.tensor([i for i in range(31) if i not in (20, 21)])
    labels = [record.segments[i] for i in rows]
    record = Record(record.times[rows], record.states[rows], record.actions[rows], labels)
    axes = plot_record(record, SPEC, units={"u": "N m", "time": "min"})
    assert [ax.get_ylabel() for ax in axes] == ["theta in rad", "v", "u in N m"]
    assert axes[-1].get_xlabel() == "time in min"
    spans = [(p.get_x(), p.get_x() + p.get_width()) for p in axes[0].patches]
    np.testing.assert_allclose(spans, [(1.1, 1.2), (1.9, 2.2)])
    lines = [line for line in axes[0].lines if line.get_linestyle() != ":"]
    (edge,) = [line for line in axes[0].lines if line.get_linestyle() == ":"]
    assert list(edge.get_xdata()) == pytest.approx([1.2, 1.2])
    starts = [0, 1.2, 2.2]
    for line, start in zip(lines, starts, strict=True):
        path, times = line.get_ydata(), line.get_xdata()
        assert times[0] == pytest.approx(start)
        assert abs(path[0]) <= math.pi
        np.testing.assert_allclose(np.diff(path), 0.7)
    dots = [line for line in axes[1].lines if line.get_marker() == "."]
    assert sum(len(line.get_xdata()) for line in dots) == int((~record.states[:, 1].isnan()).sum())
    assert axes[2].lines[0].get_drawstyle() == "steps-post"
