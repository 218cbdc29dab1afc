"""Intervals of two parameters that observations tell apart badly, beside those of a grid."""

import pytest
import torch

from gpadjust import CalibratedPhysics, FunctionPhysics, Unknown, fit


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
    true = physics.unknowns.at(torch.randn(2, **options))
    return X, physics(X, true) + noise * torch.randn(n, 1, **options), physics, true


@pytest.mark.filterwarnings("ignore::gpadjust.inference.ParameterWarning")
@pytest.mark.parametrize("name", PROBLEMS)
def test_intervals_are_those_of_a_grid(name):
    z = torch.linspace(-4.5, 4.5, 361, dtype=torch.float64)
    points = torch.cartesian_prod(z, z)
    variance, ratios = PROBLEMS[name][-1] ** 2, []
    for seed in range(3):
        X, Y, physics, _ = case(name, seed)
        model = CalibratedPhysics(X, Y, variance, physics=physics)
        result = fit(model)
        assert result.effective_size > 200
        grid = physics.unknowns.at(points)
        misfit = torch.cat(
            [(Y - physics(X, part)).square().sum((-1, -2)) for part in grid.split(20_000)]
        )
        weights = (-0.5 * (misfit / variance + points.square().sum(-1))).softmax(0)
        low, high = model.physics_parameters.interval()
        for i, values in enumerate(grid.mT):
            order = values.argsort()
            below = weights[order].cumsum(0)
            ends = [values[order[(below < level).sum()]] for level in (0.025, 0.975)]
            ratios.append((high[i] - low[i]) / (ends[1] - ends[0]))
            assert (low[i] - ends[0]).abs() < 0.15 * (ends[1] - ends[0])
    assert torch.stack(ratios).log().mean().exp().item() == pytest.approx(1, abs=0.06)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.inference.ParameterWarning")
def test_intervals_hold():
    held = []
    for name in PROBLEMS:
        for seed in range(25):
            X, Y, physics, true = case(name, seed)
            model = CalibratedPhysics(X, Y, physics=physics)
            fit(model)
            low, high = model.physics_parameters.interval()
            held.append((low <= true) & (true <= high))
    assert 0.9 <= torch.stack(held).double().mean() <= 0.99
