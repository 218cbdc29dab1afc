"""Scores of predictions against their definitions."""

import numpy as np
import pytest
import scipy.stats
import torch
from botorch.posteriors import GPyTorchPosterior
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal

from gpadjust.core import CKA
from gpadjust.core.posterior import MixturePosterior
from gpadjust.kinds.links import LinkedCKA
from gpadjust.validation import Scores, score
from gpadjust.validation.scores import energy_score
from tests.systems import uniform

NAMES = ("rmse", "median", "nlpd", "crps", "coverage", "pit")


MEAN = uniform(2, 7, 3, low=-2, high=2, seed=1)  # 7 points of 3 outputs, in a batch of 2
VARIANCE = uniform(2, 7, 3, low=0.1, high=3, seed=2)
Y = uniform(2, 7, 3, low=-3, high=3, seed=3)
MEANS = uniform(2, 4, 7, 3, low=-2, high=2, seed=1)  # of 4 components
VARIANCES = uniform(2, 4, 7, 3, low=0.1, high=3, seed=2)


@pytest.fixture
def prediction():
    return MEAN.clone(), VARIANCE.clone(), Y.clone()


def test_crps_of_a_sharp_prediction_is_the_absolute_error(prediction):
    mean, _, y = prediction
    sharp = torch.full_like(mean, 1e-16)
    torch.testing.assert_close(Scores.compute(mean, sharp, y).crps, (mean - y).abs().mean(-2))


def test_calibrated_and_overconfident_predictions():
    n = 100_000
    mean, variance = uniform(n, 2, seed=1), uniform(n, 2, low=0.1, high=2, seed=2)
    y = mean + variance.sqrt() * torch.randn(n, 2, dtype=torch.float64)
    for level in (0.5, 0.9, 0.95):
        sd = (level * (1 - level) / n) ** 0.5
        scores = Scores.compute(mean, variance, y, level=level)
        assert ((scores.coverage - level).abs() < 5 * sd).all()
    assert scipy.stats.kstest(scores.pit[:5000, 0].numpy(), "uniform").pvalue > 1e-3
    share = Scores.compute(mean, variance / 4, y).coverage
    expected = 2 * scipy.stats.norm.cdf(1.959964 / 2) - 1
    assert share.tolist() == pytest.approx([expected] * 2, abs=0.025)


def posterior_of(mean, variance):
    """The posterior of a mixture of Gaussians that are independent at all points."""
    return MixturePosterior(mean.mT, torch.diag_embed(variance.mT))


def test_mixture_against_scipy():
    normal = scipy.stats.norm(MEANS.numpy(), VARIANCES.sqrt().numpy())
    y = Y.numpy()[:, None]
    scores = score(posterior_of(MEANS, VARIANCES), Y, level=0.8)
    expected = torch.from_numpy(-np.log(normal.pdf(y).mean(1)).mean(-2))
    torch.testing.assert_close(scores.nlpd, expected)
    values = torch.from_numpy(normal.cdf(y).mean(1))
    torch.testing.assert_close(scores.pit, values)
    inside = ((values > 0.1) & (values < 0.9)).double().mean(-2)
    torch.testing.assert_close(scores.coverage, inside)
    expected = (MEANS.mean(1) - Y).square().mean(-2).sqrt()
    torch.testing.assert_close(scores.rmse, expected)


def test_crps_of_a_mixture_is_the_integral():
    grid = torch.linspace(-20, 20, 40_001, dtype=torch.float64)
    expected = torch.zeros_like(Y)
    for i in np.ndindex(*Y.shape):
        batch, point, output = i
        sd = VARIANCES[batch, :, point, output].sqrt()
        normal = torch.distributions.Normal(MEANS[batch, :, point, output], sd)
        cdf = normal.cdf(grid.unsqueeze(-1)).mean(-1)
        expected[i] = (cdf - (grid >= Y[i]).double()).square().sum() * (grid[1] - grid[0])
    crps = score(posterior_of(MEANS, VARIANCES), Y).crps
    torch.testing.assert_close(crps, expected.mean(-2), rtol=1e-3, atol=1e-3)


def test_a_mixture_of_equal_components_is_the_component(prediction):
    mean, variance, y = prediction
    many = [t.unsqueeze(-3).expand(2, 5, 7, 3) for t in (mean, variance)]
    scores = score(posterior_of(*many), y)
    expected = Scores.compute(*prediction)
    for name in NAMES:
        torch.testing.assert_close(getattr(scores, name), getattr(expected, name))


@pytest.mark.parametrize("num_outputs", [1, 2])
@pytest.mark.parametrize("mixed", [False, True])
def test_score_of_a_posterior(num_outputs, mixed):
    batch = (5,) if mixed else ()
    mean = uniform(*batch, 7, num_outputs, seed=1)
    variance = uniform(*batch, 7, num_outputs, low=0.1, high=1, seed=2)
    y = uniform(7, num_outputs, seed=3)
    y[2:, num_outputs - 1] = torch.nan
    joint = [
        MultivariateNormal(mean[..., j], torch.diag_embed(variance[..., j]))
        for j in range(num_outputs)
    ]
    several = MultitaskMultivariateNormal.from_independent_mvns
    joint = joint[0] if num_outputs == 1 else several(joint)
    posterior = GaussianMixturePosterior(joint) if mixed else GPyTorchPosterior(joint)
    scores = score(posterior, y, level=0.5)
    if mixed:
        expected = score(posterior_of(mean, variance), y, level=0.5)
    else:
        expected = Scores.compute(mean, variance, y, level=0.5)
    for name in NAMES:
        found, other = getattr(scores, name), getattr(expected, name)
        torch.testing.assert_close(found, other, equal_nan=True)


def test_score_of_a_model_with_a_link_is_that_of_the_model_within(data):
    X, Y = data()
    linked = LinkedCKA(X, Y.exp(), physics=lambda X: X[:, :1].exp())
    plain = CKA(X, Y, physics=lambda X: X[:, :1])
    with torch.no_grad():
        scores = score(linked.posterior(X), Y.exp())
        expected = score(plain.posterior(X), Y)
    torch.testing.assert_close(scores.pit, expected.pit)
    torch.testing.assert_close(scores.nlpd, expected.nlpd + Y.mean(0))


def test_predictions_without_variance_have_their_limits():
    mean, y = torch.tensor([[1.0], [2.0]]).double(), torch.tensor([[1.5], [2.0]]).double()
    variance = torch.zeros_like(mean)
    scores = Scores.compute(mean, variance, y)
    torch.testing.assert_close(scores.crps, torch.tensor([0.25]).double())
    assert scores.nlpd > 1e10
    assert scores.coverage == 0.5


def test_points_that_were_not_observed_are_left_out(prediction):
    mean, variance, y = prediction
    partial = y.clone()
    partial[:, [0, 3], 0] = torch.nan
    partial[:, :, 2] = torch.nan
    rest = [1, 2, 4, 5, 6]
    found, whole = Scores.compute(mean, variance, partial), Scores.compute(*prediction)
    part = Scores.compute(*(each[:, rest] for each in prediction))
    for name in ("rmse", "nlpd", "crps", "coverage"):
        of_found, of_whole, of_part = (getattr(each, name) for each in (found, whole, part))
        torch.testing.assert_close(of_found[:, 0], of_part[:, 0])
        torch.testing.assert_close(of_found[:, 1], of_whole[:, 1])
        assert of_found[:, 2].isnan().all()
    expected = whole.pit.masked_fill(partial.isnan(), torch.nan)
    torch.testing.assert_close(found.pit, expected, equal_nan=True)


def test_gradients_of_scores_skip_what_was_not_observed(prediction):
    mean, variance, y = (t.clone() for t in prediction)
    y[0, 1, 2] = torch.nan
    mean.requires_grad_()
    scores = Scores.compute(mean, variance, y)
    for value in (scores.rmse, scores.nlpd, scores.crps):
        (gradient,) = torch.autograd.grad(value.sum(), mean, retain_graph=True)
        assert gradient.isfinite().all()
        assert gradient[0, 1, 2] == 0


def test_scores_of_a_batch_are_those_of_its_parts(prediction):
    mean, variance, y = prediction
    lower, upper = mean - 1, mean + variance
    energy = torch.tensor([1.0, 2.0])
    whole = Scores.compute(*prediction, interval=(lower, upper), energy=energy, output_names="abc")
    part = whole[1]
    expected = Scores.compute(mean[1], variance[1], y[1])
    torch.testing.assert_close(part.rmse, expected.rmse)
    torch.testing.assert_close(part.pit, expected.pit)
    torch.testing.assert_close(part.median, (mean[1] - y[1]).abs().median(0).values)
    inside = ((lower[1] <= y[1]) & (y[1] <= upper[1])).double().mean(0)
    torch.testing.assert_close(part.coverage, inside)
    assert (part.energy, part.output_names) == (2, ("a", "b", "c"))
    parts = [*whole]
    assert len(parts) == len(whole.rmse) > 1
    torch.testing.assert_close(torch.stack([each.rmse for each in parts]), whole.rmse)
    with pytest.raises(TypeError, match="no batch"):
        list(zip(part, range(3), strict=False))  # which is not to end in silence


def test_where_no_variance_is_said_only_errors_count(prediction):
    mean, variance, y = (t.clone() for t in prediction)
    variance[:, 2], variance[..., 0] = torch.nan, torch.nan
    rest = [0, 1, 3, 4, 5, 6]
    scores = Scores.compute(mean, variance, y)
    torch.testing.assert_close(scores.rmse, Scores.compute(*prediction).rmse)
    some = Scores.compute(mean[:, rest, 1:], variance[:, rest, 1:], y[:, rest, 1:])
    for name in ("nlpd", "crps", "coverage"):
        torch.testing.assert_close(getattr(scores, name)[:, 1:], getattr(some, name))
        assert getattr(scores, name)[:, 0].isnan().all()
    none = Scores.compute(mean[:, :0], variance[:, :0], y[:, :0])
    assert none.median.isnan().all()
    assert none.rmse.shape == (2, 3)


def test_energy_score_is_the_crps_of_one_output():
    y, draws = uniform(2, 5, 1, seed=1), uniform(40, 2, 5, 1, seed=2)
    pairs = (draws - draws.unsqueeze(1)).abs().sum((0, 1)) / (2 * 40 * 39)
    expected = ((draws - y).abs().mean(0) - pairs).mean((-2, -1))
    torch.testing.assert_close(energy_score(draws, y), expected)
    y[0] = torch.nan
    torch.testing.assert_close(energy_score(draws, y)[1], expected[1])
    assert energy_score(draws, y)[0].isnan()
    sure = uniform(5, 3, seed=3)
    same = energy_score(sure.expand(4, 5, 3), sure + 1)
    torch.testing.assert_close(same, torch.tensor(3.0).double().sqrt())
