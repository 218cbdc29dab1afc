"""Scores of predictions against their definitions."""

import numpy as np
import pytest
import scipy.stats
import torch

from gpadjust.validation import coverage, crps, nlpd, rmse


@pytest.fixture
def prediction(uniform):
    """Means, variances and targets of 7 points and 3 outputs, in a batch of 2."""
    shape = (2, 7, 3)
    return (
        uniform(*shape, low=-2, high=2, seed=1),
        uniform(*shape, low=0.1, high=3, seed=2),
        uniform(*shape, low=-3, high=3, seed=3),
    )


def test_crps_is_the_integral_of_the_squared_difference_of_the_distributions(prediction):
    mean, variance, y = (t.numpy() for t in prediction)
    grid = np.linspace(-20, 20, 200_001)
    step = grid[1] - grid[0]
    expected = np.empty(mean.shape)
    for i in np.ndindex(mean.shape):
        cdf = scipy.stats.norm.cdf(grid, mean[i], np.sqrt(variance[i]))
        expected[i] = ((cdf - (grid >= y[i])) ** 2).sum() * step
    expected = torch.from_numpy(expected).mean(-2)
    torch.testing.assert_close(crps(*prediction), expected, rtol=1e-3, atol=1e-4)


def test_crps_of_a_sharp_prediction_is_the_absolute_error(prediction):
    mean, _, y = prediction
    sharp = torch.full_like(mean, 1e-16)
    torch.testing.assert_close(crps(mean, sharp, y), (mean - y).abs().mean(-2))


def test_nlpd(prediction):
    mean, variance, y = (t.numpy() for t in prediction)
    density = scipy.stats.norm.logpdf(y, mean, np.sqrt(variance))
    torch.testing.assert_close(nlpd(*prediction), torch.from_numpy(-density.mean(-2)))


def test_rmse(prediction):
    mean, _, y = prediction
    expected = np.sqrt(((mean - y).numpy() ** 2).mean(-2))
    torch.testing.assert_close(rmse(mean, y), torch.from_numpy(expected))


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95])
def test_coverage_of_calibrated_predictions(uniform, level):
    n = 100_000
    mean, variance = uniform(n, 2, seed=1), uniform(n, 2, low=0.1, high=2, seed=2)
    y = mean + variance.sqrt() * torch.randn(n, 2, dtype=torch.float64)
    sd = (level * (1 - level) / n) ** 0.5
    assert ((coverage(mean, variance, y, level) - level).abs() < 5 * sd).all()


def test_coverage_of_overconfident_predictions_is_too_low(uniform):
    y = torch.randn(10_000, 1, dtype=torch.float64)
    variance = torch.full_like(y, 0.25)
    expected = 2 * scipy.stats.norm.cdf(1.959964 / 2) - 1
    assert coverage(torch.zeros_like(y), variance, y).item() == pytest.approx(expected, abs=0.025)


def test_shapes(prediction):
    for score in (crps, nlpd, coverage):
        assert score(*prediction).shape == (2, 3)
    assert rmse(prediction[0], prediction[2]).shape == (2, 3)


@pytest.mark.parametrize("level", [0.0, 1.0, 95, -0.1, float("nan")])
def test_bad_level(prediction, level):
    with pytest.raises(ValueError, match="Expected level between 0 and 1, got"):
        coverage(*prediction, level=level)
