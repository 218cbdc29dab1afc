"""BoTorch's `fit_gpytorch_mll` ends where the library's own search ends, noise or none."""

import warnings

import pytest
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.fit import fit_gpytorch_mll
from botorch.models import ModelListGP
from botorch.optim.fit import fit_gpytorch_mll_scipy
from gpytorch.mlls import (
    ExactMarginalLogLikelihood,
    LeaveOneOutPseudoLikelihood,
    SumMarginalLogLikelihood,
)
from gpytorch.priors import LogNormalPrior

from gpadjust import CalibratedPhysics, fit
from gpadjust.inference.targets import LogLikelihood
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import line, refused


def own_likelihood(model):
    """The log likelihood where the model is, unknown means at their best."""
    objective = LogLikelihood(model)
    objective.concentrated = False  # at the model's own scale
    value = -objective(objective.parameters.current()).sum().item()
    model.eval()
    return value


def fit_by_botorch(model, of=ExactMarginalLogLikelihood, **options):
    """The mll that comes back; a failed line search is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", OptimizationWarning)
        mll = of(model.likelihood, model)
        assert fit_gpytorch_mll(mll, **options) is mll
    assert not mll.training
    assert not model.training
    return mll


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:f_p is nearly zero")
@pytest.mark.parametrize(
    ("noise", "unit", "n"),
    [(0.0, 1e-6, 5), (0.1, 1.0, 12), (1e-6, 1.0, 12), (0.0, 1e6, 12), (0.1, 1e6, 60)],
)
def test_as_likely_as_the_search(data, build, kind, num_outputs, noise, unit, n):
    X, Y = data(n=max(n, 8) if kind == "AR1" else n, num_outputs=num_outputs, seed=n)
    Y = unit * (Y + noise * Y.std(0) * torch.randn_like(Y))
    columns = slice(2 - num_outputs, 2)  # the sum, and for two outputs one of it
    f_p = {"physics": lambda X: unit * X.sin().cumsum(-1)[..., columns]}
    options = {} if kind == "ZeroMeanGP" else f_p
    model, searched = build(kind, X, Y, **options), build(kind, X, Y, **options)
    fit_by_botorch(model)
    fit(searched, "map")
    assert own_likelihood(model) > own_likelihood(searched) - 0.1


def test_parameters_of_the_physics():
    t = line(8, 0.1)
    law = FunctionPhysics(
        lambda t, p: 0.5 * p.g * t[:, 0] ** 2, unknowns={"g": Unknown(9.0, sd=1.0)}
    )
    model = CalibratedPhysics(t, 0.5 * 9.81 * t**2, physics=law)
    fit_by_botorch(model)
    assert model.physics_parameters.mean.item() == pytest.approx(9.81, abs=1e-3)


def test_missing_targets_priors_and_what_is_fixed(data, build):
    X, Y = data(n=12, num_outputs=2)
    Y[3, 0] = torch.nan
    model = build("CKA", X, Y)
    before = own_likelihood(model)
    fit_by_botorch(model)
    assert own_likelihood(model) > before + 1
    X, Y = data(n=12)
    free, held = build("CKA", X, Y), build("CKA", X, Y)
    for model in (free, held):
        kernel = model.terms[1].kernel.base_kernel
        if model is held:
            kernel.register_prior("lengthscale_prior", LogNormalPrior(0.0, 1e-3), "lengthscale")
        fit_by_botorch(model)
    assert (kernel.lengthscale.log().abs() < 0.1).all()
    assert (free.terms[1].kernel.base_kernel.lengthscale.log().abs() > 0.2).any()
    model = build("CKA", X, Y)
    rest = model.terms[0].kernel.raw_outputscale.requires_grad_(False)
    before, other = rest.clone(), model.terms[1].kernel.raw_outputscale.clone()
    fit_by_botorch(model)
    assert torch.equal(rest, before)
    assert not torch.equal(model.terms[1].kernel.raw_outputscale, other)


@pytest.mark.filterwarnings("ignore:A not p.d., added jitter")
@pytest.mark.parametrize("kind", ["CKA", pytest.param("RRA", marks=pytest.mark.slow)])
def test_each_model_of_a_list(data, build, kind, uniform):
    X, Y = data(n=12, num_outputs=2)
    Y = Y + 0.01 * torch.randn_like(Y)  # variances of a list are BoTorch's, with its least one
    models = [build(kind, X, Y[:, :1]), build("PhysicsMeanGP", X[2:], Y[2:, :1])]
    before = [own_likelihood(model) for model in models]
    both, Z = ModelListGP(*models), uniform(5, 4, 2)
    fit_gpytorch_mll(SumMarginalLogLikelihood(both.likelihood, both))
    assert all(own_likelihood(m) > b + 1 for m, b in zip(models, before, strict=True))
    posterior = both.posterior(Z)
    assert posterior.mean.shape == (5, 4, 2)
    torch.testing.assert_close(posterior.mean[..., :1], models[0].posterior(Z).mean)
    torch.testing.assert_close(posterior.variance[..., 1:], models[1].posterior(Z).variance)


def test_a_model_that_holds_samples_is_refused(data, build):
    model = build("CKA", *data(n=12))
    fit(model, num_samples=2, num_draws=64)
    refused(RuntimeError, "holds samples", fit_by_botorch, model)
    assert model.num_samples == 2


class TestWhatTheCallerAsksFor:
    @pytest.fixture
    def model(self, data, build):
        X, Y = data(n=12)
        return build("CKA", X, Y + 0.1 * torch.randn_like(Y))

    def test_optimizer(self, model):
        calls = []

        def optimizer(mll, **options):
            calls.append(options)
            return fit_gpytorch_mll_scipy(mll, **options)

        fit_by_botorch(model, optimizer=optimizer, optimizer_kwargs={"method": "SLSQP"})
        assert [call["method"] for call in calls] == ["SLSQP"]

    def test_another_objective(self, data, build):
        X, Y = data(n=12)
        model, found = build("CKA", X, Y, torch.full_like(Y, 0.01)), []
        for of in (ExactMarginalLogLikelihood, LeaveOneOutPseudoLikelihood):
            fit_by_botorch(model, of)
            mll = LeaveOneOutPseudoLikelihood(model.likelihood, model).train()
            with torch.no_grad():
                found.append(mll(model(*model.train_inputs), model.train_targets).item())
            model.eval()
        assert found[1] > found[0]
