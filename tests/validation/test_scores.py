"""Scores of predictions against their definitions."""

import numpy as np
import pytest
import scipy.stats
import torch
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal

from gpadjust.validation import coverage, crps, nlpd, pit, rmse, score


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
    for one in (crps, nlpd, coverage):
        assert one(*prediction).shape == (2, 3)
    assert rmse(prediction[0], prediction[2]).shape == (2, 3)


@pytest.mark.parametrize("level", [0.0, 1.0, 95, -0.1, float("nan")])
def test_bad_level(prediction, level):
    with pytest.raises(ValueError, match="Expected level between 0 and 1, got"):
        coverage(*prediction, level=level)


@pytest.mark.parametrize("level", ["0.9", None, [0.9]])
def test_a_level_that_is_no_number(prediction, level):
    with pytest.raises(TypeError, match=r"Expected level to be a number such as 0\.95, got"):
        coverage(*prediction, level=level)


@pytest.fixture
def mixture(uniform):
    """Means and variances of 4 components at 7 points of 3 outputs, in a batch of 2; targets."""
    shape = (2, 4, 7, 3)
    return (
        uniform(*shape, low=-2, high=2, seed=1),
        uniform(*shape, low=0.1, high=3, seed=2),
        uniform(2, 7, 3, low=-3, high=3, seed=3),
    )


def test_mixture_against_scipy(mixture):
    mean, variance, y = (t.numpy() for t in mixture)
    normal = scipy.stats.norm(mean, np.sqrt(variance))
    y = y[:, None]
    expected = torch.from_numpy(-np.log(normal.pdf(y).mean(1)).mean(-2))
    torch.testing.assert_close(nlpd(*mixture, mixture_dim=-3), expected)
    values = torch.from_numpy(normal.cdf(y).mean(1))
    torch.testing.assert_close(pit(*mixture, mixture_dim=-3), values)
    inside = ((values > 0.1) & (values < 0.9)).double().mean(-2)
    torch.testing.assert_close(coverage(*mixture, 0.8, mixture_dim=-3), inside)
    expected = torch.from_numpy(np.sqrt(((mean.mean(1) - y[:, 0]) ** 2).mean(-2)))
    torch.testing.assert_close(rmse(mixture[0], mixture[2], mixture_dim=-3), expected)


def test_crps_of_a_mixture_is_the_integral(mixture):
    mean, variance, y = mixture
    grid = torch.linspace(-20, 20, 40_001, dtype=torch.float64)
    expected = torch.zeros_like(y)
    for i in np.ndindex(*y.shape):
        batch, point, output = i
        sd = variance[batch, :, point, output].sqrt()
        normal = torch.distributions.Normal(mean[batch, :, point, output], sd)
        cdf = normal.cdf(grid.unsqueeze(-1)).mean(-1)
        expected[i] = (cdf - (grid >= y[i]).double()).square().sum() * (grid[1] - grid[0])
    torch.testing.assert_close(
        crps(*mixture, mixture_dim=-3), expected.mean(-2), rtol=1e-3, atol=1e-3
    )


def test_crps_of_a_mixture_by_monte_carlo(mixture):
    mean, variance, y = (t[:1, ..., :1, :1] for t in mixture)
    mean, variance = mean.reshape(4), variance.reshape(4)
    n = 400_000
    pick = torch.randint(4, (2, n))
    a, b = mean[pick] + variance[pick].sqrt() * torch.randn(2, n, dtype=torch.float64)
    sampled = (a - y.item()).abs().mean() - (a - b).abs().mean() / 2
    exact = crps(mean.reshape(4, 1, 1), variance.reshape(4, 1, 1), y.reshape(1, 1), mixture_dim=0)
    assert exact.item() == pytest.approx(sampled.item(), abs=0.01)


def test_a_mixture_of_equal_components_is_the_component(prediction):
    mean, variance, y = prediction
    many = [t.unsqueeze(-3).expand(2, 5, 7, 3) for t in (mean, variance)]
    for one in (nlpd, crps, pit, coverage):
        torch.testing.assert_close(one(*many, y, mixture_dim=-3), one(*prediction))


def test_pit_of_calibrated_predictions_is_uniform(uniform):
    mean, variance = uniform(5000, 1, seed=1), uniform(5000, 1, low=0.1, high=2, seed=2)
    y = mean + variance.sqrt() * torch.randn(5000, 1, dtype=torch.float64)
    values = pit(mean, variance, y)
    assert scipy.stats.kstest(values.flatten().numpy(), "uniform").pvalue > 1e-3


def test_score_of_a_posterior(data, build, uniform):
    X, Y = data(num_outputs=2)
    posterior = build("CKA", X, Y).posterior(X, observation_noise=True)
    scores = score(posterior, Y, level=0.5)
    three = posterior.mean, posterior.variance, Y
    torch.testing.assert_close(scores.rmse, rmse(posterior.mean, Y))
    torch.testing.assert_close(scores.nlpd, nlpd(*three))
    torch.testing.assert_close(scores.crps, crps(*three))
    torch.testing.assert_close(scores.pit, pit(*three))
    torch.testing.assert_close(scores.coverage, coverage(*three, 0.5))


@pytest.mark.parametrize("num_outputs", [1, 2])
def test_score_of_a_fully_bayesian_posterior(uniform, num_outputs):
    mean = uniform(5, 7, num_outputs, seed=1)
    variance = uniform(5, 7, num_outputs, low=0.1, high=1, seed=2)
    y = uniform(7, num_outputs, seed=3)
    normals = [
        MultivariateNormal(mean[..., j], torch.diag_embed(variance[..., j]))
        for j in range(num_outputs)
    ]
    joint = normals[0]
    if num_outputs > 1:
        joint = MultitaskMultivariateNormal.from_independent_mvns(normals)
    scores = score(GaussianMixturePosterior(joint), y)
    torch.testing.assert_close(scores.nlpd, nlpd(mean, variance, y, mixture_dim=-3))
    torch.testing.assert_close(scores.crps, crps(mean, variance, y, mixture_dim=-3))
    torch.testing.assert_close(scores.pit, pit(mean, variance, y, mixture_dim=-3))
    torch.testing.assert_close(scores.rmse, rmse(mean, y, mixture_dim=-3))


def test_shapes_that_disagree(prediction):
    mean, variance, y = prediction
    with pytest.raises(ValueError, match=r"y's shape \(2, 7, 1\)"):
        crps(mean, variance, y[..., :1])
    with pytest.raises(ValueError, match="There is no dimension -4"):
        crps(mean, variance, y, mixture_dim=-4)


def test_predictions_without_variance_have_their_limits():
    mean, y = torch.tensor([[1.0], [2.0]]).double(), torch.tensor([[1.5], [2.0]]).double()
    variance = torch.zeros_like(mean)
    torch.testing.assert_close(crps(mean, variance, y), torch.tensor([0.25]).double())
    assert nlpd(mean, variance, y) > 1e10
    assert coverage(mean, variance, y) == 0.5


GAUSSIAN = [nlpd, crps, pit, coverage]


@pytest.mark.parametrize("one", GAUSSIAN)
def test_numpy_arrays_are_refused(prediction, one):
    mean, variance, y = prediction
    with pytest.raises(TypeError, match=r"got ndarray; convert it with `torch.as_tensor\(mean, "):
        rmse(mean.numpy(), y.numpy())
    with pytest.raises(TypeError, match="Expected variance to be a torch tensor, got ndarray"):
        one(mean, variance.numpy(), y)
    with pytest.raises(TypeError, match="Expected y to be a torch tensor, got list"):
        one(mean, variance, y.tolist())
    with pytest.raises(TypeError, match=r"got torch.int64; convert it with `mean.double\(\)`"):
        rmse(mean.long(), y)


@pytest.mark.parametrize("one", GAUSSIAN)
def test_variances_that_are_none(prediction, one):
    mean, variance, y = (t.clone() for t in prediction)
    variance[0, 1, 2] = -0.5
    with pytest.raises(ValueError, match=r"at least 0, got -0.5; if .* `variance.clamp_min\(0\)`"):
        one(mean, variance, y)
    variance[0, 1, 2] = torch.nan
    with pytest.raises(ValueError, match="Expected variance without NaN, found 1 of 42"):
        one(mean, variance, y)


def test_means_of_nan(prediction):
    mean, variance, y = (t.clone() for t in prediction)
    mean[0, 1, 2] = y[0, 1, 2] = torch.nan
    for call in (lambda: rmse(mean, y), lambda: pit(mean, variance, y)):
        with pytest.raises(ValueError, match="Expected mean without NaN, found 1 of 42"):
            call()


@pytest.mark.parametrize("one", GAUSSIAN)
def test_columns_are_needed(prediction, one):
    mean, variance, y = (t[0, :, 0] for t in prediction)
    with pytest.raises(ValueError, match=r"Expected y of shape ... x n x m.*unsqueeze\(-1\)"):
        rmse(mean, y)
    with pytest.raises(ValueError, match=r"Expected y of shape ... x n x m.*unsqueeze\(-1\)"):
        one(mean, variance, y)
    with pytest.raises(ValueError, match=r"\(7, 1\) and \(7, 2\)"):
        one(mean.unsqueeze(-1), variance.unsqueeze(-1).expand(7, 2), y.unsqueeze(-1))


def test_what_is_no_posterior_is_not_scored(data, build):
    X, Y = data()
    with pytest.raises(TypeError, match=r"got CKA; that of a model is `model.posterior\(X, "):
        score(build("CKA", X, Y), Y)


@pytest.mark.parametrize("mixed", [False, True])
def test_points_that_were_not_observed_are_left_out(prediction, mixture, mixed):
    mean, variance, y = mixture if mixed else prediction
    options = {"mixture_dim": -3} if mixed else {}
    partial = y.clone()
    partial[:, [0, 3], 0] = torch.nan
    partial[:, :, 2] = torch.nan
    rest = [1, 2, 4, 5, 6]
    for one in (rmse, nlpd, crps, coverage):
        some = {True: (mean,), False: (mean, variance)}[one is rmse]
        found, whole = one(*some, partial, **options), one(*some, y, **options)
        part = one(*(t[..., rest, :] for t in some), y[:, rest], **options)
        torch.testing.assert_close(found[:, 0], part[:, 0])
        torch.testing.assert_close(found[:, 1], whole[:, 1])
        assert found[:, 2].isnan().all()
    expected = pit(mean, variance, y, **options).masked_fill(partial.isnan(), torch.nan)
    found = pit(mean, variance, partial, **options)
    torch.testing.assert_close(found, expected, equal_nan=True)


def test_gradients_of_scores_skip_what_was_not_observed(prediction):
    mean, variance, y = (t.clone() for t in prediction)
    y[0, 1, 2] = torch.nan
    mean.requires_grad_()
    for value in (rmse(mean, y), nlpd(mean, variance, y), crps(mean, variance, y)):
        (gradient,) = torch.autograd.grad(value.sum(), mean)
        assert gradient.isfinite().all()
        assert gradient[0, 1, 2] == 0


def test_the_score_of_a_posterior_of_partial_outputs(data, build):
    X, Y = data(num_outputs=2)
    posterior = build("CKA", X, Y).posterior(X, observation_noise=True)
    partial = Y.clone()
    partial[2:, 1] = torch.nan
    scores = score(posterior, partial)
    torch.testing.assert_close(scores.rmse[1], rmse(posterior.mean[:2], Y[:2])[1])
    assert scores.pit.isnan().sum() == len(Y) - 2
    assert not scores.coverage.isnan().any()
