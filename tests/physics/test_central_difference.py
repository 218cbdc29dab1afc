"""The finite-difference Jacobian against autograd."""

import torch

from gpadjust.physics.gradient import central_difference


def waves(X):
    return torch.stack([X[:, 0].sin() * X[:, 1].exp(), X[:, 2] ** 3, X.prod(-1)], -1)


def test_agrees_with_autograd(points):
    X = points(6, 3)
    exact = torch.stack([torch.autograd.functional.jacobian(waves, x[None])[0, :, 0] for x in X])
    assert torch.allclose(central_difference(waves, X), exact, rtol=1e-8, atol=1e-8)


def test_exact_for_quadratics(points):
    X = points(4, 2)
    J = central_difference(lambda X: X.square(), X, torch.tensor([0.5, 0.25]).double())
    assert torch.allclose(J, torch.diag_embed(2 * X), rtol=1e-12, atol=1e-12)


def test_large_inputs_get_a_step_that_floats_can_tell_apart():
    X = torch.tensor([[1e9]], dtype=torch.float64)
    assert torch.allclose(central_difference(lambda X: 3 * X, X), torch.tensor(3.0).double())


def test_step_is_counted_as_rounded():
    X = torch.tensor([[1e9]], dtype=torch.float64)
    slope = central_difference(lambda X: X, X, torch.tensor(1.7e-7).double())
    assert slope.item() == 1.0


def test_each_point_is_the_row_that_the_documentation_says(points):
    X = points(4, 3)
    asked = []

    def record(points):
        asked.append(points)
        return points

    central_difference(record, X, torch.tensor(0.1).double())
    (rows,) = asked
    i = torch.arange(len(rows))
    moved = (rows - X[i // 3 % 4]).abs()
    assert len(rows) == 24
    assert torch.allclose(moved, 0.1 * torch.eye(3).double()[i % 3])
