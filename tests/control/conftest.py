"""The point, agents of both kinds that learn to move it, and short plans."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import pytest
import torch

from gpadjust.control import MPCAgent, Planner, PolicySearch, PolicySearchAgent, Task
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.physics import PhysicsError
from tests.point import *  # noqa: F403
from tests.point import POINT_SPEC, linear, near_one

PLAN = Planner(rounds=1, horizon=3, num_random=32, max_hold=1)
SEARCH = PolicySearch(updates=12, num_starts=6, num_functions=2, learning_rate=0.05)
BOUNDS = torch.tensor([[-1.0], [2.0]], dtype=torch.float64)
EVEN = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
ZERO = torch.zeros(1, dtype=torch.float64)
quick = partial(Planner, num_random=48, max_hold=1)


def half_step(X):
    return X[:, :1] + 0.5 * X[:, 1:2]


def fails_beyond(limit):
    """The physics of the point, which fails beyond a distance from zero."""

    def physics(X):
        bad = (X[:, 0].abs() > limit).nonzero().flatten().tolist()
        if bad:
            raise PhysicsError("too far", rows=bad)
        return half_step(X)

    return physics


def full_step(X):
    return X.sum(-1, True)


def to_one(states, actions, next_states):
    return -(next_states[:, 0] - 1).abs()


def point_of(physics=half_step, reward=to_one, spec=POINT_SPEC, **parts):
    """The task of a point that moves by half of the action."""
    return Task(PhysicsDynamics(spec, physics), reward, **parts)


class Log(list):
    """A callback that keeps the numbers of some events."""

    def __init__(self, event):
        super().__init__()
        self.event = event

    def __call__(self, agent, event, values):
        if event == self.event:
            self.append(values)


class Kind(NamedTuple):
    """What tests of all agents have to know of one."""

    options: dict[str, Any]  # its arguments at the point
    events: tuple[str, ...] = ()  # of an improvement
    untrained: str | None = None  # message of `predict` if nothing is known yet; None if it acts
    learnt: Callable[[Any], Any] = lambda agent: None  # beside the dynamics, in nested values


KINDS = {
    MPCAgent: Kind({"each_step": PLAN, "first": PLAN}, untrained="has no model"),
    PolicySearchAgent: Kind(
        {"policy": linear, "search": SEARCH},
        events=("search",),
        learnt=lambda agent: agent.policy.state_dict(),
    ),
}


def described(agent):
    """What is said of the kind of an agent, or of the one that it is derived from."""
    return next(KINDS[each] for each in type(agent).__mro__ if each in KINDS)


@pytest.fixture
def slow_reward(monkeypatch):
    """A reward of the point, of which a call takes a second, and the clock."""
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def slow(*transitions):
        clock[0] += 1.0
        return to_one(*transitions)

    return slow, clock


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def make_agent(point_env, point_task, learnt_dynamics):
    """Makes an agent of a kind for the point; parts of the task and arguments can be given."""

    def make(kind, env=None, **given):
        parts = {"dynamics": learnt_dynamics(), "initial_states": near_one}
        names = {*Task.__dataclass_fields__} & {*given}
        task = point_task(**{**parts, **{name: given.pop(name) for name in names}})
        how = KINDS[kind].options if kind in KINDS else {}
        env = point_env() if env is None else env
        return kind(env, task, **{**how, "score_horizons": (), "seed": 0, **given})

    return make
