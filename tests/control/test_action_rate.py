"""Limits and prices of the change of actions."""

import numpy as np
import pytest
import torch

from gpadjust.control import (
    MPC,
    ActionRate,
    Moment,
    MPCAgent,
    Planner,
    Return,
    Rollouts,
    Task,
)
from gpadjust.dynamics import PhysicsDynamics, StateSpec

SPEC = StateSpec(["x"], ["v"])
BOUNDS = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)


def to_one(states, actions, next_states):
    return -(next_states[:, 0] - 1).abs()


def task(**parts):
    dynamics = PhysicsDynamics(SPEC, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    return Task(dynamics, to_one, episode_length=8, **parts)


def actions(task, steps=8):
    quick = Planner(rounds=3, num_random=48, horizon=4)
    x, plan, taken = np.zeros(1), None, []
    mpc = MPC(task, BOUNDS, quick, first=quick)
    for _ in range(steps):
        action, plan = mpc.predict(x, plan)
        x = x + 0.5 * action
        taken.append(float(action[0]))
    return np.array(taken)


@pytest.mark.parametrize("rate", [0.25, [0.25], ActionRate(0.25), ActionRate(0.25, price=0.1)])
def test_no_action_changes_by_more_than_it_may(rate):
    changes = np.abs(np.diff(actions(task(action_rate=rate))))
    assert changes.max() <= 0.25 + 1e-6
    assert changes.max() > 0.1
    assert np.abs(np.diff(actions(task()))).max() > 0.5


def test_a_price_makes_actions_smoother():
    rough, smooth = (
        np.square(np.diff(actions(task(action_rate=rate)))).sum()
        for rate in (None, ActionRate(price=5.0))
    )
    assert smooth < 0.5 * rough


def test_sequences_follow_as_fast_as_they_may():
    wanted = torch.tensor([[[0.0, 0.0], [1.0, 1.0], [-1.0, 1.0]]])
    spec = StateSpec(["x"], ["u", "v"])
    dynamics = PhysicsDynamics(spec, lambda X: X[:, :1])
    two = Task(dynamics, to_one, action_rate=ActionRate([0.5, 0.25]))

    def taken(before):
        rollouts = Rollouts(two, None, Moment(action=before))
        return rollouts.follow(torch.zeros(1).double(), wanted.double()).actions[0, 0].tolist()

    assert taken(None) == [[0.0, 0.0], [0.5, 0.25], [0.0, 0.5]]
    before = torch.tensor([1.0, 0.0]).double()
    assert taken(before) == [[0.5, 0.0], [1.0, 0.25], [0.5, 0.5]]


def test_the_price_is_of_squared_changes_from_the_action_before():
    priced = task(action_rate=ActionRate(price=2.0))
    way = torch.tensor([[[1.0], [0.0]]]).double()
    for before, expected in ((None, 2.0), (torch.zeros(1).double(), 4.0)):
        rollout = Rollouts(priced, None, Moment(action=before)).follow(torch.zeros(1).double(), way)
        assert rollout.price.sum().item() == pytest.approx(expected)
        assert Return().of(priced)(rollout).item() == pytest.approx(
            rollout.rewards.sum() - expected
        )


def test_random_actions_keep_the_limit_and_noise_is_refused(make_agent, point_env):
    agent = make_agent(MPCAgent, random_steps=10, action_rate=0.25).learn(10)
    recorded = agent.recorded_episodes()
    changes = recorded.actions.diff(dim=0).abs()[recorded.steps[1:] > 1]
    assert 0.1 < changes.max() <= 0.25 + 1e-6
    noisy = make_agent(MPCAgent, action_noise=lambda: np.ones(1), action_rate=0.25)
    with pytest.raises(ValueError, match="more than action_rate allows; leave action_noise out"):
        noisy.learn(5)
    assert noisy.num_timesteps == 0
