"""Figures: what is drawn is what was predicted."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from gpytorch.distributions import MultivariateNormal
from matplotlib.figure import Figure

from gpadjust import CKA
from gpadjust.validation import leave_one_out, score
from gpadjust.validation.plots import (
    plot_adjustment,
    plot_adjustment_pair,
    plot_calibration,
    plot_leave_one_out,
    plot_pit,
    plot_prediction,
)

mpl.use("Agg")
Z95 = 1.959963984540054


@pytest.fixture
def line(forrester):
    """A model of one input."""
    X, Y = forrester.data(0)
    return CKA(X, Y, physics=forrester.crude)


@pytest.fixture
def plane(data, build):
    """A model of two inputs and two outputs."""
    return build("CKA", *data(num_outputs=2))


@pytest.fixture(autouse=True)
def _leave_pyplot_alone():
    settings = dict(mpl.rcParams)
    yield
    plt.close("all")
    assert dict(mpl.rcParams) == settings


def curve(ax, label):
    (found,) = [line for line in ax.lines if line.get_label() == label]
    return found


def band(ax):
    """Lower and upper edge of the first band at each x."""
    vertices = ax.collections[0].get_paths()[0].vertices
    return {
        x: (vertices[vertices[:, 0] == x, 1].min(), vertices[vertices[:, 0] == x, 1].max())
        for x in np.unique(vertices[:, 0])
    }


def test_a_prediction_of_one_input(line, forrester):
    X = forrester.test_X.flip(0)
    ax = plot_prediction(line, X, forrester.truth(X))
    x = forrester.test_X
    posterior = line.posterior(x)
    mean, sd = posterior.mean.detach()[:, 0], posterior.variance.detach()[:, 0].sqrt()
    np.testing.assert_allclose(curve(ax, "mean").get_xydata(), torch.stack([x[:, 0], mean], -1))
    np.testing.assert_allclose(curve(ax, "truth").get_ydata(), forrester.truth(x)[:, 0])
    np.testing.assert_allclose(curve(ax, "physics").get_ydata(), forrester.crude(x)[:, 0])
    data = torch.cat(forrester.data(0), dim=-1)
    np.testing.assert_allclose(curve(ax, "data").get_xydata(), data, rtol=1e-10)
    edges = band(ax)
    for i in (3, 17):
        low, high = edges[x[i].item()]
        assert low == pytest.approx((mean - Z95 * sd)[i].item())
        assert high == pytest.approx((mean + Z95 * sd)[i].item())


def test_a_prediction_of_more_inputs(plane, data):
    X, Y = data(n=12, num_outputs=2, seed=3)
    ax = plot_prediction(plane, X, Y, output=1)
    mean = plane.posterior(X).mean.detach()[:, 1]
    (container,) = ax.containers
    np.testing.assert_allclose(container[0].get_xydata(), torch.stack([Y[:, 1], mean], dim=-1))


def test_adjustments_are_slices_through_the_base_point(plane):
    base = torch.tensor([0.5, 1.5], dtype=torch.float64)
    axes = plot_adjustment(plane, base=base, output=1, num_points=7)
    assert axes.shape == (2, 2)
    for row, name in zip(axes, ("rho", "delta"), strict=True):
        for i, ax in enumerate(row):
            drawn = curve(ax, "mean").get_xydata()
            X = base.repeat(7, 1)
            X[:, i] = torch.from_numpy(drawn[:, 0].copy())
            mean = getattr(plane, name)(X).mean.detach()[:, 1]
            np.testing.assert_allclose(drawn[:, 1], mean)


def test_pairs(plane):
    axes = plot_adjustment_pair(plane, (1, 0), num_points=6)
    assert [ax.get_title() for ax in axes[0]] == [r"mean of $\rho$", r"sd of $\rho$"]
    assert axes[1, 0].get_xlabel() == "$x_{2}$"
    assert len(axes[0, 0].figure.axes) == 8  # a colour bar each


def test_calibration_and_pit(plane, data):
    loo = leave_one_out(plane)
    X, Y = data(num_outputs=2)
    for prediction in (loo, loo.pit, score(plane.posterior(X, observation_noise=True), Y)):
        ax = plot_calibration(prediction, output=1)
        values = prediction if isinstance(prediction, torch.Tensor) else prediction.pit
        x, y = curve(ax, "observed").get_data()
        for level in (0.3, 0.8):
            inside = ((values[:, 1] - 0.5).abs() <= level / 2).double().mean().item()
            assert y[np.searchsorted(x, level, side="right") - 1] == pytest.approx(inside)
        bars = plot_pit(prediction, bins=4).patches
        counts = [bar.get_height() for bar in bars]
        assert counts == list(np.histogram(values[:, 0].detach(), bins=4, range=(0, 1))[0])


def test_leave_one_out(plane):
    loo = leave_one_out(plane)
    axes = plot_leave_one_out(loo, output=1)
    drawn = axes[0].containers[0][0].get_xydata()
    np.testing.assert_allclose(drawn, torch.stack([loo.Y[:, 1], loo.mean[:, 1]], dim=-1))
    drawn = axes[1].lines[-1].get_xydata()
    np.testing.assert_allclose(drawn, torch.stack([loo.mean, loo.residuals], dim=-1)[:, 1])


def test_given_axes_are_drawn_on(line, forrester):
    figure = Figure()
    ax = figure.subplots()
    assert plot_prediction(line, forrester.test_X, ax=ax) is ax
    axes = Figure().subplots(2)
    assert plot_adjustment(line, axes=axes)[0, 0] is axes[0]
    with pytest.raises(ValueError, match="Expected 2 axes, got 1"):
        plot_leave_one_out(leave_one_out(line), axes=ax)


def test_bad_input(line, plane, data, build, forrester):
    X, Y = data(num_outputs=2)
    with pytest.raises(ValueError, match="pass `Y`"):
        plot_prediction(plane, X)
    with pytest.raises(ValueError, match="There is no output 2; there are 2"):
        plot_prediction(plane, X, Y, output=2)
    with pytest.raises(ValueError, match="Expected Y of shape 9 x m"):
        plot_prediction(plane, X, Y[1:])
    with pytest.raises(ValueError, match="Expected X of shape n x d"):
        plot_prediction(plane, X.unsqueeze(0), Y)
    with pytest.raises(ValueError, match="Expected level between 0 and 1"):
        plot_prediction(line, forrester.test_X, level=95)
    with pytest.raises(ValueError, match="Expected PIT values between 0 and 1"):
        plot_pit(torch.tensor([0.5, 1.5]))
    with pytest.raises(ValueError, match="Expected bins >= 1"):
        plot_pit(torch.tensor([0.5]), bins=0)
    with pytest.raises(TypeError, match="ZeroMeanGP has neither rho nor delta"):
        plot_adjustment(build("ZeroMeanGP", X, Y))
    with pytest.raises(ValueError, match="Expected two different inputs from 0 to 1"):
        plot_adjustment_pair(plane, (0, 2))
    with pytest.raises(ValueError, match=r"Expected bounds of shape \(2, 2\)"):
        plot_adjustment(plane, bounds=torch.zeros(2, 2))
    with pytest.raises(ValueError, match="Expected a base point of 2 inputs"):
        plot_adjustment(plane, base=torch.zeros(3))


def test_a_fully_bayesian_prediction(uniform, forrester):
    x = forrester.test_X
    mean, sd = uniform(5, 40, seed=1), uniform(5, 40, low=0.1, seed=2)
    mixture = GaussianMixturePosterior(MultivariateNormal(mean, torch.diag_embed(sd.square())))
    X, Y = forrester.data(0)
    line = CKA(X, Y, physics=forrester.crude)
    line.posterior = lambda X, **kwargs: mixture
    ax = plot_prediction(line, x)
    np.testing.assert_allclose(curve(ax, "mean").get_ydata(), mean.mean(0))
    spread = mixture.mixture_variance[:, 0].sqrt()
    low, high = band(ax)[x[5].item()]
    assert (high - low) / (2 * Z95) == pytest.approx(spread[5].item())


def test_an_input_that_never_changed():
    X = torch.rand(8, 2, dtype=torch.float64)
    X[:, 1] = 0.5
    model = CKA(X, X[:, :1].exp(), physics=lambda X: X[:, :1])
    axes = plot_adjustment(model)
    assert axes.shape == (2, 2)


def test_default_axes_are_of_a_figure_that_pyplot_knows(line):
    ax = plot_prediction(line, torch.linspace(0, 1, 5, dtype=torch.float64).unsqueeze(-1))
    assert plt.gcf() is ax.figure


def test_calibration_names_the_output_if_there_are_several():
    assert plot_calibration(torch.rand(20, 2), output=1).get_title() == "output 1"
    assert plot_pit(torch.rand(20, 2)).get_title() == "output 0"
    assert plot_calibration(torch.rand(20)).get_title() == ""
