"""Equations of motion against their closed-form solutions."""

import math
import pickle

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from gpadjust.physics import FormulaPhysics, FunctionPhysics, ODEPhysics, PhysicsError, Unknown
from tests.systems import normal, refused


class Spring(torch.nn.Module):
    """`x'' = -stiffness x + a`, for a unit mass."""

    def __init__(self, stiffness=4.0):
        super().__init__()
        self.stiffness = torch.nn.Parameter(torch.tensor(stiffness, dtype=torch.float64))

    def forward(self, state, action):
        position, velocity = state.unbind(-1)
        return torch.stack([velocity, -self.stiffness * position + action[:, 0]], -1)


def decay(state, action):
    return -state


def test_linear_system_is_a_matrix_exponential():
    """exp(h [[A, B], [0, 0]]) takes state and held action to the next state."""
    A, B, X = normal(3, 3, seed=1), normal(3, 2, seed=2), normal(4, 5, 5)
    physics = ODEPhysics(lambda s, a: s @ A.T + a @ B.T, 0.3, 3, substeps=30)
    block = np.zeros((5, 5))
    block[:3] = torch.cat([A, B], 1).numpy()
    matrix = torch.from_numpy(expm(0.3 * block)[:3])
    assert torch.allclose(physics(X), X @ matrix.T, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
def test_substeps_converge_at_the_order_of_the_method(method, order):
    X = torch.ones(1, 1, dtype=torch.float64)

    def error(substeps):
        physics = ODEPhysics(decay, 1.0, 1, substeps=substeps, method=method)
        return abs(physics(X).item() - math.exp(-1.0))

    assert math.log2(error(8) / error(16)) == pytest.approx(order, abs=0.2)


def test_gradients_in_X_and_in_a_parameter():
    physics = ODEPhysics(Spring(), 0.2, 2, substeps=3)
    assert torch.autograd.gradcheck(physics, normal(2, 2, 3).requires_grad_())
    spring = Spring(4.0)
    physics = ODEPhysics(spring, step=0.5, state_dim=2, substeps=200)
    physics(torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64))[0, 0].backward()
    # x(t) = cos(w t) with w = sqrt(k), so dx/dk = -t sin(w t) / (2 w).
    assert spring.stiffness.grad.item() == pytest.approx(-0.5 * math.sin(1.0) / 4.0, rel=1e-7)


def test_a_formula_is_the_function_of_the_same_equations():
    unknowns, X = {"k": Unknown(3.0, factor=2.0)}, normal(5, 3)
    columns = ["angle", "rate", "torque"]
    rates = FormulaPhysics("rate, -k * angle + torque", columns, unknowns=unknowns)
    physics = ODEPhysics(rates, 0.2, 2)
    own = ODEPhysics(
        lambda s, a, p: torch.stack([s[:, 1], -p.k * s[:, 0] + a[:, 0]], -1),
        *(0.2, 2),
        unknowns=unknowns,
    )
    for values in (None, torch.tensor([2.0], dtype=torch.float64)):
        torch.testing.assert_close(physics(X, values), own(X, values))
    torch.testing.assert_close(pickle.loads(pickle.dumps(physics))(X), own(X))
    assert physics.name == rates.name
    assert physics.num_outputs == 2  # known at once
    assert physics(torch.ones(0, 3)).shape == (0, 2)


def test_many_rows_are_those_of_few_at_once():
    """Of 70,000 the processor's cache holds a part; what fails has the number that it has."""
    sizes, limit = [], FunctionPhysics(lambda X: X[:, :1].where(X[:, :1] > -6, torch.nan))

    def rhs(state, action, p):
        sizes.append(len(state))
        return -p.k.unsqueeze(-1) * limit.of_rows(state)

    physics = ODEPhysics(rhs, 1.0, 1, substeps=1, unknowns={"k": Unknown(0.5, sd=1.0)})
    X, k = normal(70_000, 1).clamp(-5, 5), torch.linspace(0.1, 1, 3, dtype=torch.float64)
    few = torch.stack([physics(X[:100], value) for value in k.unsqueeze(-1)])
    sizes.clear()
    many = physics(X, k.unsqueeze(-1))
    assert max(sizes) <= 30_000
    torch.testing.assert_close(many[:, :100], few)
    X[40_001] = -7.0
    with pytest.raises(PhysicsError) as caught:
        physics(X)
    assert caught.value.rows == (40_001,)


def test_refusals():
    for error, says, changes in (
        (ValueError, "step must be finite and above 0; found 0.0", {"step": 0.0}),
        (ValueError, "state_dim must be at least 1; found 0", {"state_dim": 0}),
        (ValueError, "Unknown method 'magic'.*euler.*rk4", {"method": "magic"}),
        (TypeError, "rhs must be callable; found str", {"rhs": "decay"}),
    ):
        refused(error, says, ODEPhysics, **{"rhs": decay, "step": 0.1, "state_dim": 1, **changes})
    for rate, found in (
        (torch.zeros(3, 1), r"\(3, 1\)"),
        (torch.zeros(3, 2) * 1j, r"torch.complex64, \(3, 2\)"),
        (None, "NoneType"),
    ):
        physics = ODEPhysics(lambda s, a, rate=rate: rate, 0.1, 2, name="tank")
        says = rf"rhs of physics 'tank' returned .*{found}, expected.*\(3, 2\)"
        refused(PhysicsError, says, physics, normal(3, 2))
    refused(PhysicsError, r"\(4, 3\).*have 2 column", ODEPhysics(decay, 0.1, 3), normal(4, 2))
    one = ODEPhysics(FormulaPhysics("v", ["x", "v", "u"]), 0.1, 2)
    refused(PhysicsError, r"returned .*\(3, 1\), expected.*\(3, 2\)", one, torch.ones(3, 3))
