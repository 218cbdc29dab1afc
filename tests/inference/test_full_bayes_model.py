"""A model that holds samples of its hyper-parameters is the mixture of the samples' models."""

from copy import deepcopy

import pytest
import torch
from botorch.acquisition import (
    LogExpectedImprovement,
    qLogExpectedImprovement,
    qLogNoisyExpectedImprovement,
    qNegIntegratedPosteriorVariance,
)
from botorch.acquisition.bayesian_active_learning import qBayesianActiveLearningByDisagreement
from botorch.acquisition.monte_carlo import qPosteriorStandardDeviation
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.kernels import MaternKernel, ScaleKernel
from torch import Size

from gpadjust import fit
from gpadjust.validation import leave_one_out
from tests.systems import refused

KINDS = ["ZeroMeanGP", "ScaleGP", "CKA", "AR1", "RRA"]


def matern(m):
    batch = Size([m]) if m > 1 else Size()
    return ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=2, batch_shape=batch), batch_shape=batch)


VARIANTS = {
    "Matern": ("CKA", lambda m: {"rho_covar_module": matern(m), "delta_covar_module": matern(m)}),
    "Normalize": ("CKA", lambda m: {"input_transform": Normalize(2)}),
    "centerd": ("CKA", lambda m: {"center": "mean"}),
    "learnt center": ("CKA", lambda m: {"center": "learn"}),
    "learnt means": (
        "CKA",
        lambda m: {"center": "mean", "rho_mean": "learn", "delta_mean": "learn"},
    ),
}
_NAMES = [*KINDS, *VARIANTS, "CKA-known", "AR1-known"]
_QUICK = ["CKA", "AR1", "RRA", "learnt means", "learnt center", "Normalize", "CKA-known"]
CASES = [pytest.param(name, marks=() if name in _QUICK else pytest.mark.slow) for name in _NAMES]


@pytest.fixture(params=CASES)
def case(request, num_outputs, data, build, held):
    """The name, a model that holds three samples, and the models of each."""
    name = request.param
    X, Y = data(num_outputs=num_outputs)
    if name.endswith("-known"):
        Yvar = 1e-3 * (1 + X.sum(-1, keepdim=True)).expand_as(Y)
        return name, *held(name.removesuffix("-known"), X, Y, Yvar)
    kind, options = VARIANTS.get(name, (name, lambda m: {}))
    # Modules are built anew for each model.
    return name, *held(make=lambda: build(kind, X, Y, **options(num_outputs)))


def check(actual, posteriors, close):
    mean = torch.stack([posterior.mean for posterior in posteriors], dim=-3)
    variance = torch.stack([posterior.variance for posterior in posteriors], dim=-3)
    assert isinstance(actual, GaussianMixturePosterior)
    close(actual.mean, mean)
    close(actual.variance, variance)
    close(actual.mixture_mean, mean.mean(-3))
    spread = (mean - mean.mean(-3, keepdim=True)).square().mean(-3)
    close(actual.mixture_variance, variance.mean(-3) + spread)


@pytest.mark.parametrize("shape", [(4,), (5, 4), (2, 3, 1)])
def test_posteriors(case, uniform, close, shape):
    _, model, singles = case
    Z, m = uniform(*shape, 2, high=2.0), model.num_outputs
    for noise in (False, True):
        expected = [single.posterior(Z, observation_noise=noise) for single in singles]
        check(model.posterior(Z, observation_noise=noise), expected, close)
    for name in {"rho", "delta"} & {*model.term_names}:
        check(model.term(name, Z, mixed=False), [single.term(name, Z) for single in singles], close)
    for noise in (False, True):
        expected = model.posterior(Z.unsqueeze(-2), observation_noise=noise)
        mean, variance = model.predict(Z, observation_noise=noise)
        close(mean, expected.mixture_mean.squeeze(-2))
        close(variance, expected.mixture_variance.squeeze(-2))
    given = uniform(*shape, m)
    close(model.predict(Z, given).variance, model.predict(Z).variance + given)


def test_what_is_refused(held, build, data, uniform):
    (X, Y), (model, _) = data(), held("CKA", *data())
    refused(RuntimeError, "holds samples", model.train)
    refused(RuntimeError, "holds samples", model.hold_samples, {})
    fantasies = model.fantasize(uniform(1, 2), SobolQMCNormalSampler(Size([5]), seed=0))
    refused(RuntimeError, "fantasies", fantasies.release_samples)
    refused(ValueError, "one data set", fit, build("CKA", *data(batch_shape=(2,))), "bayes")
    refused(TypeError, "ZeroMeanGP", fit, SingleTaskGP(X / 2, Y), "bayes")


class TestObservations:
    def test_conditioning_of_each_sample(self, held, data, uniform, close):
        model, singles = held("CKA", *data(num_outputs=2))
        X, Y = data(batch_shape=(3,), n=2, num_outputs=2, seed=1)
        Z = uniform(4, 2, high=2.0)
        each = [
            single.condition_on_observations(x, y)
            for single, x, y in zip(singles, X, Y, strict=True)
        ]
        actual = model.condition_on_observations(X, Y)
        check(actual.posterior(Z), [single.posterior(Z) for single in each], close)

    def test_leave_one_out_and_conditioning(self, case, close, data, uniform):
        _, model, singles = case
        loo = leave_one_out(model)
        parts = [leave_one_out(single) for single in singles]
        close(loo.X, parts[0].X)
        close(loo.Y, parts[0].Y)
        mean = torch.stack([part.mean for part in parts])
        variance = torch.stack([part.variance for part in parts])
        weight = 1 / torch.distributions.Normal(mean, variance.sqrt()).log_prob(loo.Y).exp()
        weight = (weight / weight.sum(0)).clamp_max(3**-0.5)
        weight = weight / weight.sum(0)
        close(loo.mean, (weight * mean).sum(0))
        second = (weight * (variance + (mean - loo.mean).square())).sum(0)
        close(loo.variance, second)
        name, model, singles = case
        Z, m = uniform(4, 2, high=2.0), model.num_outputs
        for seed in (1, 2):
            X, Y = data(n=2, num_outputs=m, seed=seed)
            noise = {"noise": torch.full_like(Y, 1e-3)} if "known" in name else {}
            model = model.condition_on_observations(X, Y, **noise)
            singles = [single.condition_on_observations(X, Y, **noise) for single in singles]
            check(model.posterior(Z), [single.posterior(Z) for single in singles], close)
            close(model.predict(Z).mean, model.posterior(Z).mixture_mean)


def test_leave_one_out_is_the_posterior_without_the_observation(held, data):
    # A prior of weights 1 / p(y | sample) makes equal weights the exact posterior.
    X, Y = data()
    model, singles = held("CKA", X, Y, spread=0.02, outcome_transform=None)

    def log_likelihood(single, keep):
        inputs = single.train_inputs[0][keep]
        prior = single.likelihood(single.forward(inputs))
        return prior.log_prob(single.train_targets[keep])

    loo = leave_one_out(model)
    means = torch.stack([leave_one_out(single).mean[:, 0] for single in singles])
    every = torch.arange(len(X))
    for i in every:
        changes = [log_likelihood(s, every != i) - log_likelihood(s, every) for s in singles]
        expected = torch.stack(changes).softmax(0) @ means[:, i]
        torch.testing.assert_close(loo.mean[i, 0], expected, rtol=1e-8, atol=1e-8)


class TestFunctions:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        "kind",
        [pytest.param(k, marks=() if k in ("CKA", "RRA") else pytest.mark.slow) for k in KINDS],
    )
    def test_moments(self, kind, held, data, uniform, num_outputs):
        model, _ = held(kind, *data(num_outputs=num_outputs))
        Z = uniform(3, 2, high=2.0)
        values = model.sample_functions(600, seed=0)(Z)
        assert values.shape == (600, 3, num_outputs)
        mean, variance = model.predict(Z)
        sd = variance.sqrt()
        # Rounding, where the model is all but sure.
        assert ((values.mean(0) - mean).abs() <= 0.15 * sd + 1e-6 * mean.abs()).all()
        assert (values.std(0) / sd - 1).abs().max() < 0.15

    def test_functions_after_conditioning(self, held, data):
        X, Y = data(num_outputs=2)
        model, _ = held("CKA", X, Y, torch.full_like(Y, 1e-4))
        new_X, new_Y = data(n=2, num_outputs=2, seed=1)
        model = model.condition_on_observations(new_X, new_Y, noise=torch.full_like(new_Y, 1e-4))
        values = model.sample_functions(4, seed=0)(new_X)
        torch.testing.assert_close(values, new_Y.expand_as(values), rtol=0, atol=0.1)


class TestCopies:
    @pytest.mark.parametrize("kind", ["CKA", "AR1", "RRA"])
    @pytest.mark.parametrize("indices", [[1], [1, 0]])
    def test_subset_of_outputs(self, held, data, uniform, close, kind, indices):
        model, _ = held(kind, *data(num_outputs=2))
        Z = uniform(4, 2, high=2.0)
        whole, subset = model.posterior(Z), model.subset_output(indices)
        for part in (subset.posterior(Z), model.posterior(Z, output_indices=indices)):
            close(part.mean, whole.mean[..., indices])
            close(part.mixture_variance, whole.mixture_variance[..., indices])
        close(subset.predict(Z).mean, whole.mixture_mean[..., indices])

    def test_copies_and_the_first_sample_after_release(self, case, uniform, close, build, data):
        name, model, _ = case
        Z = uniform(4, 2, high=2.0)
        expected = model.posterior(Z)
        copy = deepcopy(model)
        assert copy.num_samples == 3
        close(copy.posterior(Z).variance, expected.variance)
        if name in KINDS:
            other = build(name, *data(num_outputs=model.num_outputs))
            other.load_state_dict(model.state_dict())
            assert other.num_samples == 3
            close(other.posterior(Z).mean, expected.mean)
        name, model, singles = case
        Z, m = uniform(4, 2, high=2.0), model.num_outputs
        more = [uniform(2, 2, seed=3), uniform(2, m, seed=4)]
        noise = {"noise": torch.full_like(more[1], 1e-3)} if name.endswith("known") else {}
        if "AR1" not in name:
            model, *singles = (
                each.condition_on_observations(*more, **noise) for each in (model, singles[0])
            )
        assert model.posterior(Z).mean.shape[0] == 3
        model.release_samples()
        assert model.num_samples is None
        close(model.posterior(Z).mean, singles[0].posterior(Z).mean)
        close(model.posterior(Z).variance, singles[0].posterior(Z).variance)
        model.release_samples()

    def test_a_state_with_another_number_of_samples(self, held, data, build):
        model, _ = held("CKA", *data())
        fresh = build("CKA", *data())
        expected = model.train_targets
        with pytest.raises(RuntimeError, match=r"number.*release_samples\(\)"):
            model.load_state_dict(fresh.state_dict())
        assert model.num_samples == 3
        assert torch.equal(model.train_targets, expected)
        model.release_samples()
        model.load_state_dict(fresh.state_dict())


class TestLettingGo:
    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")
    def test_it_can_be_fitted_again(self, data, build):
        model, fresh = (build("CKA", *data(num_outputs=2)) for _ in range(2))
        options = {"num_screened": 16, "num_starts": 2}
        fit(model, num_draws=64, num_samples=4, **options)
        fit(model, num_draws=64, num_samples=6, **options)
        assert model.num_samples == 6
        found = fit(model, "map", **options).log_likelihood
        assert model.num_samples is None
        expected = fit(fresh, "map", **options).log_likelihood
        assert (found > expected - 1.0).all()

    def test_it_keeps_them_if_a_fit_fails(self, held, data, uniform):
        model, _ = held("CKA", *data())
        Z = uniform(4, 2)
        before = model.posterior(Z).mean
        refused(ValueError, "no option", fit, model, "map", num_samples=3)
        model.likelihood.noise_covar.raw_noise.requires_grad_(False)
        model.covar_module.requires_grad_(False)
        refused(ValueError, "no learnable parameter", fit, model, "map")
        assert model.num_samples == 3
        torch.testing.assert_close(model.posterior(Z).mean, before)


# BoTorch's acquisition functions on a fully Bayesian model


SAMPLER = {"sampler": SobolQMCNormalSampler(torch.Size([8]), seed=0)}
ACQUISITIONS = {
    "qLogNEI": lambda model, X: qLogNoisyExpectedImprovement(model, X, **SAMPLER),
    "qLogEI": lambda model, X: qLogExpectedImprovement(model, 1.0, **SAMPLER),
    "LogEI": lambda model, X: LogExpectedImprovement(model, best_f=1.0),
    "NIPV": lambda model, X: qNegIntegratedPosteriorVariance(model, mc_points=X),
    "PSTD": lambda model, X: qPosteriorStandardDeviation(model, **SAMPLER),
    "BALD": lambda model, X: qBayesianActiveLearningByDisagreement(model, **SAMPLER),
}


@pytest.mark.parametrize("name", list(ACQUISITIONS))
def test_gradients_through_the_physics(held, data, uniform, gradient_is_right, name):
    X, Y = data()
    model, _ = held("CKA", X, Y)
    gradient_is_right(ACQUISITIONS[name](model, X), uniform(1, 1, 2, high=2.0, seed=5))


def test_values_are_averages_over_the_samples(held, data, uniform):
    X, Y = data()
    model, singles = held("CKA", X, Y)
    Z, best = uniform(6, 1, 2, high=2.0), Y.mean()
    each = torch.stack([LogExpectedImprovement(single, best_f=best)(Z) for single in singles])
    actual = LogExpectedImprovement(model, best_f=best)(Z)
    torch.testing.assert_close(actual, each.exp().mean(0).log())
    each = [qNegIntegratedPosteriorVariance(single, mc_points=X)(Z) for single in singles]
    actual = qNegIntegratedPosteriorVariance(model, mc_points=X)(Z)
    torch.testing.assert_close(actual, torch.stack(each).mean(0))
