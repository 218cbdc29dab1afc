"""Unknown parameters of a physics, learnt with all else."""

import math

import pytest
import torch

from gpadjust import AR1, CKA, CalibratedPhysics, FunctionPhysics, PhysicsMeanGP, Unknown, fit
from gpadjust.gp import OrthogonalKernel
from gpadjust.inference import ParameterWarning
from gpadjust.inference.calibration import Calibration
from gpadjust.models import orthogonal_rbf
from gpadjust.physics import BlackBoxPhysics, PhysicsError
from tests.systems import line, refused

A, B = 1.3, 0.4
PRIORS = {"a": Unknown(1.0, sd=0.5), "b": Unknown(-1.0, sd=2.0)}
NOISE = 0.3


def lines(X, p):
    """Two outputs that are linear in two parameters."""
    return torch.stack([p.a * X[:, 0] + p.b * X[:, 1], p.a - p.b * X[:, 0]], dim=-1)


def growth(X, p):
    """Saturating growth."""
    return p.a * (1 - (-p.b * X[:, 0]).exp())


def data(n=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 2, generator=generator, dtype=torch.float64)
    p = FunctionPhysics(lines, unknowns=PRIORS)
    Y = p(X, torch.tensor([A, B], dtype=torch.float64))
    return X, Y + NOISE * torch.randn(n, 2, generator=generator, dtype=torch.float64)


def linear_regression(X, Y, covariance):
    """Mean and covariance of the parameters of ``lines``, in plain linear algebra."""
    one, seen = torch.ones(len(X), dtype=torch.float64), ~Y.T.reshape(-1).isnan()
    G = torch.cat([X, torch.stack([one, -X[:, 0]], dim=-1)])[seen]
    K = torch.block_diag(covariance, covariance)[seen][:, seen]
    prior, guess = torch.tensor([4.0, 0.25]).double().diag(), torch.tensor([1.0, -1.0]).double()
    precision = prior + G.T @ torch.linalg.solve(K, G)
    pull = prior @ guess + G.T @ torch.linalg.solve(K, Y.T.reshape(-1)[seen])
    return torch.linalg.solve(precision, pull), precision.inverse()


def test_a_linear_physics_with_known_noise_is_bayesian_linear_regression():
    X, Y = data()
    mean, covariance = linear_regression(X, Y, NOISE**2 * torch.eye(len(X)).double())
    model = CalibratedPhysics(X, Y, NOISE**2, physics=FunctionPhysics(lines, unknowns=PRIORS))
    fit(model, "map")
    torch.testing.assert_close(model.physics_parameters.mean, mean, rtol=1e-5, atol=1e-6)
    assert (fit(model).effective_size > 200).all()
    found, sd = model.physics_parameters, covariance.diagonal().sqrt()
    assert ((found.mean - mean).abs() < 0.25 * sd).all()
    torch.testing.assert_close(found.sd, sd, rtol=0.2, atol=0)
    correlation = torch.corrcoef(found.draws.T)[0, 1]
    expected = covariance[0, 1] / sd.prod()
    assert abs(correlation - expected) < 0.2


def test_draws_given_a_discrepancy_are_those_of_generalised_least_squares():
    X, Y = data()
    model = PhysicsMeanGP(
        X, Y, NOISE**2, physics=FunctionPhysics(lines, unknowns=PRIORS), outcome_transform=None
    )
    model.covar_module.requires_grad_(False)
    model.covar_module.terms[1].kernel.outputscale = 0.2
    model.covar_module.terms[1].kernel.base_kernel.lengthscale = 0.7
    distance = torch.cdist(X / 0.7, X / 0.7)
    K = 0.2 * (-0.5 * distance.square()).exp() + NOISE**2 * torch.eye(len(X)).double()
    mean, covariance = linear_regression(X, Y, K)
    fit(model)
    found, sd = model.physics_parameters, covariance.diagonal().sqrt()
    assert ((found.mean - mean).abs() < 0.25 * sd).all()
    torch.testing.assert_close(found.sd, sd, rtol=0.2, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model_class", [CalibratedPhysics, PhysicsMeanGP, pytest.param(CKA, marks=pytest.mark.slow)]
)
def test_a_nonlinear_physics_is_found_from_far(model_class):
    X = line(15, 0.1, 3)
    unknowns = {"a": Unknown(1.0, factor=4.0), "b": Unknown(8.0, factor=4.0)}
    law = FunctionPhysics(growth, unknowns=unknowns)
    Y = law(X, torch.tensor([5.0, 1.0], dtype=torch.float64))
    model = model_class(X, Y, physics=law)
    fit(model)
    truth = torch.tensor([5.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(model.physics_parameters.mean, truth, rtol=1e-2, atol=0)
    torch.testing.assert_close(model.predict(X).mean, Y, rtol=1e-3, atol=1e-3)


def test_a_black_box_is_calibrated_by_differences():
    X = line(12, 0.1, 3)
    law = BlackBoxPhysics(
        lambda x, p: p.a * (1 - math.exp(-p.b * x[0])),
        batched=False,
        unknowns={"a": Unknown(4.0, factor=2.0), "b": Unknown(1.5, factor=2.0)},
    )
    model = CalibratedPhysics(X, 5 * (1 - (-X).exp()), physics=law)
    fit(model, "map")
    truth = torch.tensor([5.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(model.physics_parameters.mean, truth, rtol=1e-4, atol=0)


def test_missing_observations_do_not_count():
    X, Y = data(14)
    Y[3:6, 0] = Y[9, 1] = torch.nan
    mean, _ = linear_regression(X, Y, NOISE**2 * torch.eye(len(X)).double())
    model = CalibratedPhysics(X, Y, NOISE**2, physics=FunctionPhysics(lines, unknowns=PRIORS))
    fit(model, "map")
    torch.testing.assert_close(model.physics_parameters.mean, mean, rtol=1e-5, atol=1e-6)


def test_parameters_at_which_the_physics_fails_are_avoided():
    def root(X, p):
        if (p.a < 0.5).any():
            raise PhysicsError("the root is not real", (p.a < 0.5).nonzero().flatten().tolist())
        return (p.a - 0.5).sqrt() * X[:, 0]

    X = line(9, 0.1, 1)
    law = FunctionPhysics(root, unknowns={"a": Unknown(1.5, sd=1.0)})
    generator = torch.Generator().manual_seed(0)
    Y = 0.3 * X + 0.1 * torch.randn(9, 1, generator=generator, dtype=torch.float64)
    model = CalibratedPhysics(X, Y, physics=law)
    fit(model)
    assert (model.physics_parameters["a"] >= 0.5).all()
    assert model.physics_parameters["a"].std() > 0


def failing_above(limit, by):
    def law(X, p):
        if by == "error" and (p.a > limit).any():
            raise PhysicsError("it cannot run", (p.a > limit).nonzero().flatten().tolist())
        return torch.where(p.a > limit, torch.nan, p.a) * X[:, 0] + p.b

    return FunctionPhysics(law, unknowns={"a": Unknown(1.0, sd=1.0), "b": Unknown(0.0, sd=1.0)})


@pytest.mark.parametrize("by", ["nan", "error"])
@pytest.mark.parametrize("method", ["map", "bayes"])
def test_a_physics_that_fails_beside_the_best_parameters_is_told(by, method):
    X = line(9, 0.1, 1)
    model = CKA(X, 2 * X + 0.1, physics=failing_above(1.5, by))
    before = {name: value.clone() for name, value in model.named_parameters()}
    refused(ValueError, r"a = 1\.50.*bounds", fit, model, method)
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())
    inside = CalibratedPhysics(X, 1.2 * X + 0.1, 1e-4, physics=failing_above(1.4, by))
    fit(inside, "map")
    assert inside.physics_parameters.mean[0].item() == pytest.approx(1.2, abs=0.02)


def test_parameters_that_nothing_tells_and_priors_that_are_contradicted_are_named():
    X, unknown = line(8), Unknown(1.0, sd=1.0)
    unknowns = {"a": unknown, "b": unknown, "c": unknown}
    law = FunctionPhysics(lambda X, p: (p.a + p.b) * X[:, 0] + p.c, unknowns=unknowns)
    with pytest.warns(ParameterWarning, match="nothing of a, b of"):
        fit(CalibratedPhysics(X, 2 * X + 1, 0.01, physics=law))
    law = FunctionPhysics(lambda X, p: p.a * X[:, 0], unknowns={"a": Unknown(1000.0, sd=1.0)})
    with pytest.warns(ParameterWarning, match="prior disagree about a of"):
        fit(CalibratedPhysics(X, 2 * X, 0.01, physics=law))


@pytest.mark.slow
def test_a_discrepancy_that_is_orthogonal_leaves_the_best_fit_to_the_parameters():
    X = line(17, 0.02, 1)
    truth = 4 * X + X * (5 * X).sin()  # Plumlee (2017)
    Y = truth + 0.02 * torch.randn(17, 1, generator=torch.Generator().manual_seed(0)).double()
    law = FunctionPhysics(lambda X, p: p.a * X[:, 0], unknowns={"a": Unknown(3.0, sd=2.0)})
    best = (X * truth).sum() / X.square().sum()
    free = PhysicsMeanGP(X, Y, physics=law)
    orthogonal = PhysicsMeanGP(X, Y, physics=law, covar_module=orthogonal_rbf)
    widths = []
    for model in (free, orthogonal):
        fit(model)
        low, high = model.physics_parameters.interval()
        assert low < best < high
        widths.append(high - low)
    assert widths[1] < 0.1 * widths[0]
    kernel = orthogonal.covar_module.terms[1].kernel
    assert isinstance(kernel, OrthogonalKernel)
    functions = orthogonal.sample_functions(32, seed=0)(X).squeeze(-1)
    parameter = (functions @ X.squeeze(-1)) / X.square().sum()
    assert abs(parameter.mean() - best) < 0.02
    assert (orthogonal.predict(X).mean - truth).abs().max() < 0.05


def test_the_linearisation_is_that_of_autograd():
    X = line(6, 0.1, 3)
    unknowns = {"a": Unknown(4.0, sd=2.0), "b": Unknown(1.5, bounds=(0.0, 4.0))}
    law = FunctionPhysics(growth, unknowns=unknowns)
    model = PhysicsMeanGP(X, law(X, torch.tensor([5.0, 1.0]).double()), physics=law)
    calibration = Calibration(model.train())
    z = torch.tensor([0.3, -0.7], dtype=torch.float64)
    near = calibration.linearized(z)
    scale = model.outcome_transform.stdvs.item()

    def mean(z):
        return law(X, law.unknowns.at(z)).squeeze(-1) / scale

    slope = torch.autograd.functional.jacobian(mean, z)
    torch.testing.assert_close(near.slope[0], slope, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(near.residual[0], model.train_targets - mean(z))


def test_what_other_outputs_say_is_a_prior_to_each():
    X, Y = data()
    law = FunctionPhysics(lines, unknowns=PRIORS)
    calibration = Calibration(CalibratedPhysics(X, Y, NOISE**2, physics=law).train())
    z, variance = torch.tensor([0.3, -0.7], dtype=torch.float64), 0.3
    near = calibration.linearized(z)
    covariance = variance * torch.eye(len(X)).double().expand(2, -1, -1)
    information = calibration.information(near, calibration.factor(covariance))
    found = calibration.marginalized(near, information)
    for i in range(2):
        own, G, r = near.slope[i], near.slope[1 - i], near.residual[1 - i]
        prior = torch.linalg.inv(torch.eye(2).double() + G.T @ G / variance)
        mean = prior @ G.T @ (r + G @ z) / variance
        torch.testing.assert_close(found.mean[i], own @ (mean - z), rtol=1e-5, atol=1e-8)
        torch.testing.assert_close(found.covariance[i], own @ prior @ own.T, rtol=1e-5, atol=1e-8)


def test_what_cannot_be_calibrated_is_told_and_a_failed_fit_leaves_the_model(monkeypatch):
    X, Y = data()
    law = FunctionPhysics(lines, unknowns=PRIORS)
    silent = CKA(X, Y, physics=law, rho_mean=0.0)
    refused(ValueError, r"nothing.*rho_mean=1\.0", fit, silent, "map")
    batch = CKA(X.expand(2, -1, -1), Y.expand(2, -1, -1), physics=law)
    refused(ValueError, r"one data set.*unknown", fit, batch, "map")
    refused(ValueError, r"AR1.*a, b\. CKA", AR1, X, Y, physics=law, bounds=[[0.0, 0.0], [1.0, 1.0]])
    model = PhysicsMeanGP(X, Y, physics=FunctionPhysics(lines, unknowns=PRIORS))
    before = {name: value.clone() for name, value in model.named_parameters()}

    def stopped(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(Calibration, "newton", stopped)  # when hyper-parameters have been found
    with pytest.raises(KeyboardInterrupt):
        fit(model, "map")
    for name, value in model.named_parameters():
        assert torch.equal(value, before[name]), name


@pytest.mark.filterwarnings("ignore::gpadjust.inference.ParameterWarning")
def test_a_curved_ridge_is_followed():
    X = line(20, 0, 3)
    unknowns = {"a": Unknown(1.5, sd=0.7), "k": Unknown(1.5, sd=0.7)}
    law = FunctionPhysics(lambda X, p: p.a * p.k * (-0.8 * X[:, 0]).exp(), unknowns=unknowns)
    generator = torch.Generator().manual_seed(0)
    Y = 2 * (-0.8 * X).exp() + 0.03 * torch.randn(20, 1, generator=generator, dtype=torch.float64)
    model = CalibratedPhysics(X, Y, 0.03**2, physics=law)
    result = fit(model)
    assert result.effective_size > 200
    grid = torch.linspace(0.02, 4, 400, dtype=torch.float64)
    a, k = torch.meshgrid(grid, grid, indexing="ij")
    basis = (-0.8 * X.squeeze(-1)).exp()
    size, cross = basis @ basis, basis @ Y.squeeze(-1)
    product = a * k
    log_density = -(0.5 * product.square() * size - product * cross) / 0.03**2
    log_density -= 0.5 * (((a - 1.5) / 0.7) ** 2 + ((k - 1.5) / 0.7) ** 2)
    marginal = (log_density - log_density.max()).exp().sum(1)
    below = marginal.cumsum(0) / marginal.sum()
    low, high = (grid[(below < q).sum()] for q in (0.025, 0.975))
    found = model.physics_parameters.interval()
    assert (found[1][0] - found[0][0]).item() == pytest.approx((high - low).item(), rel=0.1)
