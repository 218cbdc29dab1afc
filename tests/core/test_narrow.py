"""Posteriors much narrower than the prior, and a physics that fails for some parameters."""

import pytest
import torch

from gpadjust import CalibratedPhysics, FormulaPhysics, Unknown, fit
from tests.systems import line


def power(factor=10.0):
    X = 1.3 + 0.3 * line(8)
    noise = torch.randn(X.shape, generator=torch.Generator().manual_seed(0), dtype=X.dtype)
    unknowns = {name: Unknown(1.0, factor=factor) for name in ("a", "b")}
    physics = FormulaPhysics("a * x**(5 * b)", ["x"], unknowns=unknowns)
    return CalibratedPhysics(X, 0.7 * X**3.8 + 0.01 * noise, physics=physics)


def test_a_physics_that_fails_is_impossible_with_and_without_a_gradient():
    model = power()
    u = torch.zeros_like(model.u)
    u[..., -1] = 3.5  # x to the power of 16,000
    assert model.log_likelihood(u, False)[0].item() == -torch.inf
    assert model.log_likelihood(u)[0].item() == -torch.inf


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
