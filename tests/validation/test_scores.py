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


def posterior_of(mean, variance):
    """The posterior of a mixture of Gaussians that are independent at all points."""
    return MixturePosterior(mean.mT, torch.diag_embed(variance.mT))


def test_mixture_against_scipy():
    normal = scipy.stats.norm(MEANS.numpy(), VARIANCES.sqrt().numpy())
    y = Y.numpy()[:, None]
    scores = score(posterior_of(MEANS, VARIANCES), Y, level=0.8)
    nlpd = torch.from_numpy(-np.log(normal.pdf(y).mean(1)).mean(-2))
    torch.testing.assert_close(scores.nlpd, nlpd)
    pit = torch.from_numpy(normal.cdf(y).mean(1))
    torch.testing.assert_close(scores.pit, pit)
    torch.testing.assert_close(scores.coverage, ((pit - 0.5).abs() < 0.4).double().mean(-2))
    torch.testing.assert_close(scores.rmse, (MEANS.mean(1) - Y).square().mean(-2).sqrt())


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


def same_scores(scores, expected):
    for name in NAMES:
        pair = getattr(scores, name), getattr(expected, name)
        torch.testing.assert_close(*pair, equal_nan=True)


def test_a_mixture_of_equal_components_is_the_component():
    many = [values.unsqueeze(-3).expand(2, 5, 7, 3) for values in (MEAN, VARIANCE)]
    same_scores(score(posterior_of(*many), Y), Scores.compute(MEAN, VARIANCE, Y))


@pytest.mark.parametrize("num_outputs", [1, 2])
@pytest.mark.parametrize("mixed", [False, True])
def test_score_of_a_posterior(num_outputs, mixed):
    batch = (5,) if mixed else ()
    mean = uniform(*batch, 7, num_outputs, seed=1)
    variance = uniform(*batch, 7, num_outputs, low=0.1, high=1, seed=2)
    y = uniform(7, num_outputs, seed=3)
    y[2:, num_outputs - 1] = torch.nan
    pairs = zip(mean.unbind(-1), variance.unbind(-1), strict=True)
    joint = [MultivariateNormal(mean, torch.diag_embed(variance)) for mean, variance in pairs]
    several = MultitaskMultivariateNormal.from_independent_mvns
    joint = joint[0] if num_outputs == 1 else several(joint)
    posterior = GaussianMixturePosterior(joint) if mixed else GPyTorchPosterior(joint)
    scores = score(posterior, y, level=0.5)
    if mixed:
        same_scores(scores, score(posterior_of(mean, variance), y, level=0.5))
    else:
        same_scores(scores, Scores.compute(mean, variance, y, level=0.5))


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
    mean, y = torch.tensor([[[1.0], [2.0]], [[1.5], [2.0]]]).double()
    scores = Scores.compute(mean, torch.zeros_like(mean), y)
    torch.testing.assert_close(scores.crps, torch.tensor([0.25]).double())  # the absolute error
    assert scores.nlpd > 1e10
    assert scores.coverage == 0.5


def test_points_that_were_not_observed_are_left_out():
    partial = Y.clone()
    partial[:, [0, 3], 0] = torch.nan
    partial[:, :, 2] = torch.nan
    rest = [1, 2, 4, 5, 6]
    mean = MEAN.clone().requires_grad_()
    scores, complete = Scores.compute(mean, VARIANCE, partial), Scores.compute(MEAN, VARIANCE, Y)
    part = Scores.compute(*(values[:, rest] for values in (MEAN, VARIANCE, Y)))
    for name in ("rmse", "nlpd", "crps", "coverage"):
        value = getattr(scores, name)
        torch.testing.assert_close(value[:, 0].detach(), getattr(part, name)[:, 0])
        torch.testing.assert_close(value[:, 1].detach(), getattr(complete, name)[:, 1])
        assert value[:, 2].isnan().all()
    expected = complete.pit.masked_fill(partial.isnan(), torch.nan)
    torch.testing.assert_close(scores.pit.detach(), expected, equal_nan=True)
    for value in (scores.rmse, scores.nlpd, scores.crps):
        (gradient,) = torch.autograd.grad(value[:, :2].sum(), mean, retain_graph=True)
        assert gradient.isfinite().all()
        assert (gradient[:, [0, 3], 0] == 0).all()


def test_scores_of_a_batch_are_those_of_its_parts():
    lower, upper = MEAN - 1, MEAN + VARIANCE
    energy = torch.tensor([1.0, 2.0])
    options = {"interval": (lower, upper), "energy": energy, "output_names": "abc"}
    scores = Scores.compute(MEAN, VARIANCE, Y, **options)
    part = scores[1]
    expected = Scores.compute(MEAN[1], VARIANCE[1], Y[1])
    torch.testing.assert_close(part.rmse, expected.rmse)
    torch.testing.assert_close(part.pit, expected.pit)
    torch.testing.assert_close(part.median, (MEAN[1] - Y[1]).abs().median(0).values)
    inside = ((lower[1] <= Y[1]) & (Y[1] <= upper[1])).double().mean(0)
    torch.testing.assert_close(part.coverage, inside)
    assert (part.energy, part.output_names) == (2, ("a", "b", "c"))
    assert len(scores.rmse) == 2
    torch.testing.assert_close(torch.stack([part.rmse for part in scores]), scores.rmse)
    with pytest.raises(TypeError, match="no batch"):
        list(zip(part, range(3), strict=False))  # which is not to end in silence


def test_where_no_variance_is_said_only_errors_count():
    variance = VARIANCE.clone()
    variance[:, 2], variance[..., 0] = torch.nan, torch.nan
    rest = [0, 1, 3, 4, 5, 6]
    scores = Scores.compute(MEAN, variance, Y)
    torch.testing.assert_close(scores.rmse, Scores.compute(MEAN, VARIANCE, Y).rmse)
    some = Scores.compute(*(values[:, rest, 1:] for values in (MEAN, variance, Y)))
    for name in ("nlpd", "crps", "coverage"):
        torch.testing.assert_close(getattr(scores, name)[:, 1:], getattr(some, name))
        assert getattr(scores, name)[:, 0].isnan().all()
    none = Scores.compute(MEAN[:, :0], variance[:, :0], Y[:, :0])
    assert none.median.isnan().all()
    assert none.rmse.shape == (2, 3)


def test_energy_score_is_the_crps_of_one_output():
    y, draws = uniform(2, 5, 1, seed=1), uniform(40, 2, 5, 1, seed=2)
    pairs = (draws - draws.unsqueeze(1)).abs().sum((0, 1)) / (2 * 40 * 39)
    expected = ((draws - y).abs().mean(0) - pairs).mean((-2, -1))
    torch.testing.assert_close(energy_score(draws, y), expected)
    y[0] = expected[0] = torch.nan
    torch.testing.assert_close(energy_score(draws, y), expected, equal_nan=True)
    sure = uniform(5, 3, seed=3)
    same = energy_score(sure.expand(4, 5, 3), sure + 1)
    torch.testing.assert_close(same, torch.tensor(3.0).double().sqrt())
