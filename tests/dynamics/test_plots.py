"""Figures of free runs beside what was measured."""

import math

import matplotlib as mpl
import numpy as np
import pytest
import torch

from gpadjust.dynamics import PhysicsDynamics, StateSpec, Windows
from gpadjust.dynamics.plots import plot_free_run

mpl.use("Agg")
SPEC = StateSpec(["theta", "v"], ["u"], angles=["theta"])


def turns():
    """Four windows of an angle that turns at a rate of 7 v, from -pi to pi, and its free runs."""
    v = torch.linspace(0.5, 1, 4, dtype=torch.float64).unsqueeze(-1)
    angle = 3 + 0.7 * torch.arange(21).double() * v
    states = torch.stack([torch.atan2(angle.sin(), angle.cos()), v.expand_as(angle)], -1)
    start = states[:, 0] + torch.tensor([4 * math.pi, 0.0], dtype=torch.float64)
    windows = Windows(start, torch.zeros(4, 20, 1).double(), states[:, 1:])
    turn = PhysicsDynamics(SPEC, lambda X: torch.stack([X[:, 0] + 0.7 * X[:, 1], X[:, 1]], -1))
    run = turn.free_run(*windows[:2])
    return windows, run._replace(lower=run.mean - 0.3, upper=run.mean + 0.3)


def test_free_runs_lie_on_what_was_measured():
    windows, run = turns()
    windows.measured[3, 5:8, 0] = torch.nan
    axes = plot_free_run(run, windows, others={"slow": run._replace(mean=run.mean - 0.1)}, step=0.1)
    assert axes.shape == (2, 3)  # windows 0, 2 (of 1.5) and 3
    for ax, row in zip(axes[0], (0, 2, 3), strict=True):
        lines = {line.get_label(): line for line in ax.lines}
        times, measured = lines["measured"].get_data()
        np.testing.assert_allclose(times, 0.1 * np.arange(21))
        assert measured[0] == pytest.approx(3.0)
        known = ~np.isnan(measured)
        assert (~known).sum() == (3 if row == 3 else 0)
        mean = lines["free run"].get_ydata()
        np.testing.assert_allclose(mean[known], measured[known])
        np.testing.assert_allclose(lines["slow"].get_ydata()[1:], mean[1:] - 0.1)
        (band,) = ax.collections
        ends = band.get_paths()[0].vertices
        assert ends[:, 0].min() == pytest.approx(0.1)
        assert ends[:, 1].max() == pytest.approx(mean[-1] + 0.3)
        assert ax.get_ylim()[1] > mean[-1] + 0.3
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["theta in rad", "v"]
    assert axes[1, 0].get_xlabel() == "time in s"
    (legend,) = axes[0, 0].figure.legends
    assert [t.get_text() for t in legend.texts] == ["95 %", "free run", "slow", "measured"]
