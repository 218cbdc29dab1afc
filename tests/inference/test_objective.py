"""The objective of the fit: GPyTorch's marginal likelihood, concentrated or not; its vectors."""

import math

import gpytorch
import pytest
import torch
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.priors import GammaPrior, LogNormalPrior
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import LogNormal, Normal

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.gp.gaussian import log_likelihood, negative_log_likelihood, nugget
from gpadjust.inference import register_priors
from gpadjust.inference.targets import LogLikelihood, LogPosterior, Target
from gpadjust.models.parameters import KINDS
from tests.systems import crude, line, ripple, uniform


class Gain(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(1.3, dtype=torch.float64))

    def forward(self, X):
        return self.gain * ripple(X)


def with_priors(X, Y, first, second=None):
    batch = torch.Size([2])
    base = RBFKernel(batch_shape=batch, lengthscale_prior=first)
    kernel = ScaleKernel(base, batch_shape=batch, outputscale_prior=second).double()
    return CKA(X, Y, physics=ripple, delta_covar_module=kernel)


def prior_of_what_is_fixed(X, Y):
    model = with_priors(X, Y, GammaPrior(3.0, 6.0), GammaPrior(2.0, 0.5))
    model.terms[1].kernel.raw_outputscale.requires_grad_(False)
    return model


def fixed_noise(X, Y):
    model = CKA(X, Y, physics=ripple)
    model.likelihood.requires_grad_(False).noise = 1e-11
    return model


def learnt_basis(X, Y):
    model = CKA(X, Y, physics=ripple, rho_mean="learn")
    term = model.terms[0]
    scale = torch.nn.Parameter(term.basis.scale.clone())
    del term.basis.scale
    term.basis.register_parameter("scale", scale)
    return model


def cka(**options):
    return lambda X, Y: CKA(X, Y, **{"physics": ripple, **options})


MEANS = {"rho_mean": "learn", "delta_mean": "learn"}
BUILD = {
    "prior of what is fixed": prior_of_what_is_fixed,
    "fixed noise": fixed_noise,
    "learnt basis": learnt_basis,
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": lambda X, Y: PhysicsMeanGP(X, Y, physics=ripple),
    "ScaleGP": lambda X, Y: ScaleGP(X, Y, physics=ripple),
    "CKA": cka(),
    "known noise": cka(train_Yvar=0.01),
    "learnt means": cka(**MEANS),
    "learnt center": cka(center="learn"),
    "learnt center and means": cka(center="learn", **MEANS),
    "two physics": cka(physics=[ripple, lambda X: X], rho_mean=[1.0, 0.5]),
    "learnt physics": lambda X, Y: CKA(X, Y, physics=Gain()),
    "learnt physics and means": lambda X, Y: CKA(X, Y, physics=Gain(), **MEANS),
    "prior": lambda X, Y: with_priors(X, Y, LogNormalPrior(0.0, 1.0)),
    "other priors": lambda X, Y: with_priors(X, Y, GammaPrior(3.0, 6.0), GammaPrior(2.0, 0.5)),
    "AR1": lambda X, Y: AR1(X, Y, physics=ripple, bounds=torch.tensor([[0.0, 0], [1, 1]])),
    "RRA": lambda X, Y: RRA(X, Y, physics=ripple, num_features=16),
}


@pytest.fixture
def XY(uniform):
    X = uniform(9, 2)
    return X, 1.5 * ripple(X) + X.flip(-1)


@pytest.fixture(params=list(BUILD))
def model(request, XY):
    """Two outputs of two inputs."""
    return BUILD[request.param](*XY)


def exact(model):
    """GPyTorch's negative log marginal likelihood, one number for each problem."""
    model.train()
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    with gpytorch.settings.cholesky_jitter(double_value=0.0), torch.no_grad():
        value = mll(model(*model.train_inputs), model.train_targets, *model.train_inputs)
    return -value * model.train_targets.shape[-1]


def neighbours(objective, k=3, spread=0.2):
    generator = torch.Generator().manual_seed(1)
    current = objective.parameters.current()
    return current + spread * torch.randn(
        k, *current.shape[1:], generator=generator, dtype=torch.float64
    )


def log_scale(objective, vectors):
    """The logarithm of the factor that brings all variances to their best scale, ``k x B``."""
    change = (objective.at_best_scale(vectors)[0] - vectors) * objective.parameters.variances
    return change.sum(-1) / objective.parameters.variances.sum(-1)


def assert_gradient(objective, vectors, tolerance=1e-4):
    """By finite differences."""
    values, gradient = objective.value_and_gradient(vectors)
    torch.testing.assert_close(values, objective(vectors))
    for i in range(vectors.shape[-1]):
        step = torch.zeros_like(vectors)
        step[..., i] = 1e-5
        difference = (objective(vectors + step) - objective(vectors - step)) / 2e-5
        torch.testing.assert_close(gradient[..., i], difference, rtol=tolerance, atol=tolerance)


def test_it_is_gpytorchs_likelihood_and_its_gradient_that_of_finite_differences(model):
    for kind in (LogLikelihood, Target, LogPosterior):
        objective = kind(model)
        assert_gradient(objective, neighbours(objective, 2))
    objective = Target(model)
    vectors = neighbours(objective)
    values = objective(vectors)
    assert values.shape == (3, objective.parameters.num_problems)
    for vector, value in zip(vectors, values, strict=True):
        objective.assign(vector)
        expected = exact(model)
        if objective.parameters.num_problems == 1:
            expected = expected.sum().reshape(1)
        torch.testing.assert_close(value, expected, rtol=1e-8, atol=1e-8)


def test_rows_are_those_of_a_model_of_them(XY):
    X, Y = XY
    rows = torch.tensor([0, 2, 3, 6, 8])
    options = {"physics": ripple, "outcome_transform": None, "center": 0.0}
    part = Target(CKA(X, Y, **options), rows=rows)
    alone = Target(CKA(X[rows], Y[rows], **options))
    vectors = neighbours(alone)
    torch.testing.assert_close(part(vectors), alone(vectors), rtol=1e-9, atol=1e-9)


def test_a_covariance_that_is_not_positive_definite_is_infinitely_bad(XY):
    X = XY[0][:, :1]
    objective = Target(CKA(X, ripple(X), torch.full_like(X, 1e-6), physics=ripple))
    vectors = objective.parameters.current().repeat(2, 1, 1)
    vectors[1] = 800.0
    values, gradient = objective.value_and_gradient(vectors)
    assert values.isfinite().tolist() == [[True], [False]]
    assert values[1] == math.inf
    assert gradient.isfinite().all()
    assert (gradient[1] == 0).all()


class TestConcentration:
    @settings(max_examples=10, deadline=None, derandomize=True)
    @given(
        name=st.sampled_from(["CKA", "PhysicsMeanGP", "ZeroMeanGP", "learnt means"]),
        seed=st.integers(0, 2**31),
        factor=st.floats(1e-6, 1e6),
    )
    def test_a_common_factor_of_the_variances_makes_no_difference(self, name, seed, factor):
        X = uniform(9, 2, seed=seed)
        objective = LogLikelihood(BUILD[name](X, 1.5 * ripple(X) + X.flip(-1)))
        assert objective.concentrated
        variances = objective.parameters.variances
        point = objective.parameters.current()
        moved = point + math.log(factor) * variances
        torch.testing.assert_close(objective(moved), objective(point), rtol=1e-8, atol=1e-8)
        _, gradient = objective.value_and_gradient(point)
        along = (gradient * variances).sum(-1)
        torch.testing.assert_close(along, torch.zeros_like(along), rtol=0, atol=1e-6)
        change = log_scale(objective, point) - log_scale(objective, moved)
        expected = torch.full_like(change, math.log(factor))
        torch.testing.assert_close(change, expected, rtol=0, atol=1e-6)

    @pytest.mark.parametrize("name", ["known noise", "prior", "other priors", "learnt physics"])
    def test_it_is_not_for_models_with_a_scale_of_their_own(self, XY, name):
        assert not LogLikelihood(BUILD[name](*XY)).concentrated

    def test_it_is_the_marginal_likelihood_at_the_best_scale(self, XY):
        model = BUILD["CKA"](*XY)
        concentrated, marginal = LogLikelihood(model), Target(model)
        point, variances = concentrated.parameters.current(), concentrated.parameters.variances
        best, values = concentrated.at_best_scale(point)
        torch.testing.assert_close(values, concentrated(point), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(marginal(best), concentrated(point), rtol=1e-9, atol=1e-9)
        for other in (-0.1, 0.1):
            assert (marginal(best + other * variances) > marginal(best)).all()

    @pytest.mark.parametrize("excess", [-0.5, 0.5, 3.0])
    def test_as_far_as_the_noise_keeps_to_its_least_value(self, XY, excess):
        model = BUILD["CKA"](*XY)
        with torch.no_grad():
            for term in model.terms:  # well conditioned without noise
                term.kernel.base_kernel.raw_lengthscale.fill_(-2.5)
            model.likelihood.noise_covar.raw_noise.fill_(-20.0)
        objective, marginal = LogLikelihood(model), Target(model)
        parameters, point = objective.parameters, objective.parameters.current()
        bound = parameters.lower - log_scale(objective, point).unsqueeze(-1) - excess
        point = torch.where(parameters.noise > 0, bound, point)
        assert_gradient(objective, point)
        at_scale, _ = objective.at_best_scale(point)
        torch.testing.assert_close(objective(point), marginal(at_scale), rtol=1e-9, atol=1e-9)
        objective.assign(point[0])
        size = (XY[1] - ripple(XY[0])).square().mean(0).minimum(XY[1].var(0, correction=0))
        floor = KINDS["noise"].bounds[0] * size
        ratio = model.likelihood.noise.mT * model.outcome_transform.stdvs.square() / floor
        expected = torch.full_like(ratio, math.exp(max(0.0, -excess)))
        torch.testing.assert_close(ratio, expected, rtol=1e-6, atol=0)


def test_packing_is_undone_and_bounds_hold_the_start_and_the_draws(model):
    objective = LogLikelihood(model)
    parameters, vectors = objective.parameters, neighbours(objective)
    assert torch.equal(parameters.flatten(parameters.unflatten(vectors)), vectors)
    parameters.assign(vectors[1])
    torch.testing.assert_close(parameters.current()[0], vectors[1], rtol=1e-12, atol=1e-12)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if parameter.requires_grad:
                change = 30.0 * torch.randn_like(parameter)
                parameter += change.abs() if "noise" in name else change
    parameters = LogLikelihood(model).parameters
    drawn = parameters.draw(50, torch.Generator().manual_seed(0))
    assert drawn.isfinite().all()
    for vectors in (parameters.current(), drawn):
        assert torch.equal(parameters.clipped(vectors), vectors)


class TestVagueTrend:
    def test_what_the_prior_of_a_trend_costs(self):
        # delta is nearly linear at this lengthscale, so that its variance is that of a line.
        X = line(9)
        model = CKA(X, ripple(X) + 3 + 2 * X, physics=ripple)
        model.terms[1].kernel.base_kernel.lengthscale = 100.0
        model.likelihood.noise = 1e-2

        def slope(kind):
            objective = kind(model)
            values = []
            for variance in (1e5, 1e7):
                model.terms[1].kernel.outputscale = variance
                vector = objective.parameters.current()
                # Without what a density of logarithms has beside.
                logs = vector.sum() if objective.of_logs else 0.0
                values.append((objective(vector) + logs).item())
            return (values[1] - values[0]) / math.log(100)

        # Level and slope cost half a logarithm of the variance each.
        assert slope(Target) == pytest.approx(1.0, abs=0.05)
        assert slope(LogPosterior) == pytest.approx(0.0, abs=0.05)
        model = ZeroMeanGP(X, 1 + X)
        model.terms[0].kernel.base_kernel.lengthscale = 10.0
        model.likelihood.noise = 1e-6
        objective, values = LogPosterior(model), []
        for variance in (1e-4, 1e3):
            model.terms[0].kernel.outputscale = variance
            values.append(objective(objective.parameters.current()).item())
        assert values[0] > values[1] + 100
        X = torch.rand(9, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        Y, values = X[:, :1].sin() + X[:, 1:], []
        for unit in (1.0, 1e7):
            units = torch.tensor([unit, 1.0])
            objective = LogPosterior(ZeroMeanGP(X * units, Y))
            vector = objective.parameters.current()
            # The density of a logarithm has no units.
            logs = vector.sum(-1)
            values.append(objective(vector) + logs)
        torch.testing.assert_close(values[0], values[1], rtol=1e-6, atol=1e-6)

    @pytest.mark.parametrize(
        "inputs", ["constant", "collinear", "few points", "all equal", "constant where observed"]
    )
    def test_inputs_without_slopes_of_their_own(self, inputs):
        X = torch.rand(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        X[:, 1] = {"constant": 0.7, "collinear": 2 * X[:, 0]}.get(inputs, X[:, 1])
        X = X[:3] if inputs == "few points" else X
        X = torch.full_like(X, 0.1) if inputs == "all equal" else X
        Y = torch.linspace(0, 1, len(X), dtype=torch.float64).unsqueeze(-1).sin()
        if inputs == "constant where observed":
            X[:7, 1] = 0.3
            Y = torch.cat([Y, Y.masked_fill((torch.arange(12) >= 7).unsqueeze(-1), math.nan)], -1)
        objective = LogPosterior(ZeroMeanGP(X, Y))
        assert_gradient(objective, neighbours(objective, 1))


def test_it_is_the_textbooks(XY):
    model = BUILD["known noise"](*XY)
    target, inputs = Target(model), model.transform_inputs(model.train_inputs[0])
    with torch.no_grad():
        covariance = model.covar_module(inputs).to_dense() + torch.diag_embed(model.noise.known)
        residual = model.train_targets - model.mean_module(inputs)
        added = nugget(len(XY[0])) * covariance.diagonal(dim1=-1, dim2=-2)
        expected = log_likelihood(residual, covariance + torch.diag_embed(added))
        value = target(target.parameters.current())[0]
    torch.testing.assert_close(-value, expected, rtol=1e-12, atol=1e-12)
    fast = negative_log_likelihood(residual, covariance.clone()).value
    torch.testing.assert_close(-fast, expected, rtol=1e-12, atol=1e-12)


# The default priors, and densities of priors in an objective


def priors(model):
    return {name: prior for name, _, prior, _, _ in model.named_priors()}


def test_densities(build, data, num_outputs):
    X, Y = data(num_outputs=num_outputs)
    X = X * torch.tensor([1.0, 100.0])
    model = build(
        "CKA", X, Y, physics=lambda X: 3 + X[..., :1].expand_as(Y), outcome_transform=None
    )
    register_priors(model)
    found = priors(model)
    v = (Y - 3 - X[:, :1]).square().mean(0).minimum(Y.var(0, correction=0))
    length = (X.amax(0) - X.amin(0)) * 2
    lengths, rho, delta = length.repeat(num_outputs), "terms.0.kernel", "terms.1.kernel"
    medians = {
        "likelihood.noise_covar.noise_prior": (1e-3 * v, 4),
        f"covar_module.{delta}.outputscale_prior": (v, 6),
        f"covar_module.{rho}.outputscale_prior": (v * 0 + 0.01, 4),
        f"covar_module.{delta}.base_kernel.lengthscale_prior": (lengths, 2),
        f"covar_module.{rho}.base_kernel.lengthscale_prior": (lengths, 2),
    }
    assert set(found) == set(medians)
    for name, (middle, sd) in medians.items():
        actual = found[name].log_prob(torch.full_like(found[name].loc, 0.7)).flatten()
        expected = LogNormal(middle.log(), sd).log_prob(torch.full_like(middle, 0.7))
        torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_of_ar1(build, data, num_outputs, unit):
    X, Y = data(num_outputs=num_outputs)
    model = build("AR1", X, unit * Y)
    register_priors(model)
    ratio = model.data()["train_Y"].std(0) / model.data()["low_Y"].std(0)
    expected = Normal(1.0, (1 + ratio.square()).sqrt()).log_prob(2.5 * ratio)
    prior = priors(model)["covar_module.terms.0.basis.rho_prior"]
    actual = prior.log_prob((2.5 * ratio).reshape(prior.loc.shape))
    torch.testing.assert_close(actual.flatten(), expected)
    noise = priors(model)["likelihood.noise_covar.noise_prior"]
    initial = model.likelihood.noise.detach()  # a hundredth of the typical size
    torch.testing.assert_close(noise.loc, (0.1 * initial).log())
    assert (noise.scale == 4).all()


def test_priors_and_fixed_parameters_of_the_user(data):
    X, Y = data()
    own = GammaPrior(3.0, 6.0)
    kernel = ScaleKernel(RBFKernel(ard_num_dims=2, lengthscale_prior=own))
    model = CKA(X, Y, center=0.0, physics=lambda X: crude(X)[..., :1], rho_covar_module=kernel)
    model.terms[1].kernel.raw_outputscale.requires_grad_(False)
    register_priors(model)
    assert kernel.base_kernel.lengthscale_prior is own
    assert not hasattr(model.terms[1].kernel, "outputscale_prior")
    before = priors(model)
    register_priors(model)
    assert priors(model) == before
    model = CKA(X, Y, physics=lambda X: crude(X)[..., :1])
    kernel = model.terms[0].kernel
    values = []
    for i, prior in enumerate([LogNormalPrior(0.1, 0.7), LogNormalPrior(-2.0, 0.3)]):
        kernel.register_prior(f"prior_{i}", prior, "outputscale")
        target = Target(model)
        values.append(target(target.parameters.current()))
    added = LogNormalPrior(-2.0, 0.3).log_prob(kernel.outputscale.detach())
    torch.testing.assert_close(values[1] - values[0], -added.reshape(1, 1))


@pytest.mark.parametrize("kind", ["CKA", "AR1", "RRA", "ScaleGP"])
def test_objective_is_gpytorchs_log_posterior(build, data, shuffle, kind, num_outputs):
    model = build(kind, *data(num_outputs=num_outputs))
    register_priors(model)
    shuffle(model)
    objective = Target(model)
    model.train()
    inputs = model.train_inputs[0]
    likelihood = model.likelihood(model(inputs), model.transform_inputs(inputs))
    expected = likelihood.log_prob(model.train_targets).sum() + sum(
        prior.log_prob(read(module)).sum() for _, module, prior, read, _ in model.named_priors()
    )
    value = objective(objective.parameters.current())
    torch.testing.assert_close(-value.sum(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("prior", [None, GammaPrior(3.0, 6.0), LogNormalPrior(0.1, 0.7)])
def test_potential_has_the_jacobian_of_the_logarithm(data, prior):
    X, Y = data()
    kernel = ScaleKernel(RBFKernel(ard_num_dims=2, lengthscale_prior=prior))
    model = CKA(X, Y, center=0.0, physics=lambda X: crude(X)[..., :1], rho_covar_module=kernel)
    register_priors(model)
    objective = Target(model)
    of_logs = LogPosterior(model)
    of_logs._trend = None
    potential = of_logs.value_and_gradient
    settings = objective.parameters.current() + 0.1
    value, gradient = potential(settings)
    # All parameters are positive and sampled as logarithms.
    torch.testing.assert_close(value, objective(settings) - settings.sum(-1))
    step = 1e-5 * torch.eye(settings.shape[-1], dtype=torch.float64).unsqueeze(-2)
    numeric = (potential(settings + step)[0] - potential(settings - step)[0]) / 2e-5
    torch.testing.assert_close(gradient[0, 0], numeric[:, 0], rtol=1e-5, atol=1e-5)
