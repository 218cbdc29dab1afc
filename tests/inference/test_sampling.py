"""Full Bayes by `fit(model, "hmc")` and `"nuts"`."""

import warnings

import pyro
import pytest
import torch
from botorch.models import ModelListGP, SingleTaskGP
from gpytorch.constraints import GreaterThan, Interval
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import LogNormalPrior
from pyro.infer import MCMC, NUTS

from gpadjust import CKA, BiasGP, fit
from gpadjust.inference import register_priors
from gpadjust.inference.sampling import SampleResult, SamplingWarning
from gpadjust.validation.plots import plot_adjustment, plot_adjustment_pair, plot_prediction

quick = pytest.mark.filterwarnings(
    "ignore::gpadjust.inference.sampling.SamplingWarning"  # few iterations mix badly
)
SHORT = {"num_samples": 8, "num_warmup": 8, "num_starts": 1, "num_screened": 8}


def crude(X):
    return 2 + (3 * X[..., :1]).sin()


@pytest.fixture
def XY(uniform):
    X = uniform(8, 1)
    return X, 1.5 * crude(X) + X + 0.02 * torch.randn(8, 1, dtype=torch.float64)


@quick
@pytest.mark.parametrize("kind", ["ZeroMeanGP", "ScaleGP", "CKA", "AR1", "RRA"])
def test_result_and_model(build, data, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs))
    learnt = {n: p.shape for n, p in model.named_parameters() if p.requires_grad}
    shapes = {name.replace("raw_", ""): shape for name, shape in learnt.items()}
    result = fit(model, "hmc", **SHORT)
    assert isinstance(result, SampleResult)
    expected = (num_outputs,) if num_outputs > 1 else ()
    for each in (result.r_hat, result.effective_sample_size, result.acceptance):
        assert each.shape == expected
    assert {name: draws.shape[2:] for name, draws in result.draws.items()} == shapes
    assert model.num_samples == 8
    assert not model.training
    assert model.posterior(uniform(4, 2)).mean.shape == (8, 4, num_outputs)
    lengthscales = [draws for name, draws in result.draws.items() if "lengthscale" in name]
    assert all((draws > 0).all() for draws in lengthscales)


@quick
def test_samples_of_the_model_are_draws(XY):
    model = CKA(*XY, physics=crude)
    result = fit(model, "hmc", **SHORT)
    name = "likelihood.noise_covar.noise"
    draws = result.draws[name].flatten(0, 1)
    for noise in model.likelihood.noise:
        assert torch.isclose(draws, noise, rtol=1e-9).any()
    # The constraint of a default parameter does not bound its draws, but the model's value.
    assert (model.likelihood.noise > 0).all()


@quick
@pytest.mark.parametrize("method", ["hmc", pytest.param("nuts", marks=pytest.mark.slow)])
def test_seed_and_global_state(XY, method):
    models = [CKA(*XY, physics=crude) for _ in range(3)]
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    for model, seed in zip(models, (0, 0, 1), strict=True):
        fit(model, method, seed=seed, **SHORT)
    assert torch.equal(torch.rand(1), expected)
    noise = [model.likelihood.noise for model in models]
    assert torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0], noise[2])


@quick
def test_model_list(XY):
    X, Y = XY
    models = ModelListGP(CKA(X, Y, physics=crude), BiasGP(X[:6], Y[:6], physics=crude))
    results = fit(models, "hmc", **SHORT)
    assert [type(result) for result in results] == [SampleResult] * 2
    assert models.posterior(X).mean.shape == (8, 8, 2)


@quick
def test_figures(XY, build, data):
    X, Y = XY
    model = CKA(X, Y, physics=crude)
    fit(model, "hmc", **SHORT)
    ax = plot_prediction(model, X, Y)
    drawn = next(line for line in ax.lines if line.get_label() == "mean").get_ydata()
    expected = model.predict(X.sort(0).values).mean[:, 0]
    torch.testing.assert_close(torch.as_tensor(drawn), expected)
    assert plot_adjustment(model, num_points=5).shape == (2, 1)
    two = build("CKA", *data(num_outputs=2))
    fit(two, "hmc", **SHORT)
    assert plot_adjustment_pair(two, output=1, num_points=4).shape == (2, 2)


def test_a_warning_when_chains_do_not_mix(XY):
    with pytest.warns(SamplingWarning, match="have not mixed"):
        fit(CKA(*XY, physics=crude), "hmc", num_warmup=8, num_samples=2000)


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "match"),
        [
            ({"num_samples": 0}, "num_samples >= 1"),
            ({"num_warmup": 7}, "num_warmup >= 8"),
            ({"num_starts": 0}, "num_starts >= 1"),
        ],
    )
    def test_options(self, XY, options, match):
        with pytest.raises(ValueError, match=match):
            fit(CKA(*XY, physics=crude), "hmc", **options)

    def test_method(self, XY):
        with pytest.raises(ValueError, match="'map', 'hmc' or 'nuts'"):
            fit(CKA(*XY, physics=crude), "gibbs")

    def test_other_models(self, XY):
        with pytest.raises(TypeError, match="ZeroMeanGP"):
            fit(SingleTaskGP(*XY), "hmc")

    def test_a_physics_that_learns(self, XY):
        physics = torch.nn.Linear(1, 1, dtype=torch.float64)
        model = CKA(*XY, physics=physics)
        before = {name: p.clone() for name, p in model.named_parameters()}
        with pytest.raises(ValueError, match="requires_grad_"):
            fit(model, "hmc", num_starts=1, num_screened=2, max_iterations=2)
        assert model.num_samples is None
        assert all(torch.equal(p, before[name]) for name, p in model.named_parameters())


def logs(result):
    """Draws of the logarithms of the hyper-parameters, by name, ``N`` each."""
    return {
        f"{name}[{i}]": column.log()
        for name, draws in result.draws.items()
        for i, column in enumerate(draws.flatten(0, 1).reshape(-1, draws[0, 0].numel()).mT)
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The chains")  # the effective sample sizes are allowed for
def test_hmc_and_nuts_agree(XY):
    marginals, sizes = [], []
    for method, num_samples in (("hmc", 1600), ("nuts", 600)):
        model = CKA(*XY, physics=crude)
        register_priors(model)
        # With the vague defaults NUTS needs very long.
        model.delta_covar_module.register_prior(
            "outputscale_prior",
            LogNormalPrior(-1.0, 1.0),
            lambda m: m.outputscale,
            lambda m, v: m._set_outputscale(v),
        )
        result = fit(model, method, num_samples=num_samples, num_warmup=200)
        marginals.append(logs(result))
        sizes.append(result.effective_sample_size.item())
    first, second = marginals
    for name, draws in first.items():
        other = second[name]
        error = (draws.var() / sizes[0] + other.var() / sizes[1]).sqrt()
        assert (draws.mean() - other.mean()).abs() < 4 * error, name
        assert 0.7 < draws.std() / other.std() < 1.4, name


@pytest.mark.slow
def test_pyros_nuts_in_gpytorchs_way(XY):
    X, Y = XY
    model = CKA(X, Y, physics=crude)
    register_priors(model)
    model.train()

    def pyro_model(x, y):
        sampled = model.pyro_sample_from_prior()
        pyro.sample("obs", sampled.likelihood(sampled(x)), obs=y)

    pyro.clear_param_store()
    sampler = MCMC(NUTS(pyro_model, max_tree_depth=4), 6, warmup_steps=10, disable_progbar=True)
    sampler.run(model.train_inputs[0], model.train_targets)
    samples = sampler.get_samples()
    model.pyro_load_from_samples(samples)
    model.eval()
    noise = samples["likelihood.noise_covar.noise_prior"]
    torch.testing.assert_close(model.likelihood.noise.flatten(), noise.flatten())


@quick
@pytest.mark.parametrize("method", ["hmc", "nuts"])
def test_constraints_hold(XY, method):
    base = RBFKernel(ard_num_dims=1, lengthscale_constraint=Interval(0.1, 0.5))
    model = CKA(
        *XY,
        physics=crude,
        delta_covar_module=ScaleKernel(base),
        likelihood=GaussianLikelihood(noise_constraint=GreaterThan(1e-2)),
    )
    fit(model, method, **SHORT)
    lengthscale = model.delta_covar_module.base_kernel.lengthscale
    assert ((lengthscale >= 0.1) & (lengthscale <= 0.5)).all()
    assert (model.likelihood.noise >= 1e-2).all()
    assert model.predict(XY[0]).mean.isfinite().all()


def test_the_result_prints_in_a_few_lines(XY):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        assert len(repr(fit(CKA(*XY, physics=crude), "hmc", **SHORT))) < 500
