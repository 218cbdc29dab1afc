"""Constraints that hold with a probability."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from gpadjust.control import MPC, Moment, MPCAgent, Planner, Return, Rollouts, Task
from gpadjust.control.constraints import margins
from gpadjust.dynamics import PhysicsDynamics
from tests.control.conftest import EVEN, ZERO, Log, half_step, to_one
from tests.point import POINT_SPEC
from tests.systems import normal

WALL = 1.0


class Noisy(PhysicsDynamics):
    """Dynamics whose whole error is noise, another one in each step."""

    def noise_variance(self, states, actions):
        return self.predict(states, actions).variance


def task(error=0.1, kind=Noisy, **parts):
    dynamics = kind(POINT_SPEC, half_step, physics_error={"x": error} if error else None)
    known = {"episode_length": 10, "constraints": lambda states, actions: states[:, :1] - WALL}
    return Task(dynamics, to_one, **{**known, **parts})


def rows(*values):
    return torch.tensor(values, dtype=torch.float64).unsqueeze(-1)


def quantile(risk):
    return torch.special.ndtri(torch.tensor(1 - risk).double())


def test_margins_of_a_step_are_quantiles_of_its_error():
    step = rows(0.0), rows(0.5), EVEN
    found = margins(task(), *step)
    assert torch.allclose(found, 0.1 * quantile(0.05 / 10).reshape(1, 1))
    three = replace(task(), constraints=lambda s, a: torch.cat([s - 1, -2 * s, a], -1))
    expected = torch.tensor([[0.1, 0.2, 0.0]]).double() * quantile(0.05 / 30)
    assert torch.allclose(margins(three, *step), expected)
    for exact in (replace(task(), probability=None), task(error=None)):
        assert not margins(exact, *step).any()


@pytest.mark.parametrize(("kind", "power"), [(Noisy, 0.5), (PhysicsDynamics, 1.0)])
def test_margins_of_later_steps_are_those_of_a_closed_loop(kind, power):
    """Open loop noise grows as the root of the time, and what is not known as the time."""

    def found(action=0.0, strength=1.0):
        plan = torch.zeros(30, 1).double(), torch.full((30, 1), action).double()
        return margins(task(kind=kind), *plan, strength * EVEN)

    usual = found()
    assert (usual[1:] > usual[0]).all()
    assert usual.max() < 2 * usual[0]
    open_loop = usual[0] * torch.arange(1, 31).double().pow(power).unsqueeze(-1)
    strong = usual[:1].expand_as(usual)  # corrected at once
    assert torch.allclose(found(strength=1e4), strong, rtol=1e-3)
    assert torch.allclose(found(strength=1e-5), open_loop, rtol=1e-2)
    assert torch.allclose(found(-1.0), open_loop, rtol=1e-2)  # there is no more to brake with
    assert torch.allclose(found(1.0), usual, rtol=0.3)


def test_the_error_of_an_estimate_stays():
    """It is in each margin, and is no less after a step."""
    plan = rows(0.0, 0.0), rows(0.0, 0.0), EVEN, rows(0.3**2)
    assert torch.allclose(margins(task(), *plan)[0], math.hypot(0.1, 0.3) * quantile(0.05 / 10))
    exact = margins(task(error=None), *plan)
    assert torch.allclose(exact, 0.3 * quantile(0.05 / 10).expand(2, 1))


quick = partial(Planner, num_random=48)


def end(task, start=0.0, steps=10, noise=0.0, seed=0):
    """The positions of an episode."""
    mpc = MPC(task, EVEN, quick(rounds=2, horizon=4), first=quick(rounds=4))
    x, plan, passed = np.full(1, start), None, []
    for disturbance in noise * normal(steps, seed=seed).numpy():
        action, plan = mpc.predict(x, plan)
        x = x + 0.5 * action + disturbance
        passed.append(float(x[0]))
    return np.array(passed), plan[0]


def test_a_plan_keeps_its_margin_of_a_wall():
    margin = float(0.1 * quantile(0.05 / 10))
    for given, room in ((task(), margin), (replace(task(), probability=None), 0.0)):
        passed, plan = end(given)
        assert passed.max() < WALL - room + 1e-3
        assert passed[-1] == pytest.approx(WALL - room, abs=0.08)
        assert plan.violation < 1e-3


@pytest.mark.slow
def test_an_episode_violates_constraints_as_seldom_as_it_says():
    """Noise has the stated sd: of 30 episodes 5 % may pass the wall, at 0.95."""
    passed = {
        p: [
            end(replace(task(), probability=p), noise=0.1, seed=seed)[0].max() > WALL
            for seed in range(30)
        ]
        for p in (0.95, None)
    }
    assert sum(passed[0.95]) <= 3
    assert sum(passed[None]) >= 20


def test_where_none_can_hold_the_least_violation_is_sought():
    passed, _ = end(task(), start=3.0, steps=6)
    assert passed[0] == pytest.approx(2.5, abs=0.1)
    assert passed[-1] < 0.85
    assert end(task(), start=3.0, steps=1)[1].violation > 1


def test_a_violation_costs_more_than_any_reward_and_as_much_as_it_is():
    """Of rollouts that go up, stop at the wall, and pass it by one and by two."""
    sure = task(error=None)
    ways = torch.stack([rows(*way) for way in ([1.0, 0.0], [1.0, 1.0], [2.0, 2.0], [2.0, 4.0])])
    rollout = Rollouts(sure, None).follow(ZERO, ways)
    assert torch.allclose(rollout.violation[0, :, 1], torch.tensor([0.0, 0.0, 1.0, 2.0]).double())
    values = Return().make_score(sure)(rollout)
    assert (values[2:] < values[0] - 1e5).all()
    assert values.argsort(descending=True).tolist() == [1, 0, 2, 3]
    tight = Rollouts(sure, None, Moment(margins=rows(0.25))).follow(ZERO, ways)
    assert tight.violation[0, :, 1].tolist() == [0.0, 0.25, 1.25, 2.25]


def test_what_leaves_the_bounds_is_worse_than_any_violation():
    """Margins of hundreds of units, as of a system that is not stable."""
    given = task(state_bounds=torch.tensor([[-3.0], [3.0]]))
    wide = torch.full((10, 1), 500.0).double()
    sequences = torch.zeros(3, 10, 1).double()
    sequences[1], sequences[2, 0] = -1.0, 1.0  # leaves the bounds after six steps; is nearer
    rollout = Rollouts(given, None, Moment(margins=wide)).follow(ZERO, sequences)
    assert rollout.left_bounds.any(-1).tolist() == [[False, True, False]]
    stays, leaves, nearer = Return().make_score(given)(rollout)
    assert stays > nearer > leaves


@pytest.mark.slow
def test_an_agent_keeps_walls_from_the_first_episode_on(make_agent, learnt_dynamics):
    dynamics, plans = learnt_dynamics(physics_error={"x": 0.05}), Log("plan")
    plan = quick(rounds=2, horizon=3)
    agent = make_agent(
        MPCAgent, dynamics=dynamics, constraints=lambda s, a: 0.4 - s, each_step=plan, first=plan
    )
    found = agent.learn(15, plans).recorded_episodes().next_states
    assert found[:5].min() > 0.4  # by f_p and its stated error
    assert (found < 0.4).sum() <= 1  # a few steps tell little of the noise
    assert max(values["violation"] for values in plans) < 1e-3
