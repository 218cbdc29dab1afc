"""A controller that plans at every step."""

import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

from gpadjust.control import MPC, MPCAgent, Planner, Task
from gpadjust.dynamics import LearnedDynamics, StateSpec, Trajectories
from tests.control.conftest import (
    BOUNDS,
    EVEN,
    full_step,
    point_of,
    quick,
    to_one,
)
from tests.point import POINT_SPEC
from tests.systems import normal, refused

QUICK = {"fit_options": {"method": "map"}}


@pytest.fixture
def task():
    return point_of(episode_length=6)


def test_a_loop_of_the_users_learns_and_goes_on_in_the_newest_model():
    """The plant moves half as far as f_p says."""
    dynamics = LearnedDynamics(POINT_SPEC, full_step, **QUICK)
    task = Task(dynamics, to_one, episode_length=6)
    controller, errors = MPC(task, BOUNDS, quick(rounds=3, horizon=3), first=quick(rounds=3)), []
    for _ in range(2):
        controller.reset()
        x, plan = np.zeros(1), None
        for _ in range(6):
            predicted, plan = controller.predict(x, plan)
            action = controller.step(x)
            assert action.astype(np.float32) == predicted
            assert -1 <= action[0] <= 2
            x = x + 0.5 * action
            errors.append(abs(float(x[0]) - 1))
        controller.observe(x)
        assert controller.learn() is controller
    moved = dynamics.predict(torch.zeros(1, 1).double(), torch.ones(1, 1).double()).mean
    assert moved.item() == pytest.approx(0.5, abs=0.01)
    assert errors[6] < errors[0] - 0.1  # it knows how far it gets by now
    assert repr(controller) == "MPC(LearnedDynamics, 12 transitions learnt)"
    rows = torch.linspace(-1, 1, 4).double().unsqueeze(-1)
    controller.learn(Trajectories(rows, rows, 1.5 * rows))
    assert dynamics.num_transitions == 16


def test_no_transition_goes_across_what_was_not_measured():
    dynamics = LearnedDynamics(POINT_SPEC, full_step, **QUICK)
    controller = MPC(Task(dynamics, to_one, episode_length=9), BOUNDS, quick(rounds=0))
    for x, words in (
        (0.0, None),
        (0.1, None),
        (np.nan, r"'x', entry 0 of the observation is nan.*Stop the ma"),
        (7.0, None),
        ([[1.0], [2.0]], r"of 1 numbers, found shape \(2, 1\)"),
        (9.0, None),
        (9.1, None),
    ):
        with pytest.raises(ValueError, match=words) if words else nullcontext():
            controller.step(x)
    assert controller.learn().task.dynamics.num_transitions == 2
    refused(ValueError, "no new transition to learn", controller.learn)
    refused(TypeError, r"data must be Trajectories\(", controller.learn, [1.0])


def test_an_agent_makes_one_controller_for_each_model(make_agent, monkeypatch):
    made, real = [], MPC.__init__

    def init(self, task, *others, **options):
        made.append(task)
        real(self, task, *others, **options)

    monkeypatch.setattr(MPC, "__init__", init)
    agent = make_agent(MPCAgent).learn(10)
    assert len(made) == 2
    assert agent.mpc.task is agent.model
    agent.tolerance = None
    assert agent.mpc.tolerance is None


def test_a_loop_needs_no_gymnasium():
    code = """
import sys
sys.modules["gymnasium"] = None
from gpadjust.control import MPC, Planner, Task
from gpadjust.dynamics import PhysicsDynamics, StateSpec
point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X.sum(-1, keepdim=True))
task = Task(point, lambda states, actions, following: -following[:, 0].abs())
print(MPC(task, [[-1.0], [1.0]], Planner(horizon=2)).step([0.5]).shape)
from gpadjust.control import MPCAgent
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.stdout == "(1,)\n"
    assert "gpadjust.control.MPCAgent needs Gymnasium; run `pip install" in found.stderr


@pytest.fixture
def calls(monkeypatch):
    """Plans that were asked for: horizon, steps, earlier plan, actions."""
    calls, real = [], Planner.plan

    def plan(self, task, state, bounds, num_steps=None, **others):
        found = real(self, task, state, bounds, num_steps, **others)
        calls.append((self.horizon, num_steps, others.get("earlier"), found.actions))
        return found

    monkeypatch.setattr(Planner, "plan", plan)
    return calls


def test_plans_go_on_from_earlier_ones_and_end_with_the_episode(task, calls):
    planners = quick(rounds=3, horizon=2), quick(rounds=3, horizon=5)
    mpc = MPC(task, BOUNDS, planners[0], first=planners[1], tolerance=None)
    x, state = np.zeros((2, 1)), None
    for t in range(3):
        starts = np.array([t == 0, t in (0, 2)])
        _, state = mpc.predict(x, state, starts)
    assert [each[0] for each in calls] == [5, 5, 2, 2, 2, 5]  # the second one begins anew
    assert [each[1] for each in calls] == [6, 6, 5, 5, 4, 6]
    assert calls[0][2] is None
    assert torch.equal(calls[2][2].actions, calls[0][3][1:])
    # Beyond the horizon, as planned before
    assert torch.equal(calls[4][2].actions[1:], calls[0][3][3:])
    assert [each.moment.steps_done for each in state] == [3, 1]


def test_what_disappoints_is_planned_anew(calls):
    """The model has no wind; where it has blown the point far away, the whole rest is planned.

    A plan of the rest is two, of which the second begins with parts of three steps.
    """
    task = point_of(full_step, episode_length=8)
    whole = [None, None]
    for tolerance, asked in ((0.25, [*whole, 2, 2, *whole, 2]), (None, [*whole, 2, 2, 2])):
        calls.clear()
        planners = quick(rounds=3, horizon=2), quick(rounds=3)
        mpc = MPC(task, BOUNDS, planners[0], first=planners[1], tolerance=tolerance)
        _, state = mpc.predict(np.zeros(1))
        for x in (1.0, -4.0, -3.0):
            _, state = mpc.predict(np.array([x]), state)
        assert [each[0] for each in calls if each[0] != 3] == asked
        assert 3 in [each[0] for each in calls]
        assert len(state[0].promised) == 8
        assert len(state[0].actions) == 4


def test_decisions_within_an_episode_are_in_time(slow_reward):
    """A wind that the model lacks disappoints; the rest is planned again if there is time."""
    reward, clock = slow_reward
    task = point_of(full_step, reward, episode_length=8)
    for seconds, again in ((5.5, False), (40.0, True)):
        mpc = MPC(task, BOUNDS, quick(rounds=1, horizon=2, seconds=seconds))
        assert mpc.first.seconds is None
        _, state = mpc.predict(np.zeros(1))
        assert clock[0] > 40  # the first plan takes its time
        promised = state[0].promised
        for left, x in ((7, 1.0), (6, -4.0)):
            clock[0] = 0.0
            _, state = mpc.predict(np.array([x]), state)
            assert 0 < clock[0] <= seconds
            assert len(state[0].actions) == left - 1
        assert (not torch.equal(state[0].promised, promised)) == again
        assert len(state[0].promised) == 8


def test_the_default_plans_look_a_third_of_the_episode_ahead_but_not_for_ever():
    for step, length, horizon in ((None, 6, 8), (0.1, 45, 1.5), (0.02, 1000, 0.6)):
        task = point_of(full_step, spec=replace(POINT_SPEC, step=step), episode_length=length)
        assert MPC(task, BOUNDS).each_step.horizon == pytest.approx(horizon)


def test_deterministic_actions_are_always_the_same_and_those_of_the_row_alone(task):
    plan, before = quick(rounds=0), torch.get_rng_state()
    mpc = MPC(task, EVEN, plan, first=plan)
    rows = np.array([[0.5], [-0.25], [0.5]])
    together = mpc.predict(rows)[0]
    assert np.array_equal(together, np.stack([mpc.predict(row)[0] for row in rows]))
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(1)
    assert mpc.predict(rows[0], deterministic=False)[0] != together[0]


def test_a_loop_goes_on_beyond_the_length_and_warns_of_a_delay():
    """Of a tank whose pump acts a step late, which nobody has told."""
    spec = StateSpec(["level"], ["pump"])
    dynamics = LearnedDynamics(spec, lambda X: 0.9 * X[:, :1] + 0.5 * X[:, 1:], **QUICK)
    controller = MPC(Task(dynamics, to_one, episode_length=20), EVEN, quick(rounds=3, horizon=6))
    level, last, actions = np.zeros(1), 0.0, []
    for noise in normal(30, 1).numpy():
        actions.append(controller.step(level)[0])
        level = 0.9 * level + 0.5 * last + 0.01 * noise
        last = actions[-1]
    assert max(map(abs, actions[20:])) > 0.05
    with pytest.warns(UserWarning, match=r"follow 'pump' 1 step\(s\) late"):
        controller.learn()
