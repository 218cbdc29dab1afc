"""Equations of motion against their closed-form solutions."""

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from gpadjust.physics import FormulaPhysics, ODEPhysics, PhysicsError, Unknown
from tests.systems import refused


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


def held_input_solution(A, B, step):
    """The matrix that takes (state, action) to the state after `step`, for `s' = A s + B a`."""
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    return expm(block * step)[:n]


class TestFormulas:
    def test_a_formula_is_the_function_of_the_same_equations(self, points):
        known = {"k": Unknown(3.0, factor=2.0)}
        columns = ["angle", "rate", "torque"]
        rates = FormulaPhysics("rate, -k * angle + torque", columns, unknowns=known)
        physics = ODEPhysics(rates, 0.2, 2)
        own = ODEPhysics(
            lambda s, a, p: torch.stack([s[:, 1], -p.k * s[:, 0] + a[:, 0]], -1),
            *(0.2, 2),
            unknowns=known,
        )
        X = points(5, 3)
        for values in (None, torch.tensor([2.0], dtype=torch.float64)):
            torch.testing.assert_close(physics(X, values), own(X, values))
        torch.testing.assert_close(pickle.loads(pickle.dumps(physics))(X), own(X))
        assert physics.name == rates.name


class TestSolutions:
    def test_linear_system_is_a_matrix_exponential(self, points):
        A, B = points(3, 3, seed=1), points(3, 2, seed=2)
        physics = ODEPhysics(lambda s, a: s @ A.T + a @ B.T, 0.3, 3, substeps=30)
        X = points(4, 5, 5)
        matrix = torch.from_numpy(held_input_solution(A.numpy(), B.numpy(), 0.3))
        assert torch.allclose(physics(X), X @ matrix.T, atol=1e-6, rtol=1e-6)

    def test_spring_keeps_its_energy_and_difference_is_from_the_start(self, points):
        physics = ODEPhysics(Spring(4.0), step=2.0, state_dim=2, substeps=400)
        X = torch.cat([points(6, 2), torch.zeros(6, 1, dtype=torch.float64)], -1)

        def energy(state):
            return 0.5 * state[:, 1] ** 2 + 2.0 * state[:, 0] ** 2

        moved = physics(X)
        assert torch.allclose(energy(moved), energy(X[:, :2]), rtol=1e-8)
        assert not torch.allclose(moved, X[:, :2], atol=0.1)
        X = points(2, 5, 3)
        state = ODEPhysics(Spring(), 0.2, 2)(X)
        change = ODEPhysics(Spring(), 0.2, 2, difference=True)(X)
        assert torch.allclose(change, state - X[..., :2], atol=1e-15)

    @pytest.mark.parametrize(("method", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
    def test_substeps_converge_at_the_order_of_the_method(self, method, order):
        X = torch.ones(1, 1, dtype=torch.float64)

        def error(substeps):
            physics = ODEPhysics(decay, 1.0, 1, substeps=substeps, method=method)
            return abs(physics(X).item() - math.exp(-1.0))

        assert math.log2(error(8) / error(16)) == pytest.approx(order, abs=0.2)

    @given(
        substeps=st.integers(1, 30),
        step=st.floats(1e-6, 1e3),
        dtype=st.sampled_from([torch.float32, torch.float64]),
    )
    @settings(deadline=None)
    def test_substeps_count(self, substeps, step, dtype):
        calls = 0

        def rhs(state, action):
            nonlocal calls
            calls += 1
            return torch.zeros_like(state)

        physics = ODEPhysics(rhs, step, 1, substeps=substeps, method="euler")
        physics(torch.ones(1, 1, dtype=dtype))
        assert calls == substeps


class TestGradients:
    def test_gradients_in_X_and_in_a_parameter(self, points):
        physics = ODEPhysics(Spring(), 0.2, 2, substeps=3)
        assert torch.autograd.gradcheck(physics, points(2, 2, 3).requires_grad_())
        spring = Spring(4.0)
        physics = ODEPhysics(spring, step=0.5, state_dim=2, substeps=200)
        X = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
        physics(X)[0, 0].backward()
        # x(t) = cos(w t) with w = sqrt(k), so dx/dk = -t sin(w t) / (2 w).
        assert spring.stiffness.grad.item() == pytest.approx(-0.5 * math.sin(1.0) / 4.0, rel=1e-7)


class TestErrors:
    def test_settings(self):
        for changes, says in (
            ({"step": 0.0}, "step must be finite and above 0; found 0.0"),
            ({"state_dim": 0}, "state_dim must be at least 1; found 0"),
            ({"method": "magic"}, "Unknown method 'magic'.*euler.*rk4"),
            ({"gradient": "none"}, r"'none'.*'autograd' or 'finite"),
            ({"step": "x"}, "step must be a number; found 'x'"),
            ({"state_dim": 1.5}, "state_dim must be a whole number; found 1.5"),
            ({"rhs": "decay"}, "rhs must be callable; found str"),
        ):
            is_type = "number; found" in says or "callable" in says
            given = {"rhs": decay, "step": 0.1, "state_dim": 1, **changes}
            refused(TypeError if is_type else ValueError, says, ODEPhysics, **given)
        one = ODEPhysics(FormulaPhysics("v", ["x", "v", "u"]), 0.1, 2)
        refused(PhysicsError, r"returned .*\(3, 1\), expected.*\(3, 2\)", one, torch.ones(3, 3))

    def test_rhs_that_is_wrong(self, points):
        for rate, found in (
            (torch.zeros(3), r"\(3,\)"),
            (torch.zeros(3, 1), r"\(3, 1\)"),
            (torch.zeros(3, 2) * 1j, r"\(3, 2\)"),
            (0, "int"),
            (None, "NoneType"),
        ):
            physics = ODEPhysics(lambda s, a, rate=rate: rate, 0.1, 2, name="tank")
            says = rf"rhs of physics 'tank' returned .*{found}, expected.*\(3, 2\)"
            refused(PhysicsError, says, physics, points(3, 2))
        refused(PhysicsError, r"\(4, 3\).*have 2 column", ODEPhysics(decay, 0.1, 3), points(4, 2))

    def test_blow_up_names_the_row(self):
        physics = ODEPhysics(lambda s, a: s**3, 1.0, 1)
        with pytest.raises(PhysicsError, match="NaN or inf") as caught:
            physics(torch.tensor([[0.1], [1e9]], dtype=torch.float64))
        assert caught.value.rows == (1,)


def test_copies_and_the_number_of_outputs(points):
    physics = ODEPhysics(Spring(), 0.1, 2, difference=True)
    assert physics.num_outputs == 2  # known at once
    assert physics(torch.ones(0, 3)).shape == (0, 2)
    X = points(3, 3)
    assert torch.equal(pickle.loads(pickle.dumps(physics))(X), physics(X))


def test_gradients_by_finite_differences_are_those_of_autograd():
    options = {"step": 0.5, "state_dim": 2}
    X = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    spring = Spring().requires_grad_(False)
    slopes = []
    for gradient in ("autograd", "finite-difference"):
        Y = ODEPhysics(spring, **options, gradient=gradient)(X)
        slopes.append(torch.autograd.grad(Y.square().sum(), X)[0])
    torch.testing.assert_close(*slopes, rtol=1e-8, atol=1e-8)
    learnt = ODEPhysics(Spring(), **options, gradient="finite-difference")
    learnt(X).sum().backward()  # parameters are learnt by autograd all the same
    assert learnt.rhs.stiffness.grad.abs() > 0


class TestUnknownParameters:
    def test_of_a_decay(self, points):
        X, rate = points(4, 1), torch.tensor([[0.5], [1.0], [2.0]], dtype=torch.float64)
        unknowns = {"rate": Unknown(1.0, sd=1.0)}
        decaying = ODEPhysics(lambda s, a, p: -p.rate[:, None] * s, 0.3, 1, unknowns=unknowns)
        expected = X * (-0.3 * rate.unsqueeze(-1)).exp()
        torch.testing.assert_close(decaying(X, rate), expected, rtol=1e-7, atol=0)
