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

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.inference.objective import Objective
from gpadjust.models import PaperRRA
from gpadjust.models.hyperparameters import KINDS


def crude(X):
    return 2 + (3 * X).sin()


class Gain(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(1.3, dtype=torch.float64))

    def forward(self, X):
        return self.gain * crude(X)


def with_priors(X, Y, first, second=None):
    batch = torch.Size([2])
    base = RBFKernel(batch_shape=batch, lengthscale_prior=first)
    kernel = ScaleKernel(base, batch_shape=batch, outputscale_prior=second).double()
    return CKA(X, Y, physics=crude, delta_covar_module=kernel)


def prior_of_what_is_fixed(X, Y):
    model = with_priors(X, Y, GammaPrior(3.0, 6.0), GammaPrior(2.0, 0.5))
    model.terms[1].kernel.raw_outputscale.requires_grad_(False)
    return model


def fixed_noise(X, Y):
    model = CKA(X, Y, physics=crude)
    model.likelihood.requires_grad_(False).noise = 1e-11
    return model


def learnt_basis(X, Y):
    model = CKA(X, Y, physics=crude, rho_mean="learn")
    term = model.terms[0]
    scale = torch.nn.Parameter(term.basis.scale.clone())
    del term.basis.scale
    term.basis.register_parameter("scale", scale)
    return model


BUILD = {
    "prior of what is fixed": prior_of_what_is_fixed,
    "fixed noise": fixed_noise,
    "learnt basis": learnt_basis,
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": lambda X, Y: PhysicsMeanGP(X, Y, physics=crude),
    "ScaleGP": lambda X, Y: ScaleGP(X, Y, physics=crude),
    "CKA": lambda X, Y: CKA(X, Y, physics=crude),
    "known noise": lambda X, Y: CKA(X, Y, torch.full_like(Y, 0.01), physics=crude),
    "learnt means": lambda X, Y: CKA(X, Y, physics=crude, rho_mean="learn", delta_mean="learn"),
    "two physics": lambda X, Y: CKA(X, Y, physics=[crude, lambda X: X], rho_mean=[1.0, 0.5]),
    "learnt physics": lambda X, Y: CKA(X, Y, physics=Gain()),
    "learnt physics and means": lambda X, Y: CKA(
        X, Y, physics=Gain(), rho_mean="learn", delta_mean="learn"
    ),
    "prior": lambda X, Y: with_priors(X, Y, LogNormalPrior(0.0, 1.0)),
    "other priors": lambda X, Y: with_priors(X, Y, GammaPrior(3.0, 6.0), GammaPrior(2.0, 0.5)),
    "AR1": lambda X, Y: AR1(X, Y, physics=crude, bounds=torch.tensor([[0.0, 0], [1, 1]])),
    "RRA": lambda X, Y: RRA(X, Y, physics=crude, num_features=16),
    "PaperRRA": lambda X, Y: PaperRRA(X, Y, physics=crude, num_features=16),
}


@pytest.fixture
def XY(uniform):
    X = uniform(9, 2)
    return X, 1.5 * crude(X) + X.flip(-1)


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


def assert_gradient(objective, vectors):
    """By finite differences."""
    values, gradient = objective.value_and_gradient(vectors)
    torch.testing.assert_close(values, objective(vectors))
    for i in range(vectors.shape[-1]):
        step = torch.zeros_like(vectors)
        step[..., i] = 1e-5
        difference = (objective(vectors + step) - objective(vectors - step)) / 2e-5
        torch.testing.assert_close(gradient[..., i], difference, rtol=1e-4, atol=1e-4)


def test_it_is_gpytorchs_likelihood(model):
    objective = Objective(model, marginal=True)
    vectors = neighbours(objective)
    values = objective(vectors)
    assert values.shape == (3, objective.parameters.num_problems)
    for vector, value in zip(vectors, values, strict=True):
        objective.assign(vector)
        expected = exact(model)
        if objective.parameters.num_problems == 1:
            expected = expected.sum().reshape(1)
        torch.testing.assert_close(value, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("marginal", [False, True])
def test_its_gradient_is_that_of_finite_differences(model, marginal):
    objective = Objective(model, marginal=marginal)
    assert_gradient(objective, neighbours(objective, 2))


def test_rows_are_those_of_a_model_of_them(XY):
    X, Y = XY
    rows = torch.tensor([0, 2, 3, 6, 8])
    options = {"physics": crude, "outcome_transform": None}
    part = Objective(CKA(X, Y, **options), marginal=True, rows=rows)
    alone = Objective(CKA(X[rows], Y[rows], **options), marginal=True)
    vectors = neighbours(alone)
    torch.testing.assert_close(part(vectors), alone(vectors), rtol=1e-9, atol=1e-9)


def test_a_covariance_that_is_not_positive_definite_is_infinitely_bad(XY):
    X = XY[0][:, :1]
    objective = Objective(CKA(X, crude(X), torch.full_like(X, 1e-6), physics=crude), marginal=True)
    vectors = objective.parameters.current().repeat(2, 1, 1)
    vectors[1] = 800.0
    values, gradient = objective.value_and_gradient(vectors)
    assert values[0].isfinite()
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
        generator = torch.Generator().manual_seed(seed)
        X = torch.rand(9, 2, generator=generator, dtype=torch.float64)
        objective = Objective(BUILD[name](X, 1.5 * crude(X) + X.flip(-1)))
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
        assert not Objective(BUILD[name](*XY)).concentrated

    def test_it_is_the_marginal_likelihood_at_the_best_scale(self, XY):
        model = BUILD["CKA"](*XY)
        concentrated, marginal = Objective(model), Objective(model, marginal=True)
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
        objective, marginal = Objective(model), Objective(model, marginal=True)
        parameters, point = objective.parameters, objective.parameters.current()
        bound = parameters.lower - log_scale(objective, point).unsqueeze(-1) - excess
        point = torch.where(parameters.noise > 0, bound, point)
        assert_gradient(objective, point)
        at_scale, _ = objective.at_best_scale(point)
        torch.testing.assert_close(objective(point), marginal(at_scale), rtol=1e-9, atol=1e-9)
        objective.assign(point[0])
        floor = KINDS["noise"].bounds[0] * (XY[1] - crude(XY[0])).square().mean(0)
        ratio = model.likelihood.noise.mT * model.outcome_transform.stdvs.square() / floor
        expected = torch.full_like(ratio, math.exp(max(0.0, -excess)))
        torch.testing.assert_close(ratio, expected, rtol=1e-6, atol=0)


class TestVectors:
    def test_packing_is_undone(self, model):
        parameters = Objective(model).parameters
        vectors = neighbours(Objective(model))
        assert torch.equal(parameters.flatten(parameters.unflatten(vectors)), vectors)
        parameters.assign(vectors[1])
        torch.testing.assert_close(parameters.current()[0], vectors[1], rtol=1e-12, atol=1e-12)

    def test_bounds_hold_the_start_and_the_draws(self, model):
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if parameter.requires_grad:
                    change = 30.0 * torch.randn_like(parameter)
                    parameter += change.abs() if "noise" in name else change
        parameters = Objective(model).parameters
        drawn = parameters.draw(50, torch.Generator().manual_seed(0))
        assert drawn.isfinite().all()
        for vectors in (parameters.current(), drawn):
            assert torch.equal(parameters.clipped(vectors), vectors)
