"""Set-points that move during an episode."""

import gymnasium
import numpy as np
import pytest
import torch

from gpadjust.control import Moment, MPCAgent, Planner, Rollouts, Task
from gpadjust.dynamics import PhysicsDynamics, StateSpec

SPEC = StateSpec(["x", "goal"], ["v"], exogenous=["goal"])


def wave(states, steps):
    return torch.sin(0.8 * steps).unsqueeze(-1)


def near(states, actions, next_states):
    return -(next_states[:, 0] - next_states[:, 1]).abs()


def point(reference=wave):
    dynamics = PhysicsDynamics(SPEC, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    return Task(dynamics, near, reference=reference, episode_length=8)


class Tracking(gymnasium.Env):
    """A point whose goal moves as `wave` does."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.x = 0, 0.0
        return self._seen(), {}

    def step(self, action):
        self.steps, self.x = self.steps + 1, self.x + 0.5 * float(action[0])
        seen = self._seen()
        return seen, -abs(seen[0] - seen[1]), False, self.steps == 8, {}

    def _seen(self):
        return np.array([self.x, np.sin(0.8 * self.steps)])


PLAN = Planner(rounds=4, horizon=3, num_random=64, max_hold=2)


def test_plans_know_the_reference_from_the_step_where_they_begin():
    for done in (0, 5):
        rollouts = Rollouts(point(), None, Moment(steps_done=done))
        rollout = rollouts.follow(torch.zeros(2).double(), torch.zeros(1, 3, 1).double())
        goals = torch.sin(0.8 * (done + torch.arange(1, 4)))
        assert torch.allclose(rollout.next_states[0, 0, :, 1], goals.double())
        assert torch.allclose(rollout.rewards[0, 0], -goals.abs().double())


def test_an_agent_that_sees_it_coming_is_better():
    def returns(reference):
        options = {"reward_tolerance": None, "score_horizons": (), "seed": 0}
        agent = MPCAgent(Tracking(), point(reference), PLAN, first=PLAN, **options)
        return float(agent.learn(16).recorded_episodes().rewards.mean())

    stays = lambda states, steps: states[:, 1:]  # noqa: E731
    assert returns(wave) > returns(stays) + 0.1


def test_a_reference_that_is_not_the_environments_is_refused():
    agent = MPCAgent(
        Tracking(), point(lambda s, t: wave(s, t + 1)), PLAN, first=PLAN, score_horizons=()
    )
    with pytest.raises(ValueError, match=r"reference.* after step 1 .*Number the steps from 1"):
        agent.learn(8)


def test_a_set_point_that_is_an_angle_goes_round():
    spec = StateSpec(["x", "goal"], ["v"], angles=["goal"], exogenous=["goal"])

    class Turning(Tracking):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

        def _seen(self):
            return np.array([self.x, np.sin(self.steps), np.cos(self.steps)])

    dynamics = PhysicsDynamics(spec, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    turns = lambda states, steps: steps.double().unsqueeze(-1)  # noqa: E731
    task = Task(dynamics, near, reference=turns, episode_length=8)
    how = {"each_step": PLAN, "first": PLAN, "reward_tolerance": 1e9, "score_horizons": ()}
    assert MPCAgent(Turning(), task, **how).learn(8).num_episodes == 1


@pytest.mark.parametrize(
    ("reference", "message"),
    [(lambda s, t: s, r"shape 2 x 1; found \(2, 2\)"), (lambda s, t: s[:, :1] / 0, "finite")],
)
def test_what_a_reference_returns_is_checked_before_the_first_step(reference, message):
    with pytest.raises(ValueError, match=message):
        MPCAgent(Tracking(), point(reference), PLAN, first=PLAN).learn(8)
