"""The cart-pole's equation, physics and cost, against mechanics derived anew."""

import math

import numpy as np
import pytest
import sympy
import torch

from gpadjust.systems import CartPoleEquation, cart_pole
from gpadjust.systems.swing_up import (
    REAL_CART_POLE,
    cart_pole_cost,
    cart_pole_reward,
    cart_pole_start,
    equation_physics,
)
from tests.systems import refused

PARAMETERS = [(0.5, 0.5, 0.6, 0.1), (1.3, 0.2, 0.9, 0.0)]
X5, X1 = torch.zeros(2, 5), torch.zeros(2, 1)


@pytest.fixture(scope="module")
def mechanics():
    """Accelerations from the Lagrangian of a cart and a rod, by integrals along it."""
    cart, pole, length, damping, g, force, t, s = sympy.symbols("M m l b g a t s", positive=True)
    x, theta = sympy.Function("x")(t), sympy.Function("theta")(t)
    place = sympy.Matrix([x - s * sympy.sin(theta), s * sympy.cos(theta)])
    speed = place.diff(t)
    kinetic = cart * x.diff(t) ** 2 / 2
    kinetic += sympy.integrate(sympy.expand(pole / length * speed.dot(speed) / 2), (s, 0, length))
    potential = sympy.integrate(pole / length * g * place[1], (s, 0, length))
    lagrangian = kinetic - potential
    loads = {x: force - damping * x.diff(t), theta: 0}
    balance = [
        lagrangian.diff(q.diff(t)).diff(t) - lagrangian.diff(q) - load for q, load in loads.items()
    ]
    values = sympy.symbols("x theta x_dot theta_dot")
    accelerations = sympy.symbols("x_ddot theta_ddot")
    names = [
        *zip([x.diff(t, 2), theta.diff(t, 2)], accelerations, strict=True),
        *zip([x.diff(t), theta.diff(t)], values[2:], strict=True),
        *zip([x, theta], values[:2], strict=True),
    ]
    solved = sympy.solve([e.subs(names) for e in balance], accelerations)
    formulas = [solved[a] for a in accelerations]
    return sympy.lambdify([values, force, (cart, pole, length, damping, g)], formulas)


@pytest.mark.parametrize("parameters", PARAMETERS)
def test_equation_is_that_of_the_lagrangian(mechanics, states_and_forces, parameters):
    states, forces = states_and_forces(50)
    rates = CartPoleEquation(*parameters)(states, forces)
    expected = mechanics(states.T, forces[:, 0], (*parameters, 9.82))
    torch.testing.assert_close(rates[:, :2], states[:, 2:], rtol=0, atol=0)
    torch.testing.assert_close(rates[:, 2:], torch.stack(expected, -1))


def test_equation_takes_any_batch_and_is_differentiable(states_and_forces):
    states, forces = states_and_forces(6)
    blocks = REAL_CART_POLE(states.view(2, 3, 4), forces.view(2, 3, 1))
    assert torch.equal(blocks.view(6, 4), REAL_CART_POLE(states, forces))
    inputs = (states[:2].requires_grad_(), forces[:2].requires_grad_())
    assert torch.autograd.gradcheck(REAL_CART_POLE, inputs)


REFUSED = [
    (ValueError, r"states \.\.\. x 4 .* actions \.\.\. x 1", REAL_CART_POLE, X5, X1),
    (ValueError, r"states \.\.\. x 4 .* actions \.\.\. x 1", REAL_CART_POLE, X5[:, :4], X1[:, :0]),
    (ValueError, "cart_mass", CartPoleEquation, 0.0, 0.5, 0.6, 0.1),
    (ValueError, "pole_length", CartPoleEquation, 0.5, 0.5, math.inf, 0.1),
    (ValueError, "damping", CartPoleEquation, 0.5, 0.5, 0.6, -0.1),
]


def test_other_columns_and_impossible_parameters_are_refused():
    for error, words, *call in REFUSED:
        refused(error, words, *call)


def test_random_physics_is_in_its_ranges_and_follows_its_seed():
    equations = [cart_pole(seed).physics.rhs for seed in range(200)]
    ranges = [("cart_mass", 0.4, 0.6), ("pole_mass", 0.5, 0.7), ("pole_length", 0.5, 0.7)]
    for name, low, high in ranges:
        values = [getattr(equation, name) for equation in equations]
        assert low <= min(values) < low + 0.01
        assert high - 0.01 < max(values) <= high
    assert {equation.damping for equation in equations} == {0.0}
    assert cart_pole(3).physics.rhs == equations[3]
    assert len(set(equations)) == 200


def test_cost_is_of_the_tip_and_within_its_bounds(states_and_forces):
    states, forces = states_and_forces(60)
    for length in (0.6, 1.0):
        x, theta = states[:, 0], states[:, 1]
        tips = torch.stack([x - length * theta.sin(), length * theta.cos() - length], dim=-1)
        cost = cart_pole_cost(states, pole_length=length)
        torch.testing.assert_close(cost, 1 - torch.exp(-2 * tips.square().sum(-1)))
    cost = cart_pole_cost(states)
    assert torch.equal(cart_pole_cost(states.view(3, 20, 4)).flatten(), cost)
    assert torch.equal(cart_pole_reward(torch.zeros(60, 4), forces, states), -cost)


def test_doing_nothing_costs_0_952():
    physics = equation_physics(REAL_CART_POLE)
    states, costs = cart_pole_start(4000), []
    for _ in range(25):
        states = physics(torch.cat([states, torch.zeros(4000, 1, dtype=torch.float64)], dim=-1))
        costs.append(cart_pole_cost(states))
    assert np.isclose(torch.stack(costs).mean().item(), 0.952, rtol=0, atol=0.001)
