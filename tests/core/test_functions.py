"""Functions drawn from the posterior."""

import copy

import pytest
import torch
from botorch.models.transforms import Normalize
from botorch.sampling.pathwise import draw_matheron_paths

from gpadjust.core import CKA, MATERN12, MATERN32, MATERN52, RRA, Stationary, ZeroMeanGP
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import crude, line


def kernels(rho, delta):
    return {"rho_covar_module": Stationary(rho), "delta_covar_module": Stationary(delta)}


CASES = {
    "transform": (CKA, {"physics": crude, "input_transform": Normalize(2)}, 0),
    "nested models": (CKA, {"physics": crude}, None),
    "Matern": (CKA, {"physics": crude, **kernels(MATERN52, MATERN32)}, 0),
    "Matern 1/2": (ZeroMeanGP, {"covar_module": Stationary(MATERN12)}, 0),
    "RRA": (RRA, {"physics": crude, "nested": False}, 0),
}


@pytest.mark.parametrize("name", CASES)
def test_moments(name, data, drawn, uniform):
    cls, options, choice = CASES[name]
    X, Y = data(num_outputs=2, n=6)
    Y[2, 0] = Y[4:, 1] = torch.nan
    model = drawn(cls(X, Y, **options), choice=choice)
    Z = uniform(4, 2, high=2.0, seed=4)
    with torch.no_grad():  # of several seeds, as frequencies are few
        values = [model.sample_functions(150, seed, 256)(Z) for seed in range(12)]
        values, posterior = torch.cat(values), model.posterior(Z)
    assert values.shape == (1800, 4, 2)
    covariance = posterior.distribution.covariance_matrix
    sd = covariance.diagonal().sqrt()
    standard = (values.mT.flatten(1) - posterior.mean.mT.flatten()) / sd
    assert (standard.mean(0).abs() < 0.1).all()
    torch.testing.assert_close(standard.mT.cov(), covariance / sd.outer(sd), rtol=0, atol=0.15)


@pytest.mark.parametrize("later", [False, True], ids=["", "conditioned"])
def test_spread_without_noise(later):
    """The nugget of the covariance is noise to the posterior, and to functions drawn from it."""
    X, Z = line(8), line(7, 0.05, 0.95)
    Y, options = 2 * (6 * X).sin() + X, {"num_features": 100, "nested": False}  # exact features
    model = RRA(X, Y, 0.0, physics=lambda X: (6 * X).sin(), **options)
    if later:
        more = Z[[1, 4]] + 0.03
        model = model.condition_on_observations(more, model.predict(more).mean)
    values, (mean, variance) = model.sample_functions(1500, 0)(Z), model.predict(Z)
    assert ((values.mean(0) - mean).abs() < 0.2 * variance.sqrt()).all()
    assert ((values.std(0) / variance.sqrt() - 1).abs() < 0.2).all()


def test_shapes_and_seeds(data, drawn, uniform):
    model = drawn(CKA(*data(num_outputs=2), physics=crude), 5)
    functions, Z = model.sample_functions(3, seed=1), uniform(2, 6, 5, 2)
    values = functions(Z)
    assert values.shape == (3, 2, 6, 5, 2)
    torch.testing.assert_close(functions(Z[1, 4]), values[:, 1, 4])
    state = torch.get_rng_state()
    assert torch.equal(model.sample_functions(3, seed=1)(Z), values)
    assert torch.equal(torch.get_rng_state(), state)
    assert not torch.equal(model.sample_functions(3)(Z), model.sample_functions(3)(Z))
    for k in (1, 2, 12):  # fewer or more than the draws
        assert model.sample_functions(k, seed=0)(Z[0, 0]).shape == (k, 5, 2)
    model.set_draws(torch.zeros_like(model.u))
    assert torch.equal(functions(Z), values)
    assert torch.equal(copy.deepcopy(functions)(Z), values)


def test_each_function_is_evaluated_at_its_own_points_only(data, uniform):
    X, Y = data(n=8)
    asked = []

    def law(X, p):
        asked.append(len(X))
        return p.a * crude(X)[:, 0]

    physics = FunctionPhysics(law, unknowns={"a": Unknown(1.0, factor=1.5)})
    model = CKA(X, Y[:, :1], physics=physics, nested=False)
    model.set_draws(0.3 * torch.randn(3, *model.u.shape[1:], dtype=torch.float64))
    functions = model.sample_functions(6, seed=0)
    points = uniform(6, 4, 2, high=2.0, seed=1)
    expected = torch.stack([functions(points[i])[i] for i in range(6)])
    asked.clear()
    torch.testing.assert_close(functions.evaluate_each(points), expected)
    assert sum(asked) == 6 * 4


def test_paths_of_botorch(data, drawn, uniform):
    X, Y = data()
    model = drawn(CKA(X, Y, physics=lambda X: crude(X)[..., :1]))
    Z = uniform(5, 2)
    assert draw_matheron_paths(model, torch.Size([4]))(Z).shape == (4, 5)
    values, posterior = draw_matheron_paths(model, torch.Size([600]))(Z), model.posterior(Z)
    error = values.mean(0) - posterior.mean.squeeze(-1)
    assert (error.abs() < 0.15 * posterior.variance.sqrt().squeeze(-1)).all()
