"""Full Bayes, the default of `fit`."""

import sys
from copy import deepcopy

import pyro
import pytest
import torch
from gpytorch.constraints import GreaterThan, Interval
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import LogNormalPrior
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.inference import SampleResult, SamplingWarning, bayes, register_priors
from gpadjust.inference.optimise import Search, optima
from gpadjust.inference.proposals import Both, Mixture, laplace_root
from gpadjust.inference.targets import LogPosterior
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import Sine, refused, ripple

quick = pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")  # few draws
SHORT = {"num_samples": 8, "num_draws": 64, "num_starts": 1, "num_screened": 8}


@pytest.fixture
def XY(uniform):
    X = uniform(8, 1)
    return X, 1.5 * ripple(X) + X + 0.02 * torch.randn(8, 1, dtype=torch.float64)


@pytest.mark.slow
@quick
@pytest.mark.parametrize("kind", ["ZeroMeanGP", "ScaleGP", "CKA", "AR1", "RRA"])
def test_result_and_model(build, data, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs))
    learnt = {n: p.shape for n, p in model.named_parameters() if p.requires_grad}
    shapes = {name.replace("raw_", ""): shape for name, shape in learnt.items()}
    result = fit(model, "bayes", **SHORT)
    assert isinstance(result, SampleResult)
    expected = (num_outputs,) if num_outputs > 1 else ()
    assert result.effective_size.shape == expected
    count = len(result.draws["likelihood.noise_covar.noise"])
    assert 8 <= count <= 256
    assert {name: draws.shape for name, draws in result.draws.items()} == {
        name: (count, *shape) for name, shape in shapes.items()
    }
    assert model.num_samples == 8
    assert not model.training
    assert model.posterior(uniform(4, 2)).mean.shape == (8, 4, num_outputs)
    assert len(repr(result)) < 500  # without the draws
    for name, values in model.named_parameters():
        if name == "likelihood.noise_covar.raw_noise":  # samples of the model are draws
            draws = result.draws[name.replace("raw_", "")]
            are = [torch.isclose(draws, v.exp(), rtol=1e-9).any(0).squeeze(-1) for v in values]
            share = torch.ones(()) if result.relevance is None else result.relevance
            assert (torch.stack(are).double().mean(0) > share - 0.1).all()  # others have no physics


@quick
def test_seed_and_global_state(XY):
    models = [CKA(*XY, physics=ripple) for _ in range(3)]
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    for model, seed in zip(models, (0, 0, 1), strict=True):
        # Without a search, whose seed it is, too.
        fit(model, "bayes", seed=seed, **SHORT | {"num_screened": 0})
    assert torch.equal(torch.rand(1), expected)
    noise = [model.likelihood.noise for model in models]
    assert torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0], noise[2])


def test_a_warning_when_the_draws_are_not_of_the_posterior(XY, monkeypatch):
    result = fit(CKA(*XY, physics=ripple), **SHORT)
    size = result.effective_size
    assert result.converged.all()
    assert 1 <= size <= len(result.draws["likelihood.noise_covar.noise"])
    monkeypatch.setattr(bayes, "_OFF", -1.0)
    with pytest.warns(SamplingWarning, match=rf"sample size {size.item():.2g}\). Raise num_draws"):
        again = fit(CKA(*XY, physics=ripple), **SHORT)
    assert not again.converged.any()


@pytest.mark.parametrize(("many", "tries"), [(150, 2), (5, 1)])
def test_draws_of_no_density_are_tried_around_the_optima_once(XY, monkeypatch, many, tries):
    """With the prior among them first, of few observations."""
    begun = []

    def nothing(density, proposal, *args):
        begun.append(proposal)
        raise FloatingPointError

    monkeypatch.setattr(bayes, "MANY", many)
    monkeypatch.setattr(bayes.annealing, "sample", nothing)
    refused(RuntimeError, "likelihood", fit, ZeroMeanGP(*XY), "bayes", **SHORT)
    assert [type(each) for each in begun] == [Both, Mixture][-tries:]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")  # of one of six
@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_it_errs_less_than_a_point_estimate_and_its_intervals_hold(noise):
    # A quadratic function, of which the physics has another one; eleven points in two dimensions.
    def truth(X):
        return X[:, :1].square() + 2 * X[:, 1:].square() + X[:, :1] * X[:, 1:]

    def physics(X):
        return 0.5 * X[:, :1].square() + X[:, 1:]

    generator = torch.Generator().manual_seed(0)
    Z = torch.rand(200, 2, generator=generator, dtype=torch.float64)
    covered, ratios = [], []
    for _ in range(6):
        X = torch.rand(11, 2, generator=generator, dtype=torch.float64)
        Y = truth(X) + noise * torch.randn(11, 1, generator=generator, dtype=torch.float64)
        models = [CKA(X, Y, physics=physics) for _ in range(2)]
        fit(models[0], "map")
        fit(models[1])
        point, full = (model.predict(Z).mean - truth(Z) for model in models)
        ratios.append((full.square().mean() / point.square().mean()).log() / 2)
        low, high = models[1].interval(Z)
        covered.append(((low <= truth(Z)) & (truth(Z) <= high)).double().mean())
    assert sum(ratios) / 6 < (-0.05 if noise else 0.05)  # a point estimate is certain of no noise
    assert sum(covered) / 6 > 0.9


@pytest.mark.slow
def test_a_physics_that_learns_is_at_its_most_likely_parameters(XY):
    physics, other = Sine(2.0, 2.0), Sine(2.0, 2.0)
    options = {"num_starts": 2, "num_screened": 16}
    model = CKA(*XY, physics=physics)
    fit(model, num_draws=64, **options)
    fit(CKA(*XY, physics=other), "map", **options)
    assert model.num_samples == 16
    assert physics.rate.requires_grad
    assert physics.rate.item() == pytest.approx(other.rate.item(), rel=1e-6)
    assert physics.rate.item() != 2.0


def best_of(objective):
    """The best optimum of one output, ``1 x p``."""
    found, values = optima(objective, Search())
    return found[values[:, 0].argmin()]


def test_laplaces_root_is_triangular_and_of_the_inverse_of_the_hessian(XY):
    model = CKA(*XY, physics=ripple)
    register_priors(model)
    objective = LogPosterior(model)
    optimum = best_of(objective)
    (root,) = laplace_root(objective, optimum.unsqueeze(0))
    assert (root.triu(1) == 0).all()
    precision = torch.linalg.inv(root @ root.mT)[0]
    step = 0.1 * torch.eye(len(precision), dtype=torch.float64).unsqueeze(1)
    change = [objective.value_and_gradient(optimum + sign * step)[1] for sign in (1, -1)]
    hessian = (change[0] - change[1])[:, 0] / 0.2
    # No direction is wider than four, in logarithms.
    values, vectors = torch.linalg.eigh((hessian + hessian.mT) / 2)
    expected = vectors @ torch.diag(values.clamp_min(1 / 16)) @ vectors.mT
    torch.testing.assert_close(precision, expected, rtol=1e-6, atol=1e-6)


def nuts(model, num_samples, num_warmup, num_chains=2, seed=0):
    """The oracle: Pyro's NUTS on the potential that the library samples from, of one output.

    Draws of the vectors, ``num_samples x num_chains x p``.
    """
    target = deepcopy(model)
    register_priors(target)
    objective = LogPosterior(target)
    optimum = best_of(objective)

    class Energy(torch.autograd.Function):
        @staticmethod
        def forward(ctx, vectors):
            value, gradient = objective.value_and_gradient(vectors.unsqueeze(0))
            allowed = objective.parameters.is_allowed(vectors.unsqueeze(0))
            value = value.where(allowed, torch.inf)
            gradient = gradient * allowed.unsqueeze(-1)
            ctx.save_for_backward(gradient.squeeze(0))
            # Pyro takes no infinite energies.
            return value.nan_to_num(posinf=1e8).sum()

        @staticmethod
        def backward(ctx, outer):
            (gradient,) = ctx.saved_tensors
            return outer * gradient

    chains = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(num_chains):
            start = objective.parameters.clipped(optimum + 0.3 * torch.randn_like(optimum))
            mcmc = MCMC(
                NUTS(potential_fn=lambda parameters: Energy.apply(parameters["vectors"])),
                num_samples=num_samples,
                warmup_steps=num_warmup,
                initial_params={"vectors": start},
                disable_progbar=True,
            )
            mcmc.run()
            chains.append(mcmc.get_samples()["vectors"].squeeze(1))
    return torch.stack(chains, dim=1)


@pytest.mark.slow
def test_nuts_agrees(XY):
    model = CKA(*XY, physics=ripple, center=0.0)
    # With the vague defaults NUTS needs very long.
    prior, kernel = LogNormalPrior(-1.0, 1.0), model.terms[1].kernel
    kernel.register_prior("outputscale_prior", prior, "outputscale")
    noise = model.likelihood.noise_covar
    noise.register_prior("noise_prior", LogNormalPrior(-6.0, 0.7), "noise")
    expected = nuts(model, num_samples=600, num_warmup=200)
    result = fit(model, num_draws=8192)
    assert result.effective_size > 200
    draws = torch.cat([each.reshape(len(each), -1).log() for each in result.draws.values()], -1)
    assert draws.shape[-1] == expected.shape[-1] == 5
    sizes = result.effective_size, effective_sample_size(expected, chain_dim=1, sample_dim=0)
    second = expected.flatten(0, 1)
    middle, width = second.mean(0), second.std(0)
    for own, other in (
        ((draws - middle) / width, (second - middle) / width),
        (((draws - middle) / width).abs(), ((second - middle) / width).abs()),
    ):
        error = (own.var(0) / sizes[0] + other.var(0) / sizes[1]).sqrt()
        assert ((own.mean(0) - other.mean(0)).abs() < 4 * error).all()
        assert error.max() < 0.15


@pytest.mark.slow
def test_pyros_nuts_in_gpytorchs_way(XY):
    X, Y = XY
    model = CKA(X, Y, physics=ripple)
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
@pytest.mark.parametrize(
    ("lengths", "noises", "options"),
    [
        (Interval(0.1, 0.5), GreaterThan(1e-2), SHORT),
        # So narrow that few of the starts keep to them.
        (Interval(0.9, 10.0), Interval(1e-3, 1.1e-3), {"num_screened": 32}),
    ],
    ids=["wide", "narrow"],
)
def test_constraints_hold(XY, lengths, noises, options):
    base = RBFKernel(ard_num_dims=1, lengthscale_constraint=lengths)
    likelihood = GaussianLikelihood(noise_constraint=noises)
    model = CKA(*XY, physics=ripple, delta_covar_module=ScaleKernel(base), likelihood=likelihood)
    fit(model, "bayes", **options)
    length, noise = model.terms[1].kernel.base_kernel.lengthscale, model.likelihood.noise
    for values, limits in ((length, lengths), (noise, noises)):
        assert ((values >= limits.lower_bound) & (values <= limits.upper_bound)).all()
    assert all(parameter.isfinite().all() for parameter in model.parameters())
    assert model.predict(XY[0]).mean.isfinite().all()


class TestBeforeAndAfter:
    """A fit does not depend on what the model did before."""

    def test_the_most_likely_values_after_samples(self, XY):
        first, second = (CKA(*XY, physics=ripple) for _ in range(2))
        fit(first)
        found = fit(first, "map").log_likelihood
        torch.testing.assert_close(found, fit(second, "map").log_likelihood, rtol=1e-4, atol=1e-4)
        assert first.terms[0].basis.center.item() == 0.0


@pytest.mark.slow
def test_narrow_constraints_are_kept(uniform):
    X = uniform(20, 8)
    base = RBFKernel(ard_num_dims=8, lengthscale_constraint=Interval(0.9, 1.1))
    kernel = {"delta_covar_module": ScaleKernel(base)}
    model = CKA(X, X.sum(-1, keepdim=True).sin(), physics=lambda X: X[:, :1], **kernel)
    fit(model)
    assert ((base.lengthscale >= 0.9) & (base.lengthscale <= 1.1)).all()
    assert model.predict(X).mean.isfinite().all()


@pytest.mark.slow
def test_draws_for_arviz(monkeypatch):
    X = torch.linspace(0, 1, 6, dtype=torch.float64).unsqueeze(-1)
    law = FunctionPhysics(lambda X, p: p.slope * X[:, 0], unknowns={"slope": Unknown(1.0, sd=1.0)})
    model = PhysicsMeanGP(X, 2 * X, physics=law)
    result = fit(model, num_samples=4)
    tree = pytest.importorskip("arviz_base") and result.to_arviz()
    for name, draws in result.draws.items():
        assert tree["posterior"][name].shape == (1, *draws.shape)
    slopes = tree["posterior"]["physics.slope"].to_numpy()[0]
    assert abs(slopes.mean() - model.physics_parameters["slope"].mean()) < 1e-9
    monkeypatch.setitem(sys.modules, "arviz_base", None)
    refused(ImportError, r"gpadjust\[arviz\]", result.to_arviz)
