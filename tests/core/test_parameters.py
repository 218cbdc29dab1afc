"""Parameters of a physics: narrow posteriors, ridges, several optima, and straight coordinates."""

import math
import warnings
from functools import partial

import pytest
import torch

from gpadjust.core import CKA, CalibratedPhysics, PhysicsMeanGP, SamplingWarning, fit
from gpadjust.core.sample import around_mode, sample
from gpadjust.core.straight import Straight, _after_step
from gpadjust.physics import FormulaPhysics, FunctionPhysics, PhysicsError, Unknown
from tests.systems import line, normal


def power(factor=10.0):
    X = 1.3 + 0.3 * line(8)
    unknowns = {name: Unknown(1.0, factor=factor) for name in ("a", "b")}
    physics = FormulaPhysics("a * x**(5 * b)", ["x"], unknowns=unknowns)
    return CalibratedPhysics(X, 0.7 * X**3.8 + 0.01 * normal(*X.shape), physics=physics)


@pytest.mark.parametrize("method", ["bayes", "map"])
def test_parameters_known_a_thousand_times_better_than_before(method):
    model = power()
    fit(model, method)
    found, (X, Y) = model.physics_parameters, model.data[:2]
    best = torch.tensor([0.7, 0.76], dtype=torch.float64)
    for _ in range(20):  # Gauss and Newton
        a, b = best
        f = a * X ** (5 * b)
        J = torch.cat([f / a, 5 * X.log() * f], 1)
        best = torch.stack([a, b]) + torch.linalg.lstsq(J, Y - f).solution[:, 0]
    variance = (Y - f).square().sum() / 6 * torch.linalg.inv(J.mT @ J).diagonal()
    assert ((found.mean - best).abs() < 0.3 * variance.sqrt()).all()
    if method == "bayes":
        torch.testing.assert_close(found.sd, variance.sqrt(), rtol=0.4, atol=0)


def beam(X, p):
    return 10 * X[:, 0] * (X[:, 1] ** 3 / (3 * p.EI) + X[:, 1] ** 2 / p.kr)


def growth(X, p):
    return p.K / (1 + (p.K / 0.2 - 1) * torch.exp(-p.r * X[:, 0]))


# A formula, guesses and factors of its parameters, the box of the inputs, points, sd of the noise.
PROBLEMS = {
    "beam": (beam, {"EI": (8.0, 1.6), "kr": (25.0, 1.6)}, [[0.3, 0.8], [1.0, 1.1]], 14, 0.01),
    "growth": (growth, {"r": (1.0, 1.4), "K": (5.0, 2.0)}, [[0.0], [3.5]], 13, 0.03),
}


def case(name, seed):
    """Inputs, targets and physics, with true parameters that are drawn from the prior."""
    law, priors, box, n, noise = PROBLEMS[name]
    generator = torch.Generator().manual_seed(77_000 + seed)
    options = {"generator": generator, "dtype": torch.float64}
    low, high = torch.tensor(box, dtype=torch.float64)
    X = low + torch.rand(n, len(low), **options) * (high - low)
    unknowns = {key: Unknown(guess, factor=factor) for key, (guess, factor) in priors.items()}
    physics = FunctionPhysics(law, unknowns=unknowns)
    true = physics.unknowns.to_values(torch.randn(2, **options))
    return X, physics(X, true) + noise * torch.randn(n, 1, **options), physics


def by_grid(X, Y, physics, variance):
    """The ends of the central 95 % of each parameter, ``2 x p``."""
    z = torch.linspace(-4.5, 4.5, 361, dtype=torch.float64)
    points = torch.cartesian_prod(z, z)
    grid = physics.unknowns.to_values(points)
    parts = [(Y - physics(X, part)).square().sum((-1, -2)) for part in grid.split(20_000)]
    weights = (-0.5 * (torch.cat(parts) / variance + points.square().sum(-1))).softmax(0)
    ends = []
    for values in grid.mT:
        order = values.argsort()
        below = weights[order].cumsum(0)
        ends.append([values[order[(below < level).sum()]] for level in (0.025, 0.975)])
    return torch.tensor(ends, dtype=torch.float64).mT


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_intervals_are_those_of_a_grid(name):
    variance, ratios, away = PROBLEMS[name][-1] ** 2, [], []
    for seed in range(3):
        X, Y, physics = case(name, seed)
        model = CalibratedPhysics(X, Y, variance, physics=physics)
        fit(model)
        found = torch.stack(model.physics_parameters.interval())
        exact = by_grid(X, Y, physics, variance)
        width = exact[1] - exact[0]
        ratios.append((found[1] - found[0]) / width)
        away.append((found - exact).abs() / width)
    assert 0.9 < torch.stack(ratios).log().mean().exp() < 1.15
    assert torch.stack(away).mean() < 0.12


@pytest.mark.slow
def test_draws_go_beyond_a_fold():
    """Of a square of which the data say that it is small: the root has either sign."""
    X = line(12, 0.1, 2.0)
    unknowns = {"a": Unknown(0.3, sd=1.0)}
    physics = FunctionPhysics(lambda X, p: p.a.square() * X[:, 0], unknowns=unknowns)
    Y = 0.01 * X + 0.1 * normal(12, 1, seed=1)
    model = CalibratedPhysics(X, Y, 0.1**2, physics=physics)
    fit(model)
    a = torch.linspace(-2, 2, 4001, dtype=torch.float64)
    misfit = (Y.mT - a.square().unsqueeze(-1) * X.mT).square().sum(-1)
    weights = (-0.5 * (misfit / 0.1**2 + (a - 0.3).square())).softmax(0)
    draws = model.physics_parameters["a"]
    assert abs(draws.mean() - (weights * a).sum()) < 0.04
    square = draws.square().mean() / (weights * a.square()).sum()
    assert square.item() == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("seed", [0, 1])
def test_draws_reach_a_long_tail(seed):
    """Of a rate that may be as large as the prior allows: all data are saturated but for noise."""
    X, noise = line(8, 1.0, 2.0), 0.3
    physics = FormulaPhysics("1 - exp(-a * x)", ["x"], unknowns={"a": Unknown(1.0, factor=5.0)})
    model = CalibratedPhysics(X, 0.95 + noise * normal(8, 1, seed=4), noise**2, physics=physics)
    result = fit(model, seed=seed)
    u = torch.linspace(-8, 8, 8001, dtype=torch.float64)
    a = physics.unknowns.to_values(u.unsqueeze(-1))
    misfit = (model.data.Y.mT - 1 + (-a * X.mT).exp()).square().sum(-1)
    log = -0.5 * misfit / noise**2 - 0.5 * u.square()
    weights = log.softmax(0)
    size = log.logsumexp(0) + math.log(u[1] - u[0]) - 0.5 * math.log(2 * torch.pi)
    evidence = size - 8 * math.log(noise * math.sqrt(2 * torch.pi))
    assert result.log_evidence.item() == pytest.approx(evidence.item(), abs=0.08)
    found = model.physics_parameters.coordinates[:, 0]
    assert abs(found.mean() - (weights * u).sum()) < 0.1
    for end in (0.5, 1.5, 2.5):
        assert abs((found > end).double().mean() - weights[u > end].sum()) < 0.05


@pytest.mark.parametrize("n", [10, 45])
def test_a_parameter_that_a_delta_takes_the_place_of_keeps_its_prior(n):
    """A height, of which a free delta has an offset; hyper-parameters drawn from the prior."""
    X = line(n, 0.0, 1.5)
    unknowns = {"h": Unknown(50.0, sd=20.0), "g": Unknown(9.0, sd=2.0)}
    physics = FormulaPhysics("h - g*x**2/2", ["x"], unknowns=unknowns)
    Y = 52 - 4.9 * X**2 + 0.4 * X**3 + 0.05 * normal(n, 1, seed=3)
    model = PhysicsMeanGP(X, Y, physics=physics)
    fit(model)
    low, high = model.physics_parameters.interval()
    # Given the hyper-parameters y is normal, and so are both unknowns: y = f_p + J z + error.
    draws = model.table.values(normal(40_000, *model.u.shape[1:]))
    columns = ("lengthscale", "kernel.outputscale", "constant", "noise.variance")
    length, scale, constant, variance = (
        next(v for name, v in draws.items() if name.endswith(column)) for column in columns
    )
    K = scale * (-0.5 * ((X - X.mT) / length).square()).exp() + constant
    J = torch.cat([20 * torch.ones_like(X), -(X**2)], 1) / model.unit
    away = (Y - 50 + 4.5 * X**2) / model.unit
    root = torch.linalg.cholesky(
        K + (variance + 1e-9 * (scale + constant)) * torch.eye(n) + J @ J.mT
    )
    logs = torch.distributions.MultivariateNormal(torch.zeros(n).to(X), scale_tril=root)
    weights = logs.log_prob(away[:, 0]).softmax(0)
    assert weights.square().sum() < 1 / 50  # at least so many count
    by_h = torch.cholesky_solve(J[:, :1].expand(len(root), -1, -1), root).mT
    height = torch.distributions.Normal(
        50 + 20 * (by_h @ away).flatten(), 20 * (1 - by_h @ J[:, :1]).flatten().sqrt()
    )
    grid = torch.linspace(-50, 150, 2001).to(X)
    below = torch.cat([(weights * height.cdf(h)).sum().unsqueeze(0) for h in grid])
    exact = [grid[(below < end).sum()] for end in (0.025, 0.975)]
    assert ((high - low)[0] / (exact[1] - exact[0])).item() == pytest.approx(1, abs=0.45)


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


@pytest.mark.parametrize("num_draws", [4, 12])
def test_few_draws_are_as_many_as_asked_for(num_draws):
    model, mean, sd = product(12, 0.03)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        fit(model, num_draws=num_draws)
    assert len(model.draws) == num_draws
    assert abs(model.physics_parameters["a"].mean() - mean) < 2 * sd


def straight(law, p, seed=0, is_alone=True):
    X = line(15)
    physics = FunctionPhysics(law, unknowns={f"p{i}": Unknown(0.5, sd=1.0) for i in range(p)})
    model = CalibratedPhysics(X, X + 0.1 * normal(15, 1, seed=seed), 0.1**2, physics=physics)
    mode = torch.full_like(model.u.detach()[0], 0.3)
    start, _ = around_mode(model.log_likelihood, mode)
    return model, Straight(model, start, 0, is_alone)


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


def test_a_point_is_either_within_reach_or_missed():
    for is_alone in (True, False):
        _, map_ = straight(lambda X, p: p.p0 + p.p1 * X[:, 0], 2, is_alone=is_alone)
        away = torch.tensor([[3.0, 0.0], [0.0, 4.3], [0.0, 4.5], [9.0, 9.0]]).double()
        s = map_.mode + (away @ map_.start.root[0].mT).unsqueeze(1)
        beyond = [False, False, not is_alone, not is_alone]  # sqrt(2) + 3
        assert map_.misses(s).tolist() == beyond
        assert (map_(s)[0] == -torch.inf).flatten().tolist() == beyond


def test_no_density_at_the_edge_of_failure():
    """Where f_p has a value, and its derivatives have none."""
    _, map_ = straight(lambda X, p: X[:, 0] * p.p0.where(p.p0 < 1.02, torch.nan), 1)
    s = torch.full((1, 1, 1), 1.02 - 0.5 - 1e-6, dtype=torch.float64)  # of a linear law, u
    assert map_.coordinates(s).item() == pytest.approx(s.item())
    assert map_(s)[0].item() == -torch.inf
    assert len(map_.solved[0]) == 1


def test_the_linear_part_is_a_linear_law():
    _, map_ = straight(lambda X, p: p.p0 + 2 * p.p1 * X[:, 0], 2)
    s = normal(5, 1, 2)
    torch.testing.assert_close(map_.linear(s)[0], map_(s)[0], rtol=1e-6, atol=1e-6)
    leaf, step = s.unsqueeze(0), 1e-4 * torch.eye(2).double().reshape(2, 1, 1, 2)
    up, down = (map_.linear((leaf + move).flatten(0, 1))[0] for move in (step, -step))
    by = ((up - down) / 2e-4).reshape(2, 5).mT
    torch.testing.assert_close(map_.linear(s)[1][:, 0], by, rtol=1e-5, atol=1e-4)


def test_derivatives_after_a_step_take_it():
    B, dw, dt = normal(6, 3, 3), normal(6, 3, seed=1), normal(6, 3, seed=2)
    after = _after_step(B, dw, dt)
    torch.testing.assert_close((after @ dt.unsqueeze(-1))[..., 0], dw)
    across = torch.linalg.cross((dw.unsqueeze(1) @ B)[:, 0], normal(6, 3, seed=3))
    # By the inverse: it is the same across the step, (B_new)^-1 v = B^-1 v for v across dw.
    v = torch.linalg.cross(dw, across)
    same_as = torch.linalg.solve(B, v)
    torch.testing.assert_close(torch.linalg.solve(after, v), same_as)
    stays = _after_step(B, torch.zeros_like(dw), torch.zeros_like(dt))
    torch.testing.assert_close(stays, B)


def test_a_solution_is_one_however_it_is_found():
    """From the mode by Newton's method, or by Broyden's from the nearest point of before."""
    _, map_ = straight(lambda X, p: (p.p0 + p.p1.square() * X[:, 0]).exp(), 2)
    s = map_.start.mean + (map_.start.root @ normal(40, 2, 1))[..., 0].unsqueeze(1)
    alone = torch.cat([map_.coordinates(row) for row in s.split(1)])
    map_(s)
    near = map_.coordinates(s + 1e-3)
    torch.testing.assert_close(map_.coordinates(s), alone, rtol=0, atol=1e-4)
    assert (near - alone).abs().max() < 0.1


def test_a_guide_leads_moves_and_decides_nothing():
    """Of a likelihood N(1, 0.4^2) that it takes for another one, N(0.5, 0.6^2), and no gradient."""

    def density(mean, sd, u, with_gradient=True):
        away = (u - mean) / sd
        return -0.5 * away.square().sum(-1), -away / sd

    def likelihood(u, with_gradient=True):
        assert not with_gradient
        return density(1.0, 0.4, u)

    like = torch.zeros(1, 2, dtype=torch.float64)
    draws = [
        sample(likelihood, like, 400, seed, guide=partial(density, 0.5, 0.6)).u for seed in range(4)
    ]
    u = torch.cat(draws)
    precision = 1 + 1 / 0.4**2
    assert u.mean().item() == pytest.approx(1 / 0.4**2 / precision, abs=0.03)
    assert u.std(0).mean().item() == pytest.approx(precision**-0.5, rel=0.08)


# 14,800 times all, by Newton's method 30,000; to 100 rows draws from the prior count, too: 84,700
@pytest.mark.parametrize(("n", "bound"), [(110, 17_000), (60, 100_000)])
def test_a_fit_asks_for_few_rows_of_the_physics(n, bound):
    """A move costs a solution, the derivatives there and one value: 30 rows or so by 3 unknowns."""
    rows = []

    def law(X, p):
        rows.append(len(X))
        return p.a * (-p.b * X[:, 0]).exp() + p.c

    X = line(n, 0.0, 3.0)
    unknowns = {name: Unknown(1.0, factor=3.0) for name in "abc"}
    physics = FunctionPhysics(law, unknowns=unknowns)
    model = CKA(X, 2 * (-X).exp() + 0.5 + 0.1 * normal(n, 1), physics=physics, nested=False)
    fit(model)
    assert sum(rows) < n * bound


def test_where_the_physics_fails_there_is_no_density():
    model, map_ = straight(lambda X, p: torch.log(p.p0) * X[:, 0], 1)
    value, _ = map_(torch.full((3, 1, 1), -50.0, dtype=torch.float64))
    assert (value == -torch.inf).all()
    u = torch.full_like(model.u.detach(), -9.0)
    for with_gradient in (False, True):
        assert model.log_likelihood(u, with_gradient)[0].item() == -torch.inf


@pytest.mark.parametrize("n", [12, 60])
@pytest.mark.parametrize("width", [1.0, 0.1, 0.003])
def test_a_physics_that_fails_by_most_of_its_prior(n, width):
    """The fit ends, by draws where it holds or by an error."""
    X = line(n)

    def law(X, p):
        outside = ((p.a - 1).abs() > width) | ((p.b - 1).abs() > width)
        return (p.a * X[:, 0] + p.b).masked_fill(outside, torch.nan)

    unknowns = {name: Unknown(1.0, sd=1.0) for name in "ab"}
    physics = FunctionPhysics(law, unknowns=unknowns)
    model = PhysicsMeanGP(X, 1 + X + 0.05 * normal(n, 1), physics=physics)
    if width < 0.01:
        with pytest.raises(PhysicsError, match="bounds"):
            fit(model)
        return
    fit(model)
    found = model.physics_parameters
    assert all(((found[name] - 1).abs() <= width).all() for name in "ab")


def test_a_physics_that_fails_is_impossible_with_and_without_a_gradient():
    model = power()
    u = torch.zeros_like(model.u)
    u[..., -1] = 3.5  # x to the power of 16,000
    assert model.log_likelihood(u, False)[0].item() == -torch.inf
    assert model.log_likelihood(u)[0].item() == -torch.inf
