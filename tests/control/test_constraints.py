"""Constraints that hold with a probability."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gpadjust.control import MPC, Moment, MPCAgent, Planner, Return, Rollouts, Task
from gpadjust.control.constraints import margins
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.systems import System
from tests.control.conftest import EVEN, ZERO, Log, half_step, to_one
from tests.point import POINT_SPEC, Point, near_one

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
    found = margins(task(), rows(0.0), rows(0.5), EVEN)
    assert torch.allclose(found, 0.1 * quantile(0.05 / 10).reshape(1, 1))
    three = replace(task(), constraints=lambda s, a: torch.cat([s - 1, -2 * s, a], -1))
    found = margins(three, rows(0.0), rows(0.5), EVEN)
    assert torch.allclose(found[0], torch.tensor([0.1, 0.2, 0.0]).double() * quantile(0.05 / 30))
    assert not margins(replace(task(), probability=None), rows(0.0), rows(0.5), EVEN).any()
    assert not margins(task(error=None), rows(0.0), rows(0.5), EVEN).any()


@pytest.mark.parametrize(("kind", "power"), [(Noisy, 0.5), (PhysicsDynamics, 1.0)])
def test_margins_of_later_steps_are_those_of_a_closed_loop(kind, power):
    """Open loop noise grows as the root of the time, and what is not known as the time."""
    plan = rows(*[0.0] * 30), rows(*[0.0] * 30)
    found = margins(task(kind=kind), *plan, EVEN)
    assert (found[1:] > found[0]).all()
    assert found.max() < 2 * found[0]
    strong = margins(task(kind=kind), *plan, 1e4 * EVEN)
    assert torch.allclose(strong, found[:1].expand_as(strong), rtol=1e-3)  # corrected at once
    open_loop = found[0] * torch.arange(1, 31).double().pow(power).unsqueeze(-1)
    weak = margins(task(kind=kind), *plan, 1e-5 * EVEN)
    assert torch.allclose(weak, open_loop, rtol=1e-2)
    braking = margins(task(kind=kind), plan[0], plan[1] - 1, EVEN)
    assert torch.allclose(braking, open_loop, rtol=1e-2)  # there is no more to brake with
    racing = margins(task(kind=kind), plan[0], plan[1] + 1, EVEN)
    assert torch.allclose(racing, found, rtol=0.3)


def test_the_error_of_an_estimate_stays():
    """It is in each margin, and is no less after a step."""
    estimated = torch.full((1, 1), 0.3**2, dtype=torch.float64)
    found = margins(task(), rows(*[0.0] * 9), rows(*[0.0] * 9), EVEN, estimated)
    assert torch.allclose(found[0], math.hypot(0.1, 0.3) * quantile(0.05 / 10))
    exact = margins(task(error=None), rows(0.0, 0.0), rows(0.0, 0.0), EVEN, estimated)
    assert torch.allclose(exact, 0.3 * quantile(0.05 / 10).expand(2, 1))


def quick(rounds=2, **options):
    return Planner(rounds=rounds, num_random=48, **options)


def end(task, start=0.0, steps=10, noise=0.0, seed=0):
    """The positions of an episode."""
    mpc = MPC(task, EVEN, quick(horizon=4), first=quick(4))
    generator = np.random.default_rng(seed)
    x, plan, passed = np.full(1, start), None, []
    for _ in range(steps):
        action, plan = mpc.predict(x, plan)
        x = x + 0.5 * action + noise * generator.normal()
        passed.append(float(x[0]))
    return np.array(passed), plan[0]


def test_a_plan_keeps_its_margin_of_a_wall():
    margin = float(0.1 * quantile(0.05 / 10))
    passed, plan = end(task())
    assert passed.max() < WALL - margin + 1e-3
    assert passed[-1] == pytest.approx(WALL - margin, abs=0.08)
    assert plan.violation < 1e-3
    planned = quick(4).plan(task(), ZERO, EVEN).next_states
    assert planned.max() < WALL - margin + 1e-3
    passed, _ = end(replace(task(), probability=None))
    assert passed[-1] == pytest.approx(WALL, abs=0.05)
    assert passed.max() < WALL + 1e-3


@pytest.mark.slow
def test_an_episode_violates_constraints_as_seldom_as_it_says():
    """Noise has the stated sd: of 60 episodes 5 % may pass the wall, at 0.95."""
    beyond = {
        p: sum(
            end(replace(task(), probability=p), noise=0.1, seed=seed)[0].max() > WALL
            for seed in range(60)
        )
        for p in (0.95, None)
    }
    assert beyond[0.95] <= 6
    assert beyond[None] >= 40


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
    given = replace(task(), state_bounds=torch.tensor([[-3.0], [3.0]]))
    wide = torch.full((10, 1), 500.0).double()
    sequences = torch.zeros(3, 10, 1).double()
    sequences[1], sequences[2, 0] = -1.0, 1.0  # leaves the bounds after six steps; is nearer
    rollout = Rollouts(given, None, Moment(margins=wide)).follow(ZERO, sequences)
    assert rollout.left_bounds.any(-1).tolist() == [[False, True, False]]
    stays, leaves, nearer = Return().make_score(given)(rollout)
    assert stays > nearer > leaves


@pytest.mark.slow
def test_an_agent_keeps_walls_from_the_first_episode_on():
    error = {"x": 0.05}
    system = System(
        Point, POINT_SPEC, lambda X: X[:, :1] + 0.4 * X[:, 1:], lambda s, a, n: -n[:, 0].square(),
        episode_length=5, constraints=lambda s, a: 0.4 - s, physics_error=error, start=near_one,
    )  # fmt: skip
    plans = Log("plan")
    agent = MPCAgent(system.make(), system.task(), quick(horizon=3), first=quick(), seed=0)
    found = agent.learn(15, plans).recorded_episodes().next_states
    assert found[:5].min() > 0.4  # by f_p and its stated error
    assert (found < 0.4).sum() <= 1  # a few steps tell little of the noise
    assert max(values["violation"] for values in plans) < 1e-3
