"""Intervals of parameters that observations tell apart badly, or that several values do for."""

import pytest
import torch

from gpadjust.core import CalibratedPhysics, fit
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import line, normal


def beam(X, p):
    return 10 * X[:, 0] * (X[:, 1] ** 3 / (3 * p.EI) + X[:, 1] ** 2 / p.kr)


def enzyme(X, p):
    return p.V * X[:, 0] / (p.K + X[:, 0])


def growth(X, p):
    return p.K / (1 + (p.K / 0.2 - 1) * torch.exp(-p.r * X[:, 0]))


def drag(X, p):
    limit = torch.sqrt(9.81 * p.m / p.c)
    return limit * torch.tanh(9.81 * X[:, 0] / limit)


# A formula, guesses and factors of its parameters, the box of the inputs, points, sd of the noise.
PROBLEMS = {
    "beam": (beam, {"EI": (8.0, 1.6), "kr": (25.0, 1.6)}, [[0.3, 0.8], [1.0, 1.1]], 14, 0.01),
    "enzyme": (enzyme, {"V": (3.0, 2.0), "K": (2.0, 2.0)}, [[0.1], [1.5]], 12, 0.02),
    "growth": (growth, {"r": (1.0, 1.4), "K": (5.0, 2.0)}, [[0.0], [3.5]], 13, 0.03),
    "drag": (drag, {"m": (80.0, 1.3), "c": (0.4, 1.8)}, [[0.5], [6.0]], 12, 0.5),
}


def case(name, seed):
    """Inputs, targets, physics and true parameters, which are drawn from the prior."""
    law, priors, box, n, noise = PROBLEMS[name]
    generator = torch.Generator().manual_seed(77_000 + seed)
    options = {"generator": generator, "dtype": torch.float64}
    low, high = torch.tensor(box, dtype=torch.float64)
    X = low + torch.rand(n, len(low), **options) * (high - low)
    unknowns = {key: Unknown(guess, factor=factor) for key, (guess, factor) in priors.items()}
    physics = FunctionPhysics(law, unknowns=unknowns)
    true = physics.unknowns.to_values(torch.randn(2, **options))
    return X, physics(X, true) + noise * torch.randn(n, 1, **options), physics, true


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
        X, Y, physics, _ = case(name, seed)
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
def test_intervals_hold():
    held = []
    for name in PROBLEMS:
        for seed in range(12):
            X, Y, physics, true = case(name, seed)
            model = CalibratedPhysics(X, Y, physics=physics)
            fit(model)
            low, high = model.physics_parameters.interval()
            held.append((low <= true) & (true <= high))
    assert 0.9 <= torch.stack(held).double().mean() <= 0.99


def fold(law, unknowns, seed, noise=0.1):
    """A model of a law of one input, whose true parameters are drawn from the prior, and these."""
    X = line(12, 0.1, 2.0)
    physics = FunctionPhysics(law, unknowns=unknowns)
    true = physics.unknowns.to_values(normal(len(unknowns), seed=seed))
    Y = physics(X, true) + noise * normal(len(X), 1, seed=100 + seed)
    return CalibratedPhysics(X, Y, noise**2, physics=physics), true


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_optima_of_either_sign_are_found(seed):
    """Of a swing that may have either sign, with the phase of the other."""
    unknowns = {"swing": Unknown(0.0, sd=1.0), "phase": Unknown(0.0, bounds=(-3.15, 3.15))}
    model, true = fold(lambda X, p: p.swing * torch.sin(3 * X[:, 0] + p.phase), unknowns, seed)
    fit(model)
    swing = model.physics_parameters["swing"]
    assert 0.3 < (swing > 0).double().mean() < 0.7
    assert abs(swing.abs().mean() - true[0].abs()) < 0.1


@pytest.mark.slow
def test_draws_go_beyond_a_fold():
    """Of a square of which the data say that it is small: the root has either sign."""
    X = line(12, 0.1, 2.0)
    physics = FunctionPhysics(
        lambda X, p: p.a.square() * X[:, 0], unknowns={"a": Unknown(0.3, sd=1.0)}
    )
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
