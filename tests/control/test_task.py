"""A step of a task: rates of actions, set-points, walls and constraints."""

from dataclasses import replace

import gymnasium
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


def test_a_step_has_its_limits_in_one_place():
    """From 0 by half of an action of 1.5, of which the rate leaves 1, to a wall at 0.4."""
    dynamics = PhysicsDynamics(GOAL, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    parts = {
        "reference": lambda states, steps: 10.0 * steps.unsqueeze(-1),
        "constraints": lambda states, actions: states[:, :1] - 0.25,
        "action_rate": ActionRate(1.0, price=2.0),
    }
    free = Task(dynamics, near, **parts)
    zero = torch.zeros(1, 1).double()
    moment = Moment(3, zero[0], margins=torch.tensor([[0.5], [9.0]]).double())
    start, move = torch.zeros(1, 2).double(), dynamics.mean_function()
    how = {"move": lambda *rows: move(*(each[None] for each in rows))[0]}
    step = free.step(start, zero + 1.5, moment, **how)
    assert step.actions.item() == 1.0
    assert step.price.item() == 2.0
    assert step.next_states.tolist() == [[0.5, 40.0]]
    assert step.rewards.item() == -39.5
    assert step.violation.item() == pytest.approx(0.5 - 0.25 + 0.5)
    assert step.made.all()
    later = moment.after(step.actions)
    assert (later.steps_done, later.action.item(), later.margins.item()) == (4, 1.0, 9.0)
    assert later.after(step.actions).margins.item() == 9.0
    walled = replace(free, state_bounds=torch.tensor([[-0.4, -99.0], [0.4, 99.0]]))
    step = walled.step(start, zero + 1.5, moment, **how)
    assert step.left_bounds.all()
    assert not step.made.any()
    assert step.next_states.tolist() == start.tolist()
    assert step.overshoot.item() == pytest.approx(0.1 / 0.4)


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
    with pytest.raises(ValueError, match=r"more than action_rate allows.*leave action_noise out"):
        noisy.learn(5)
    assert noisy.num_timesteps == 0


# Set-points that move during an episode

GOAL = StateSpec(["x", "goal"], ["v"], exogenous=["goal"])


def wave(states, steps):
    return torch.sin(0.8 * steps).unsqueeze(-1)


def near(states, actions, next_states):
    return -(next_states[:, 0] - next_states[:, 1]).abs()


def point(reference=wave):
    dynamics = PhysicsDynamics(GOAL, lambda X: X[:, :1] + 0.5 * X[:, 1:])
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
