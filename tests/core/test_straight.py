"""Draws along ridges of parameters, and the coordinates in which these are straight."""

import pytest
import torch

from gpadjust import CalibratedPhysics, FormulaPhysics, FunctionPhysics, Unknown, fit
from gpadjust.core.sample import around_mode
from gpadjust.core.straight import Straight
from tests.systems import line, normal


def product(n, noise):
    """A model of a product of two unknowns, and mean and sd of the first, by quadrature."""
    X = line(n, 0.5, 1.5)
    unknowns = {name: Unknown(1.0, sd=0.4, bounds=(0.0, 9.0)) for name in "ab"}
    physics = FormulaPhysics("a * b * x", ["x"], unknowns=unknowns)
    model = CalibratedPhysics(X, X + noise * normal(n, 1), noise**2, physics=physics)
    # a b is c but for errors: the density of a there is p(a) p(b = c / a) |db / dc|, 1 / a.
    c = float((X * model.data.Y).sum() / X.square().sum())
    a = torch.linspace(0.05, 6.0, 100_001, dtype=torch.float64)
    log = -0.5 * ((a - 1).square() + (c / a - 1).square()) / 0.4**2 - a.log()
    weights = log.softmax(0)
    mean = (weights * a).sum()
    return model, mean, (weights * (a - mean).square()).sum().sqrt()


@pytest.mark.parametrize("n", [12, 60, pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("noise", [0.03, 1e-4])
def test_draws_spread_along_a_curved_ridge(n, noise):
    """It is up to 5,000 times as long as it is wide."""
    model, mean, sd = product(n, noise)
    result = fit(model)
    a, b = (model.physics_parameters[name] for name in "ab")
    assert abs(a.mean() - mean) < 0.15 * sd
    assert 0.85 < a.std() / sd < 1.15
    product_error = noise / model.data.X.square().sum().sqrt()
    assert 0.7 < (a * b).std() / product_error < 1.3
    assert result.parameter_error < 0.15


def straight(law, p, seed=0):
    X = line(15)
    physics = FunctionPhysics(law, unknowns={f"p{i}": Unknown(0.5, sd=1.0) for i in range(p)})
    model = CalibratedPhysics(X, X + 0.1 * normal(15, 1, seed=seed), 0.1**2, physics=physics)
    mode = torch.full_like(model.u.detach()[0], 0.3)
    start, _ = around_mode(model.log_likelihood, mode)
    return model, Straight(model, start, 0)


def test_coordinates_of_a_linear_law_are_its_own():
    _, map_ = straight(lambda X, p: p.p0 + p.p1 * X[:, 0], 2)
    s = normal(20, 1, 2)
    torch.testing.assert_close(map_.coordinates(s), s)
    assert not map_.misses(s).any()


def test_density_has_the_determinant_of_the_map():
    """Of one parameter it is that of u times du / ds, by differences."""
    model, map_ = straight(lambda X, p: torch.exp(0.6 * p.p0) * X[:, 0], 1)
    s, step = map_.mode + 0.3 * normal(9, 1, 1), 1e-3
    u, up, down = (map_.coordinates(s + move) for move in (0.0, step, -step))
    by = ((up - down) / (2 * step)).abs().log()[..., 0]
    value = model.log_likelihood(u)[0] - 0.5 * u[..., 0].square() + by
    torch.testing.assert_close(map_(s)[0] - 0.5 * s[..., 0].square(), value, atol=1e-3, rtol=0)


def test_coordinates_beyond_a_fold_are_missed():
    _, map_ = straight(lambda X, p: (p.p0 + 0.5).square() * X[:, 0], 1)
    u = torch.tensor([-2.6, -2.3, 0.2, 0.4], dtype=torch.float64).reshape(-1, 1, 1)
    assert map_.misses(u).tolist() == [True, True, False, False]


def test_where_the_physics_fails_there_is_no_density():
    _, map_ = straight(lambda X, p: torch.log(p.p0) * X[:, 0], 1)
    value, _ = map_(torch.full((3, 1, 1), -50.0, dtype=torch.float64))
    assert (value == -torch.inf).all()
