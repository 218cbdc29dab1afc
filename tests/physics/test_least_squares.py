"""Least squares from far starts."""

import pytest
import torch

from gpadjust.physics.least_squares import least_squares_fit
from tests.systems import line, normal


def draws(p, seed=0):
    return normal(100, p, seed=seed)


def test_of_a_line_it_is_ridge_regression():
    X = torch.cat([line(20), torch.ones(20, 1)], 1).double()
    Y = X @ torch.tensor([1.5, -0.5], dtype=torch.float64) + 0.1 * normal(20, 1)[:, 0]
    z = least_squares_fit(lambda z: z @ X.mT - Y, draws(2))
    best = torch.linalg.lstsq(X, Y.unsqueeze(-1)).solution[:, 0]
    torch.testing.assert_close(z, best, atol=1e-3, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_parameters_wrong_by_factors_of_a_hundred(seed):
    """Resistance of a thermistor, NIST's MGH10, whose parameters are known by a combination."""
    x = torch.linspace(50, 125, 16, dtype=torch.float64)
    start = torch.tensor([2.0, 400_000.0, 25_000.0], dtype=torch.float64)
    true = torch.tensor([0.0056, 6_181.0, 345.2], dtype=torch.float64)

    def curve(b):
        return b[..., [0]] * (b[..., [1]] / (x + b[..., [2]])).exp()

    def misfit(z):
        found = curve(start * (2.3 * z).exp())
        return (found - curve(true)) / 10_000

    z = least_squares_fit(misfit, draws(3, seed))
    assert misfit(z.unsqueeze(0)).abs().max() < 0.01


def test_where_the_physics_fails():
    def misfit(z):
        f = z[:, :1].sqrt() - 1.1
        return torch.cat([f, f], 1)

    tried = torch.tensor([[-1.0], [-2.0], [0.01]], dtype=torch.float64)
    assert least_squares_fit(misfit, tried).item() == pytest.approx(1.21, abs=0.05)
    assert least_squares_fit(lambda z: misfit(z - 9), tried).item() == 0.0


def test_of_two_decays_none_is_lost():
    """NIST's MGH17: from the far start a fit by one decay is a local optimum."""
    x = torch.linspace(0, 320, 33, dtype=torch.float64)
    start = torch.tensor([50.0, 150.0, 100.0, 1.0, 2.0], dtype=torch.float64)
    true = torch.tensor([0.375, 1.94, 1.46, 0.0129, 0.0221], dtype=torch.float64)

    def curve(b):
        decays = [b[..., [i]] * (-b[..., [i + 2]] * x).exp() for i in (1, 2)]
        return b[..., [0]] + decays[0] - decays[1]

    def misfit(z):
        return curve(start * (2.3 * z).exp()) - curve(true)

    found = [least_squares_fit(misfit, normal(200, 5, seed=seed)) for seed in range(3)]
    assert sum(bool(misfit(z.unsqueeze(0)).abs().max() < 0.01) for z in found) >= 2
