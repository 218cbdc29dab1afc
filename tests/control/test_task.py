"""A step of a task: rates of actions, set-points, walls and constraints."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

from gpadjust.control import MPC, ActionRate, Moment, MPCAgent, Planner, Return, Rollouts, Task
from gpadjust.dynamics import PhysicsDynamics, StateSpec
from tests.control.conftest import EVEN, ZERO, point_of

GOAL = StateSpec(["x", "goal"], ["v"], exogenous=["goal"])
PLAN = Planner(rounds=4, horizon=3, num_random=64, max_hold=2)


def wave(states, steps):
    return torch.sin(0.8 * steps).unsqueeze(-1)


def near(states, actions, next_states):
    return -(next_states[:, 0] - next_states[:, 1]).abs()


def goal_of(reference=wave, spec=GOAL, **parts):
    """The point with a goal that moves."""
    dynamics = PhysicsDynamics(spec, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    return Task(dynamics, near, reference=reference, episode_length=8, **parts)


def test_a_step_has_its_limits_in_one_place():
    """From 0 by half of an action of 1.5, of which the rate leaves 1, to a wall at 0.4."""
    free = goal_of(
        lambda states, steps: 10.0 * steps.unsqueeze(-1),
        constraints=lambda states, actions: states[:, :1] - 0.25,
        action_rate=ActionRate(1.0, price=2.0),
    )
    zero = torch.zeros(1, 1).double()
    moment = Moment(3, zero[0], margins=torch.tensor([[0.5], [9.0]]).double())
    start, move = torch.zeros(1, 2).double(), free.dynamics.mean_function()
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


# Rates of actions


def changes(rate):
    """Changes of the actions of an episode."""
    task = point_of(episode_length=8, action_rate=rate)
    quick = Planner(rounds=3, num_random=48, horizon=4)
    x, plan, taken = np.zeros(1), None, []
    mpc = MPC(task, EVEN, quick, first=quick)
    for _ in range(8):
        action, plan = mpc.predict(x, plan)
        x = x + 0.5 * action
        taken.append(float(action[0]))
    return np.diff(np.array(taken))


def test_no_action_changes_by_more_than_it_may_and_a_price_makes_them_smoother():
    assert 0.1 < np.abs(changes(0.25)).max() <= 0.25 + 1e-6
    rough, smooth = changes(None), changes(ActionRate(price=5.0))
    assert np.abs(rough).max() > 0.5
    assert np.square(smooth).sum() < 0.5 * np.square(rough).sum()


def test_sequences_follow_as_fast_as_they_may():
    wanted = torch.tensor([[[0.0, 0.0], [1.0, 1.0], [-1.0, 1.0]]]).double()
    spec = StateSpec(["x"], ["u", "v"])
    two = point_of(lambda X: X[:, :1], spec=spec, action_rate=[0.5, 0.25])
    for before, taken in (
        (None, [[0.0, 0.0], [0.5, 0.25], [0.0, 0.5]]),
        (torch.tensor([1.0, 0.0]).double(), [[0.5, 0.0], [1.0, 0.25], [0.5, 0.5]]),
    ):
        steps = Rollouts(two, None, Moment(action=before)).follow(ZERO, wanted)
        assert steps.actions[0, 0].tolist() == taken


def test_the_price_is_of_squared_changes_from_the_action_before():
    priced = point_of(action_rate=ActionRate(price=2.0))
    way = torch.tensor([[[1.0], [0.0]]]).double()
    for before, price in ((None, 2.0), (ZERO, 4.0)):
        rollout = Rollouts(priced, None, Moment(action=before)).follow(ZERO, way)
        assert rollout.price.sum().item() == pytest.approx(price)
        score = Return().make_score(priced)(rollout)
        assert score.item() == pytest.approx(rollout.rewards.sum() - price)


# Set-points that move during an episode


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


def tracker(task, env=Tracking, **options):
    return MPCAgent(env(), task, PLAN, first=PLAN, score_horizons=(), seed=0, **options)


def test_plans_know_the_reference_from_the_step_where_they_begin():
    for done in (0, 5):
        rollouts = Rollouts(goal_of(), None, Moment(steps_done=done))
        rollout = rollouts.follow(torch.zeros(2).double(), torch.zeros(1, 3, 1).double())
        goals = torch.sin(0.8 * (done + torch.arange(1, 4)))
        assert torch.allclose(rollout.next_states[0, 0, :, 1], goals.double())
        assert torch.allclose(rollout.rewards[0, 0], -goals.abs().double())


def test_a_set_point_is_seen_coming_and_an_angle_goes_round():
    class Turning(Tracking):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

        def _seen(self):
            return np.array([self.x, np.sin(self.steps), np.cos(self.steps)])

    moves, stays = (
        tracker(goal_of(reference), reward_tolerance=None).learn(16).recorded_episodes().rewards
        for reference in (wave, lambda states, steps: states[:, 1:])
    )
    assert moves.mean() > stays.mean() + 0.1
    spec = StateSpec(["x", "goal"], ["v"], angles=["goal"], exogenous=["goal"])
    task = goal_of(lambda states, steps: steps.double().unsqueeze(-1), spec)
    assert tracker(task, Turning, reward_tolerance=1e9).learn(8).num_episodes == 1


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (lambda s, t: s, r"shape 2 x 1; found \(2, 2\)"),
        (lambda s, t: s[:, :1] / 0, "finite"),
        (lambda s, t: wave(s, t + 1), r"reference.* after step 1 .*Number the steps from 1"),
    ],
)
def test_a_reference_that_is_not_the_environments_is_refused(reference, message):
    with pytest.raises(ValueError, match=message):
        tracker(goal_of(reference)).learn(8)
