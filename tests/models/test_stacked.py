"""Stacked models: the mixture of their parts, output by output, as BoTorch's models are used."""

import pytest
import torch
from botorch.acquisition.active_learning import qNegIntegratedPosteriorVariance
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import CKA, PhysicsMeanGP, StackedGP, ZeroMeanGP
from gpadjust.models.stacked import allocation
from gpadjust.validation import leave_one_out
from gpadjust.validation.leave_one_out import observations
from tests.systems import around, same


def f_p(X):
    return torch.stack([(6 * X[..., 0]).sin(), 100 * X[..., 1]], -1)


def held(model, number, seed):
    """The model with samples around its hyper-parameters."""
    model.hold_samples(around(model, number, seed=seed))
    return model


@pytest.fixture
def data(uniform):
    X = uniform(7, 2)
    return X, 2 * f_p(X) + X.square()


@pytest.fixture
def models(data):
    return {
        "CKA": held(CKA(*data, physics=f_p), 8, 0),
        "mean": held(PhysicsMeanGP(*data, physics=f_p), 8, 1),
    }


@pytest.fixture
def weights():
    return torch.tensor([[0.25, 1.0], [0.75, 0.0]], dtype=torch.float64)


@pytest.fixture
def Z(uniform):
    return uniform(5, 2, seed=3)


def quarter(model, Z, output, number):
    """Moments of some of a model's components."""
    index = torch.linspace(0, 7, number).round().long()
    posterior = model.posterior(Z)
    return posterior.mean[index, :, output], posterior.variance[index, :, output]


def test_moments_are_those_of_the_weighted_mixture(models, weights, Z):
    stacked = StackedGP(models, weights, num_components=8)
    assert stacked.weights == {"CKA": [0.25, 1.0], "mean": [0.75, 0.0]}
    first = [quarter(models["CKA"], Z, 0, 2), quarter(models["mean"], Z, 0, 6)]
    second = [quarter(models["CKA"], Z, 1, 8)]
    mean, variance = stacked.predict(Z)
    posterior = stacked.posterior(Z)
    assert isinstance(posterior, GaussianMixturePosterior)
    assert posterior.mean.shape == (8, 5, 2)
    for j, parts in enumerate((first, second)):
        means, variances = (torch.cat(moments) for moments in zip(*parts, strict=True))
        expected = means.mean(0)
        torch.testing.assert_close(mean[:, j], expected)
        second_moment = (variances + means.square()).mean(0)
        torch.testing.assert_close(variance[:, j], second_moment - expected.square())
    torch.testing.assert_close(posterior.mixture_mean, mean)
    torch.testing.assert_close(posterior.mixture_variance, variance)
    low, high = stacked.interval(Z, 0.5)
    assert ((low < mean) & (mean < high)).all()


def test_of_one_model_it_is_that_model(models, Z):
    stacked = StackedGP({"CKA": models["CKA"]}, torch.ones(1, 2).double(), num_components=8)
    torch.testing.assert_close(stacked.predict(Z, True), models["CKA"].predict(Z, True))
    same(stacked.interval(Z), models["CKA"].interval(Z))
    ours, theirs = stacked.posterior(Z), models["CKA"].posterior(Z)
    torch.testing.assert_close(ours.covariance_matrix, theirs.covariance_matrix)
    ours, theirs = leave_one_out(stacked), leave_one_out(models["CKA"])
    torch.testing.assert_close(ours.log_density, theirs.log_density)
    torch.testing.assert_close(ours.variance, theirs.variance)


def test_point_estimates_are_stacked_as_well(data, models, weights, Z):
    point = PhysicsMeanGP(*data, physics=f_p)
    stacked = StackedGP({**models, "mean": point}, weights, num_components=4)
    expected = quarter(models["CKA"], Z, 0, 1)[0].sum(0) + 3 * point.posterior(Z).mean[:, 0]
    torch.testing.assert_close(stacked.predict(Z).mean[:, 0], expected / 4)
    torch.testing.assert_close(stacked.posterior(Z).mixture_mean, stacked.predict(Z).mean)


def test_outputs_are_independent(uniform):
    """Structures that say 0 and 100, of which each output has its own mixture."""

    def physics(X):
        return torch.full_like(X[..., :1], 100.0).expand(*X.shape[:-1], 3)

    X = uniform(7, 2)
    models = {
        "f_p": PhysicsMeanGP(X, physics(X), physics=physics),
        "zero": ZeroMeanGP(X, physics(X)),
    }
    models["zero"].terms[0].kernel.outputscale = 1e-4
    stacked = StackedGP(models, torch.tensor([[0.5, 0.5, 0.25], [0.5, 0.5, 0.75]]).double())
    posterior = stacked.posterior(X[:1] + 9)
    torch.manual_seed(0)
    deviation = posterior.rsample(torch.Size([64])) - posterior.mixture_mean
    correlation = deviation.flatten(0, 2).mT.corrcoef()
    torch.testing.assert_close(correlation, torch.eye(3).double(), rtol=0, atol=0.1)


def test_left_out_densities_are_mixed(models, weights):
    stacked = StackedGP(models, weights, num_components=8)
    loo, (X, Y) = leave_one_out(stacked), observations(stacked)
    parts = [leave_one_out(part.model).log_density.exp() for part in stacked.parts[0]]
    expected = (parts[0] / 4 + 3 * parts[1] / 4).log()
    torch.testing.assert_close(loo.log_density[:, :1], expected)
    torch.testing.assert_close(loo.Y, Y)
    torch.testing.assert_close(loo.X, X)


def test_functions_are_spread_over_the_components(models, weights, Z):
    stacked = StackedGP(models, weights, num_components=8)
    functions = stacked.sample_functions(400, seed=0, num_features=256)
    values, own = functions(Z), functions.each(Z.expand(400, -1, -1))
    assert values.shape == (400, 5, 2)
    torch.testing.assert_close(own, values)
    mean, variance = stacked.predict(Z)
    assert ((values.mean(0) - mean).abs() < 0.3 * variance.sqrt()).all()
    assert functions(Z.expand(3, -1, -1)).shape == (400, 3, 5, 2)
    with pytest.raises(ValueError, match=r"400 functions, 400 x q x d"):
        functions.each(Z.expand(3, -1, -1))
    few = stacked.sample_functions(1, seed=0)
    assert torch.equal(few(Z), stacked.sample_functions(1, seed=0)(Z))


def test_outputs_are_subset(models, weights, Z):
    stacked = StackedGP(models, weights, num_components=4)
    subset = stacked.subset_output([-1])
    assert (subset.num_outputs, subset.output_names) == (1, ("y2",))
    assert subset.weights == {"CKA": [1.0], "mean": [0.0]}
    torch.testing.assert_close(subset.predict(Z).mean, stacked.predict(Z).mean[:, 1:])
    mean = stacked.posterior(Z, output_indices=[1, 0]).mean
    torch.testing.assert_close(mean, stacked.posterior(Z).mean.flip(-1))


def test_conditioning_conditions_each_part(data, models, weights, Z):
    stacked = StackedGP(models, weights, num_components=4)
    Y = 2 * f_p(Z[:2])
    Y[1, 1] = torch.nan
    conditioned = stacked.condition_on_observations(Z[:2], Y)
    for j, k in ((0, 2), (1, 1)):
        for part, before in zip(conditioned.parts[j], stacked.parts[j], strict=True):
            expected = before.model.condition_on_observations(Z[:k], Y[:k, j : j + 1])
            torch.testing.assert_close(part.model.predict(Z), expected.predict(Z))
    assert conditioned.weights == stacked.weights
    loo, (X, all_Y) = leave_one_out(conditioned), observations(conditioned)
    torch.testing.assert_close(loo.Y, torch.cat([data[1], Y]), equal_nan=True)
    torch.testing.assert_close(all_Y, loo.Y, equal_nan=True)
    assert torch.equal(loo.log_density.isnan(), loo.Y.isnan())
    assert X.shape == (9, 2)


@pytest.mark.parametrize("holds_samples", [True, False])
def test_conditioning_with_known_noise(data, Z, holds_samples):
    """A stacked model of one model is that model, through two rounds and a fantasy."""
    X, Y = data
    model = CKA(X, Y, 0.1, physics=f_p)
    model = held(model, 4, 0) if holds_samples else model
    stacked = StackedGP({"CKA": model}, [[1.0, 1.0]], num_components=4)
    noise, new_Y = torch.full((1, 2), 0.3, dtype=torch.float64), 2 * f_p(Z)
    for k in range(2):
        row = slice(k, k + 1)
        model = model.condition_on_observations(Z[row], new_Y[row], noise=noise)
        stacked = stacked.condition_on_observations(Z[row], new_Y[row], noise=noise)
    same(stacked.predict(X, True), model.predict(X, True))
    assert stacked.subset_output([1]).parts[0][0].model.data()["train_Yvar"].max() == pytest.approx(
        0.3
    )
    torch.testing.assert_close(leave_one_out(stacked).mean, leave_one_out(model).mean)
    with pytest.raises(ValueError, match="pass `noise`"):
        stacked.condition_on_observations(Z, new_Y)


@pytest.mark.parametrize("holds_samples", [True, False])
def test_fantasies_of_each_component(data, models, weights, Z, holds_samples):
    X, Y = data
    other = PhysicsMeanGP(X, Y, 0.1, physics=f_p)
    models["mean"] = held(other, 3, 0) if holds_samples else other
    stacked = StackedGP(models, weights, num_components=4)
    sampler = SobolQMCNormalSampler(torch.Size([3]), seed=0)
    fantasies = stacked.fantasize(Z.unsqueeze(1), sampler)
    sure = fantasies.posterior(Z.unsqueeze(1)).variance
    assert sure.shape == (3, 5, 4, 1, 2)
    assert (sure < stacked.posterior(Z.unsqueeze(1)).variance).all()
    drawn = sampler(stacked.posterior(Z.unsqueeze(1), observation_noise=True))
    moved = fantasies.posterior(Z.unsqueeze(1)).mean - stacked.posterior(Z.unsqueeze(1)).mean
    drawn = drawn - stacked.posterior(Z.unsqueeze(1)).mean
    assert (moved.sign() == drawn.sign()).all()  # each goes after its own observation
    value = qNegIntegratedPosteriorVariance(stacked.subset_output([0]), X)(Z.unsqueeze(1))
    assert value.shape == (5,)


def test_a_posterior_transform(models, weights, Z):
    both = StackedGP(models, weights, num_components=4)
    sum_of_both = ScalarizedPosteriorTransform(torch.tensor([1.0, 0.01]).double())
    posterior = both.posterior(Z, posterior_transform=sum_of_both)
    expected = both.posterior(Z).mean @ torch.tensor([1.0, 0.01]).double()
    torch.testing.assert_close(posterior.mean.squeeze(-1), expected)


def test_whole_numbers_by_the_largest_remainders():
    for weights, expected in (
        ([0.5, 0.3, 0.2], [4, 2, 2]),
        ([1.0, 0.0, 0.0], [8, 0, 0]),
        ([0.96, 0.02, 0.02], [8, 0, 0]),
    ):
        assert allocation(torch.tensor(weights).double(), 8) == expected


def test_bad_input(data, models, weights, Z):
    X, Y = data
    for given, share, says in (
        ({}, weights, "got none"),
        (models, weights[:1], "weights of shape"),
        (models, -weights, "not negative"),
        (models, weights / 2, "1 in all"),
        ({**models, "mean": PhysicsMeanGP(X + 1, Y, physics=f_p)}, weights, "same points and"),
    ):
        with pytest.raises(ValueError, match=says):
            StackedGP(given, share)
    with pytest.raises(TypeError, match=r"models by name.*got a list"):
        StackedGP([*models.values()], weights)
    with pytest.raises(TypeError, match="got a Linear as 'mean'"):
        StackedGP({**models, "mean": torch.nn.Linear(1, 1)}, weights)
    with pytest.raises(TypeError, match="weights as a tensor"):
        StackedGP(models, [[1.0], [0.5, 0.5]])
    with pytest.raises(ValueError, match="num_components"):
        StackedGP(models, weights, num_components=0)
    stacked = StackedGP(models, weights, num_components=4)
    for call in (
        lambda: stacked.subset_output([2]),
        lambda: stacked.interval(Z, 2.0),
        lambda: stacked.condition_on_observations(Z, Y),
    ):
        with pytest.raises(ValueError, match=r"Expected|level must be"):
            call()
