"""The torque arm's equation and physics, against OpenSim."""

import math
import pickle
from functools import partial

import numpy as np
import pytest
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


def torque_arm(equation):
    """Build the links in OpenSim, with torques at both joints, in N m; without limits."""
    opensim = load_opensim()
    model, torques = skeleton(opensim, equation), []
    for joint in JOINTS:
        torque = opensim.CoordinateActuator(joint)
        torque.setName(f"{joint}_torque")
        torque.setOptimalForce(1.0)
        model.addForce(torque)
        torques.append(torque)
    add_controller(opensim, model, torques)
    return model


@pytest.mark.parametrize("equation", [BELIEVED_ARM, OTHER_ARM])
def test_equation_is_that_of_opensim(states_and_actions, equation):
    states, actions = states_and_actions(20)
    simulation = ArmSimulation(partial(torque_arm, equation), accuracy=1e-6)
    a1, a2, a3, a4 = actions.numpy().T
    torques = np.array(equation.gains) * np.stack([a3 - a4, a1 - a2], -1)
    rows = [simulation.step(*row) for row in zip(states.numpy(), torques, strict=True)]
    believed = pickle.loads(pickle.dumps(arm().physics))
    other = ODEPhysics(equation, step=0.2, state_dim=4, substeps=200)
    physics = believed if equation is BELIEVED_ARM else other
    ours = physics(torch.cat([states, actions], -1).view(5, 4, 8)).flatten(0, 1)
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
