"""Figures: what is drawn is what was predicted."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from gpadjust.core import CKA, ZeroMeanGP
from gpadjust.kinds.links import LinkedCKA
from gpadjust.validation import leave_one_out, score
from gpadjust.validation.plots import (
    plot_adjustment,
    plot_coverage,
    plot_leave_one_out,
    plot_model,
    plot_prediction,
)
from tests import systems
from tests.systems import crude

mpl.use("Agg")
Z95 = 1.959963984540054


@pytest.fixture
def line(forrester):
    """A model of one input."""
    X, Y = forrester.data(0)
    return CKA(X, Y, physics=forrester.crude)


@pytest.fixture
def plane(data):
    """A model of two inputs and two outputs."""
    return CKA(*data(num_outputs=2), physics=crude)


@pytest.fixture(autouse=True)
def _leave_pyplot_alone():
    settings = dict(mpl.rcParams)
    yield
    assert dict(mpl.rcParams) == settings


def curve(ax, label):
    (line,) = [line for line in ax.lines if line.get_label() == label]
    return line


def is_drawn(ax, label, y):
    """Asserts that a curve has these values ``n x 1``."""
    np.testing.assert_allclose(curve(ax, label).get_ydata(), y.detach()[:, 0], atol=1e-9)


def band(ax, x):
    """Lower and upper edge of the first band at a position."""
    vertices = ax.collections[0].get_paths()[0].vertices
    edges = vertices[vertices[:, 0] == float(x), 1]
    return [edges.min(), edges.max()]


@pytest.mark.slow
def test_a_prediction_of_one_input(line, forrester):
    X = forrester.test_X.flip(0)
    ax = plot_prediction(line, X, forrester.truth(X))
    assert plt.gcf() is ax.figure
    x = forrester.test_X
    posterior = line.posterior(x)
    mean, sd = posterior.mean.detach(), posterior.variance.detach().sqrt()
    np.testing.assert_allclose(curve(ax, "mean").get_xdata(), x[:, 0])
    is_drawn(ax, "mean", mean)
    is_drawn(ax, "truth", forrester.truth(x))
    is_drawn(ax, "physics", forrester.crude(x))
    data = torch.cat(forrester.data(0), dim=-1)
    np.testing.assert_allclose(curve(ax, "data").get_xydata(), data, rtol=1e-10)
    for i in (3, 17):
        ends = [(mean + sign * Z95 * sd)[i].item() for sign in (-1, 1)]
        assert band(ax, x[i]) == pytest.approx(ends)


def test_several_physics_behind_a_prediction(forrester):
    both = {"coarse": forrester.crude, "fine": forrester.truth}
    ax = plot_prediction(CKA(*forrester.data(0), physics=both), forrester.test_X)
    for name, f_p in both.items():
        is_drawn(ax, f"physics {name}", f_p(forrester.test_X))


def test_a_prediction_within_bounds(forrester):
    X, Y = forrester.data(0)
    model = LinkedCKA(X, Y.exp(), physics=lambda X: forrester.crude(X).exp())
    ax = plot_model(model)[0, 0]
    x = torch.as_tensor(curve(ax, "mean").get_xdata()).unsqueeze(-1)
    is_drawn(ax, "mean", model.predict(x).mean)
    is_drawn(ax, "physics", forrester.crude(x).exp())


def test_adjustments_are_slices_through_the_base_point(plane):
    base = torch.tensor([0.5, 1.5], dtype=torch.float64)
    axes = plot_adjustment(plane, base=base, output=1)
    assert axes.shape == (2, 2)
    for row, name in zip(axes, ("rho", "delta"), strict=True):
        for i, ax in enumerate(row):
            drawn = curve(ax, "mean").get_xydata()
            X = base.repeat(len(drawn), 1)
            X[:, i] = torch.from_numpy(drawn[:, 0].copy())
            mean = getattr(plane, name)(X).mean.detach()[:, 1]
            np.testing.assert_allclose(drawn[:, 1], mean)


def test_a_row_for_each_physics(uniform):
    X = uniform(9, 2)
    Y = torch.cat([X.prod(-1, keepdim=True), X[:, :1]], dim=-1)
    physics = {"coarse": lambda X: X, "fine": lambda X: X.square()}
    several = CKA(X, Y, physics=physics, rho_mean=(0.5, 0.25), delta_mean=-1.0)
    axes = plot_adjustment(several, output=1)
    names = ["$\\rho$ of coarse", "$\\rho$ of fine", "$\\delta$"]
    assert [ax.get_ylabel() for ax in axes[:, 0]] == [f"{name}\nfor $y_{{2}}$" for name in names]
    drawn = [row[0].lines[0].get_ydata()[0] for row in axes]
    np.testing.assert_allclose(drawn, [0.5, 0.25, -1.0])


def test_coverage(plane, data):
    loo = leave_one_out(plane)
    X, Y = data(num_outputs=2)
    of_posterior = score(plane.posterior(X, observation_noise=True), Y)
    for prediction, values in ((loo, loo.score().pit), (of_posterior, of_posterior.pit)):
        ax = plot_coverage(prediction, output=1)
        assert ax.get_title() == ("$y_{2}$" if prediction is loo else "")
        x, y = curve(ax, "observed").get_data()
        for level in (0.3, 0.8):
            inside = ((values[:, 1] - 0.5).abs() <= level / 2).double().mean().item()
            assert y[np.searchsorted(x, level, side="right") - 1] == pytest.approx(inside)


def test_leave_one_out_without_points_that_were_not_observed(data):
    X, Y = data(num_outputs=2)
    Y[[0, 3], 1] = torch.nan
    rest = [1, 2, *range(4, 9)]
    model = CKA(X, Y, physics=crude)
    loo = leave_one_out(model)
    axes = plot_leave_one_out(loo, output=1)
    dots, _, (bars,) = axes[0].containers[0]
    np.testing.assert_allclose(dots.get_xydata(), torch.stack([loo.mean, loo.Y], -1)[rest, 1])
    ends = np.array(bars.get_segments())[:, :, 0].T
    np.testing.assert_allclose(ends, torch.stack(loo.interval())[:, rest, 1])
    residuals = axes[1].lines[-1].get_xydata()[rest]
    np.testing.assert_allclose(residuals, torch.stack([loo.mean, loo.residuals], -1)[rest, 1])
    assert np.isfinite(axes[1].get_ylim()).all()
    steps = curve(plot_coverage(loo, output=1), "observed").get_ydata()
    np.testing.assert_allclose(np.unique(steps), np.arange(len(rest) + 1) / len(rest))
    ticks = plot_adjustment(model, output=1)[0, 0].lines[-1]
    np.testing.assert_allclose(ticks.get_xdata(), X[rest, 0])


def test_logarithmic_axes_end_near_the_dots():
    X = systems.line(12)
    ax = plot_leave_one_out(leave_one_out(ZeroMeanGP(X, 1.6 * 10 ** (1.2 * X))))[0]
    assert ax.get_xscale() == "log"
    dots = ax.containers[0][0].get_xydata()
    for (low, high), values in zip((ax.get_xlim(), ax.get_ylim()), dots.T, strict=True):
        assert 0.4 * dots.min() < low < values.min()
        assert values.max() < high < 3 * dots.max()


def test_given_axes_are_drawn_on(line, forrester):
    ax, axes = Figure().subplots(), Figure().subplots(2)
    assert plot_prediction(line, forrester.test_X, ax=ax) is ax
    assert plot_adjustment(line, axes=axes)[0, 0] is axes[0]


def test_the_figure_of_a_model(line, plane, forrester):
    axes = plot_model(line)
    assert axes.shape == (3, 1)
    X, Y = forrester.data(0)
    x = torch.tensor(curve(axes[0, 0], "mean").get_xdata()).unsqueeze(-1)
    is_drawn(axes[0, 0], "mean", line.predict(x).mean)
    is_drawn(axes[0, 0], "physics", forrester.crude(x))
    is_drawn(axes[0, 0], "data", Y)
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["y", r"$\rho$", r"$\delta$"]
    of_two = plot_model(plane, output=1)
    assert of_two.shape == (3, 2)
    assert len({ax.get_ylim() for ax in of_two[0]}) == 1
    assert plot_model(ZeroMeanGP(X, Y)).shape == (1, 1)
