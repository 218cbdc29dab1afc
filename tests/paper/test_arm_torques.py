"""The torque arm's equation and physics, against mechanics derived anew and against OpenSim."""

import math
import pickle

import numpy as np
import pytest
import sympy
import torch

from gpadjust.dynamics import PhysicsDynamics
from gpadjust.physics import ODEPhysics
from paper.arm.system import ArmEquation, arm, hand_distance_cm, hand_position
from paper.arm.system.opensim import (
    JOINTS,
    ArmSimulation,
    add_controller,
    load_opensim,
    skeleton,
)
from paper.arm.system.reaching import ARM_SPEC, arm_reward, arm_start, arm_targets
from paper.arm.system.torque_arm import BELIEVED_ARM

OTHER_ARM = ArmEquation((1.3, 2.1), (0.4, 0.2), (0.1, 0.12), (0.03, 0.01), 0.2, (3.0, 5.0))


@pytest.fixture
def states_and_actions(uniform):
    """Draws ``n`` states all over the joints' ranges, and actions."""

    def draw(n, seed=0):
        low = torch.tensor([-0.4, -0.1, -10, -10, 0, 0, 0, 0], dtype=torch.float64)
        high = torch.tensor([2.3, 2.6, 10, 10, 1, 1, 1, 1], dtype=torch.float64)
        rows = low + (high - low) * uniform(n, 8, seed=seed)
        return rows[:, :4], rows[:, 4:]

    return draw


@pytest.fixture(scope="module")
def mechanics():
    """Unbalanced torques, given accelerations, from the Lagrangian of two links."""
    t, *loads = sympy.symbols("t tau_s tau_e d")
    m1, m2, l1, c1, c2, I1, I2 = sympy.symbols("m1 m2 l1 c1 c2 I1 I2", positive=True)
    shoulder, elbow = sympy.Function("s")(t), sympy.Function("e")(t)

    def along(angle):
        return sympy.Matrix([sympy.cos(angle), sympy.sin(angle)])

    speeds = [(c1 * along(shoulder)).diff(t)]
    speeds.append((l1 * along(shoulder) + c2 * along(shoulder + elbow)).diff(t))
    kinetic = (m1 * speeds[0].dot(speeds[0]) + m2 * speeds[1].dot(speeds[1])) / 2
    kinetic += (I1 * shoulder.diff(t) ** 2 + I2 * (shoulder + elbow).diff(t) ** 2) / 2
    *torques, damping = loads
    balance = [
        kinetic.diff(q.diff(t)).diff(t) - kinetic.diff(q) - torque + damping * q.diff(t)
        for q, torque in zip((shoulder, elbow), torques, strict=True)
    ]
    values, accelerations = sympy.symbols("s e s_dot e_dot"), sympy.symbols("s_ddot e_ddot")
    names = [
        *zip([shoulder.diff(t, 2), elbow.diff(t, 2)], accelerations, strict=True),
        *zip([shoulder.diff(t), elbow.diff(t)], values[2:], strict=True),
        *zip([shoulder, elbow], values[:2], strict=True),
    ]
    formulas = [e.subs(names) for e in balance]
    return sympy.lambdify([values, accelerations, loads, (m1, m2, l1, c1, c2, I1, I2)], formulas)


@pytest.mark.parametrize("equation", [BELIEVED_ARM, OTHER_ARM])
def test_equation_is_that_of_the_lagrangian(mechanics, states_and_actions, equation):
    states, actions = (rows.view(5, 10, 4) for rows in states_and_actions(50))
    a1, a2, a3, a4 = actions.unbind(-1)
    loads = (equation.gains[0] * (a3 - a4), equation.gains[1] * (a1 - a2), equation.damping)
    links = (*equation.masses, equation.lengths[0], *equation.centres, *equation.inertias)
    rates = equation(states, actions)
    unbalanced = mechanics(states.unbind(-1), rates[..., 2:].unbind(-1), loads, links)
    assert torch.equal(rates[..., :2], states[..., 2:])
    torch.testing.assert_close(torch.stack(unbalanced), torch.zeros(2, 5, 10).double())


def torque_arm():
    """Build the links in OpenSim, with torques at both joints, in N m; without limits."""
    opensim = load_opensim()
    model, torques = skeleton(opensim, BELIEVED_ARM), []
    for joint in JOINTS:
        torque = opensim.CoordinateActuator(joint)
        torque.setName(f"{joint}_torque")
        torque.setOptimalForce(1.0)
        model.addForce(torque)
        torques.append(torque)
    add_controller(opensim, model, torques)
    return model


def test_ode_agrees_with_opensim(states_and_actions):
    states, actions = states_and_actions(20)
    simulation = ArmSimulation(torque_arm, accuracy=1e-6)
    a1, a2, a3, a4 = actions.numpy().T
    torques = np.array(BELIEVED_ARM.gains) * np.stack([a3 - a4, a1 - a2], -1)
    rows = [simulation.step(*row) for row in zip(states.numpy(), torques, strict=True)]
    physics = pickle.loads(pickle.dumps(arm().physics))
    ours = physics(torch.cat([states, actions], -1))
    np.testing.assert_allclose(ours, np.stack(rows), rtol=0, atol=1e-4)


def test_substeps_are_enough(states_and_actions):
    X = torch.cat(states_and_actions(100), dim=-1)
    fine = ODEPhysics(BELIEVED_ARM, step=0.2, state_dim=4, substeps=400)
    torch.testing.assert_close(arm().physics(X), fine(X), rtol=0, atol=2e-5)


def test_spec_fits_the_physics(states_and_actions):
    starts, (states, actions) = arm_start(5), states_and_actions(5)
    starts[:, :4] = states
    reached = PhysicsDynamics(ARM_SPEC, arm().physics).sample(starts, actions)
    expected = arm().physics(torch.cat([states, actions], dim=-1))
    assert torch.equal(reached, torch.cat([expected, starts[:, 4:]], dim=-1))
    assert torch.equal(ARM_SPEC.observe(starts), starts)


def test_reward_is_minus_the_error_of_the_angles(states_and_actions):
    states = arm_start(12)
    expected = [-math.hypot(*(s[:2] - s[4:]).tolist()) / math.sqrt(2) for s in states]
    reward = arm_reward(torch.zeros(12, 6), states_and_actions(12)[1], states)
    torch.testing.assert_close(reward, torch.tensor(expected, dtype=torch.float64))
    blocks = arm_reward(states.view(3, 4, 6), torch.zeros(3, 4, 4), states.view(3, 4, 6))
    assert torch.equal(blocks.flatten(), reward)


def test_start_is_spread_around_its_mean_at_rest():
    starts = arm_start(20_000)
    degrees = starts.rad2deg()
    mean = torch.tensor([35, 65, 0, 0, 50, 50], dtype=torch.float64)
    torch.testing.assert_close(degrees.mean(0), mean, rtol=0, atol=1.0)
    std = torch.tensor([5, 5, 0, 0, 100 / math.sqrt(12), 100 / math.sqrt(12)], dtype=torch.float64)
    torch.testing.assert_close(degrees.std(0), std, rtol=0, atol=0.5)
    assert 0 <= degrees[:, 4:].min() < 0.1 < 99.9 < degrees[:, 4:].max() <= 100
    torch.manual_seed(0)
    assert torch.equal(arm_start(20_000), starts)


def test_targets_are_a_grid():
    targets = arm_targets().rad2deg().round().int().tolist()
    assert len({tuple(target) for target in targets}) == len(targets) == 121
    assert {angle for target in targets for angle in target} == set(range(0, 101, 10))


def test_hand_is_at_the_end_of_the_links():
    angles = torch.tensor([[0, 0], [math.pi / 2, 0], [0, math.pi]], dtype=torch.float64)
    expected = torch.tensor([[0.642, 0], [0, 0.642], [0.309 - 0.333, 0]], dtype=torch.float64)
    torch.testing.assert_close(hand_position(angles), expected)
    states = arm_start(5)
    assert torch.equal(
        hand_distance_cm(states.clone()[:, [4, 5, 2, 3, 4, 5]]), torch.zeros(5).double()
    )
    states[:, 4:] = states[:, :2] + torch.tensor([math.pi, 0])
    torch.testing.assert_close(
        hand_distance_cm(states), 200 * hand_position(states[:, :2]).norm(dim=-1)
    )
