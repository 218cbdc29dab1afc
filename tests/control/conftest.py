"""The point, and agents of both kinds that learn to move it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from gpadjust.control import (
    MPCAgent,
    Planner,
    PolicySearch,
    PolicySearchAgent,
)
from tests.point import *  # noqa: F403
from tests.point import linear, near_one

PLAN = Planner(rounds=1, horizon=3, num_random=32, max_hold=1)
SEARCH = PolicySearch(updates=12, num_starts=6, num_functions=2, learning_rate=0.05)


class Kind(NamedTuple):
    """What tests of all agents have to know of one.

    Args:
        options: Its arguments at the point.
        events: Those of an improvement.
        untrained: Message of its `predict` if nothing is known yet; None if it acts.
        learnt: What it has learnt beside the dynamics, in nested values.
    """

    options: dict[str, Any]
    events: tuple[str, ...] = ()
    untrained: str | None = None
    learnt: Callable[[Any], Any] = lambda agent: None


KINDS = {
    MPCAgent: Kind({"each_step": PLAN, "first": PLAN}, untrained="knows nothing"),
    PolicySearchAgent: Kind(
        {"policy": linear, "search": SEARCH},
        events=(*["update"] * 12, "search"),
        learnt=lambda agent: agent.policy.state_dict(),
    ),
}


def described(agent):
    """What is said of the kind of an agent, or of the one that it is derived from."""
    return next(KINDS[each] for each in type(agent).__mro__ if each in KINDS)


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def make_agent(point_env, point_task, learnt_dynamics):
    """Makes an agent of a kind for the point; parts of the task and arguments can be given."""

    def make(kind, env=None, **given):
        parts = {"dynamics": learnt_dynamics(), "initial_states": near_one}
        names = {
            "dynamics",
            "reward",
            "initial_states",
            "state_bounds",
            "episode_length",
            "action_rate",
        }
        task = point_task(**{**parts, **{name: given.pop(name) for name in names & {*given}}})
        how = KINDS[kind].options if kind in KINDS else {}
        env = point_env() if env is None else env
        return kind(env, task, **{**how, "score_horizons": (), "seed": 0, **given})

    return make
