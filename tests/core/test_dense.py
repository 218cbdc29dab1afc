"""Predictions, terms, left-out predictions and likelihoods against dense formulas."""

import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import core
from gpadjust.core import CKA, MATERN12, MATERN32, MATERN52, RRA, PhysicsMeanGP, Stationary
from tests.systems import crude


def second(X):
    return 1 + (2 * crude(X)).sin()


KERNELS = ("rho_covar_module", "delta_covar_module")
MODELS = {
    "CKA": (CKA, {}),
    "CKA without a center": (CKA, {"center": False, "nested": False}),
    "CKA without constants": (CKA, {"constants": False, "center": 0.0}),
    "Matern": (CKA, dict(zip(KERNELS, map(Stationary, (MATERN12, MATERN32)), strict=True))),
    "RRA": (RRA, {"num_features": 20}),
    "PhysicsMeanGP": (PhysicsMeanGP, {"covar_module": Stationary(MATERN52)}),
    "ScaleGP": (core.ScaleGP, {}),
    "ZeroMeanGP": (core.ZeroMeanGP, {}),
    "two physics": (CKA, {"rho_mean": [0.7, 0.2]}),
}


def problem(name, data, m, known=False, gaps=False, size=1.0, n=12, **options):
    """A model, its data, and its physics in the user's units."""
    X, Y = data(n=n, num_outputs=m)
    Y = size * Y
    if gaps:
        Y[2:4, 0] = Y[7, m - 1] = torch.nan
    cls, own = MODELS[name]
    physics = [lambda X: size * crude(X)[..., :m]]
    if name == "two physics":
        physics.append(lambda X: size * second(X)[..., :m])
    if name == "ZeroMeanGP":
        physics = []
    given = {"physics": physics if len(physics) > 1 else physics[0]} if physics else {}
    Yvar = (0.01 * size**2) * (1 + X[:, :1]) * torch.ones_like(Y) if known else None
    model = cls(X, Y, Yvar, **given, **own, **options)
    return model, X, Y, physics, Yvar


def agree(model, formula, Z, close, tolerance=1e-8):
    mean, K = formula.moments(Z)
    variance = K.diagonal().reshape(mean.mT.shape).mT
    posterior = model.posterior(Z)
    for found in (model.predict(Z), posterior):
        close(found.mean, mean, tolerance)
        close(found.variance, variance, tolerance)
    close(posterior.distribution.covariance_matrix, K, tolerance)
    for term in model.terms:
        if term.varies:
            mean, K = formula.moments(Z, term.name)
            close(model.term(term.name, Z).mean, mean, tolerance)
            close(model.term(term.name, Z).distribution.covariance_matrix, K, tolerance)
    left_out = formula.each(lambda part: part.left_out())
    for found, expected in zip(model.left_out(), left_out.unbind(2), strict=True):
        is_there = ~expected.isnan()
        assert torch.equal(found.mT.isnan(), ~is_there)
        close(found.mT[is_there], expected[is_there], tolerance)


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("name", MODELS)
def test_every_structure(name, m, data, drawn, formulas, uniform, close):
    model, X, Y, physics, _ = problem(name, data, m)
    drawn(model)
    agree(model, formulas(model, X, Y, *physics), uniform(5, 2, high=2.0, seed=5), close)


@pytest.mark.parametrize("size", [1e-6, 1e5])
@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("normalize", [False, True])
def test_noise_gaps_and_an_input_transform(
    normalize, known, size, data, drawn, formulas, uniform, close
):
    options = {"input_transform": Normalize(2)} if normalize else {}
    model, X, Y, physics, Yvar = problem("CKA", data, 2, known, True, size, **options)
    ranges = X.amax(0) - X.amin(0) if normalize else 1.0
    formula = formulas(drawn(model), X, Y, *physics, Yvar=Yvar, ranges=ranges)
    Z = uniform(5, 2, high=2.0, seed=5)
    mean, K = formula.moments(Z)
    close(model.predict(Z).mean, mean)
    close(model.predict(Z).variance, K.diagonal().reshape(2, 5).mT)
    left_out = formula.each(lambda part: part.left_out())
    close(model.left_out()[0].mT.nan_to_num(), left_out[:, :, 0].nan_to_num())
    noise = formula.each(lambda part: part.noise.mean())
    more = model.predict(Z, observation_noise=True).variance - model.predict(Z).variance
    close(more, noise.reshape(-1, 2).mean(0).expand(5, 2), 1e-6)
    given = model.predict(Z, observation_noise=mean.square()).variance - model.predict(Z).variance
    close(given, mean.square())


@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("name", ["CKA", "RRA", "two physics", "ZeroMeanGP"])
def test_the_likelihood(name, known, data, drawn, formulas, close):
    model, X, Y, physics, Yvar = problem(name, data, 2, known, True, 1e3)
    value, _ = drawn(model).log_likelihood(model.u)
    formula = formulas(model, X, Y, *physics, Yvar=Yvar)
    close(value + model.log_jacobian(), formula.each(lambda part: part.log_likelihood()))


def test_means_and_a_center_are_in_the_users_units(data, drawn, formulas, uniform, close):
    X, Y = data(num_outputs=2, n=12)

    def physics(X):
        return 50 * crude(X)

    model = CKA(X, 50 * Y, physics=physics, rho_mean=1.5, delta_mean=-70.0, center=110.0)
    Z = uniform(5, 2, high=2.0, seed=5)
    agree(drawn(model), formulas(model, X, 50 * Y, physics), Z, close)
    far = torch.full((1, 2), 1e6, dtype=torch.float64)
    model = CKA(X, 50 * Y, physics=physics, rho_mean=1.5, delta_mean=-70.0, constants=False)
    close(model.predict(far).mean, 1.5 * physics(far) - 70)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)], ids=str)
def test_batches_of_inputs_are_predicted_apart(batch, data, drawn, uniform, close):
    X, Y = data(num_outputs=2)
    Y[3, 1] = torch.nan
    model, Z = drawn(CKA(X, Y, physics=crude)), uniform(*batch, 4, 2)
    for ask in (model.predict, model.posterior, model.rho, model.delta):
        found, last = ask(Z), ask(Z.reshape(-1, 4, 2)[-1])
        assert found.mean.shape == found.variance.shape == (*batch, 4, 2)
        close(found.mean.reshape(-1, 4, 2)[-1], last.mean)
        close(found.variance.reshape(-1, 4, 2)[-1], last.variance)
    assert model.posterior(Z).rsample(torch.Size([5])).shape == (5, *batch, 4, 2)
    assert model.interval(Z)[0].shape == (*batch, 4, 2)


@pytest.mark.parametrize("batch", [(), (3,)], ids=str)
def test_no_points(batch, data, drawn):
    model = drawn(CKA(*data(num_outputs=2), physics=crude))
    Z = torch.zeros(*batch, 0, 2, dtype=torch.float64)
    for ask in (model.predict, model.posterior, model.delta):
        assert ask(Z).mean.shape == ask(Z).variance.shape == (*batch, 0, 2)
