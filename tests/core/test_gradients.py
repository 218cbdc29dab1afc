"""The gradient of the log likelihood against central differences, and what leaves models alone."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gpadjust import core
from gpadjust.core import CKA, MATERN12, MATERN32, MATERN52, RRA, Stationary
from gpadjust.physics import FunctionPhysics, Unknown
from tests.core.noises import Relative
from tests.systems import crude, normal, same, slopes, truth, uniform


def law(X, p):
    return torch.stack([p.a * (p.w * X[..., 0]).sin() + X[..., 1], p.a + X[..., 1]], -1)


def known(values):
    return FunctionPhysics(
        law, unknowns={"a": Unknown(1.0, sd=0.5), "w": Unknown(3.0, factor=1.3)} | values
    )


def second(X, p):
    return law(X, p).cos()


def of(cls, *Yvar, **options):
    return lambda X, Y: cls(X, Y, *Yvar, **options)


UNKNOWN = known({})
OTHER = FunctionPhysics(second, unknowns=UNKNOWN.unknowns)
BOUNDED = known({"w": Unknown(3.0, bounds=(2.0, 4.0))})
MODELS = {
    "PhysicsMeanGP, known noise": of(core.PhysicsMeanGP, 0.01, physics=crude),
    "two physics": of(CKA, physics=[crude, lambda X: crude(X).sin()], rho_mean=[0.7, 0.1]),
    "given numbers": of(CKA, physics=crude, center=0.7, rho_mean=1.5, delta_mean=-2.0),
    "no constants": of(CKA, physics=crude, constants=False, center=False),
    "two physics with the same parameters": of(CKA, physics=[UNKNOWN, OTHER]),
    "known and unknown": of(CKA, physics=[crude, BOUNDED]),
    "calibrated, known noise": of(core.CalibratedPhysics, 0.01, physics=UNKNOWN),
    "relative noise of unknown parameters": of(CKA, physics=UNKNOWN, noise=Relative()),
}


def problem(seed=0, n=9):
    """Inputs, and targets of which some are missing."""
    X = uniform(n, 2, high=2.0, seed=seed)
    Y = truth(X) + 0.1 * normal(n, 2, seed=seed + 1)
    Y[3, 0] = Y[5, 1] = torch.nan
    return X, Y


def coordinates(model, seed=0, choice=None, number=2):
    u = 0.3 * normal(number, model.table.problems, model.table.size, seed=seed)
    return model.table.with_choice(u, choice) if model.table.choices else u


def assert_right(model, u, tolerance=1e-7):
    value, gradient = model.log_likelihood(u)
    assert value.isfinite().all()
    expected = slopes(lambda u: model.log_likelihood(u)[0], u)
    size = expected.abs().max().item()
    torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=tolerance * max(size, 1.0))


@pytest.mark.parametrize("name", MODELS)
def test_every_model(name):
    model = MODELS[name](*problem())
    for choice in range(max(1, len(model.table.choices))):
        assert_right(model, coordinates(model, choice=choice))


OFFSETS = st.floats(-1e4, 1e4) | st.sampled_from([1.0, 1e4, 1e8])


@settings(max_examples=15, derandomize=True)
@given(st.integers(0, 2**31), OFFSETS, st.integers(0, 1), st.sampled_from([CKA, RRA]))
def test_a_constant_of_physics_and_targets(seed, offset, choice, cls):
    X, Y = problem(seed)
    one = cls(X, Y, physics=crude)
    other = cls(X, Y + offset, physics=lambda X: crude(X) + offset)
    u = coordinates(one, seed, choice)
    (value, gradient), (other_value, other_gradient) = (m.log_likelihood(u) for m in (one, other))
    share = max(1.0, 1e-7 * offset)  # of digits that the offset takes
    torch.testing.assert_close(other_value, value, rtol=1e-6 * share, atol=1e-6 * share)
    size = gradient.abs().max().item() * share
    torch.testing.assert_close(other_gradient, gradient, rtol=1e-5 * share, atol=1e-5 * size)
    Z = uniform(4, 2, high=2.0, seed=seed)
    for model in (one, other):
        model.set_draws(u)
    mean, variance = other.predict(Z)
    same((mean - offset, variance), one.predict(Z), rtol=1e-6 * share, atol=1e-7 * share)
    rho = [model.rho(Z).mean for model in (one, other)]
    torch.testing.assert_close(*rho, rtol=1e-6 * share, atol=1e-7 * share)


@pytest.mark.parametrize("profile", [MATERN12, MATERN32, MATERN52], ids=lambda p: p.name)
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-8, 1e-4])
def test_near_duplicate_inputs(profile, gap):
    """Distances of 1e-8 have half of the digits."""
    X, Y = problem()
    X, Y = torch.cat([X, X[:3] + gap]), torch.cat([Y, Y[:3] + 1e-3])
    model = core.ZeroMeanGP(X, Y, covar_module=Stationary(profile))
    assert_right(model, coordinates(model), 1e-4)


def test_gradients_of_parts_and_functions(gradient_is_right):
    X, Y = problem()
    model = CKA(X, Y, physics=crude)
    model.set_draws(torch.cat([coordinates(model, choice=k) for k in range(3)]))
    functions = model.sample_functions(3, seed=0)
    for ask in (
        lambda Z: model.posterior(Z).distribution.covariance_matrix[0, 1],
        lambda Z: model.rho(Z).mean.sum(),
        lambda Z: model.delta(Z).variance.sum(),
        lambda Z: functions(Z).square().sum(),
    ):
        gradient_is_right(ask, torch.cat([X[:1], uniform(2, 2, seed=4)]))
