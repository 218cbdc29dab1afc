"""The point, and agents of both kinds that learn to move it."""

import pytest

from gpadjust.control import (
    CrossEntropy,
    MPCAgent,
    Planner,
    PolicySearch,
    PolicySearchAgent,
    linear_policy,
)
from tests.point import *  # noqa: F403
from tests.point import near_one

PLAN = Planner(search=CrossEntropy(1), horizon=3, num_random=32, max_hold=1)
SEARCH = PolicySearch(updates=12, num_starts=6, num_functions=2, learning_rate=0.05)


@pytest.fixture(params=[MPCAgent, PolicySearchAgent])
def kind(request):
    return request.param


@pytest.fixture
def make_agent(point_env, point_task, learnt_dynamics):
    """Makes an agent of a kind for the point; parts of the task and arguments can be given."""

    def make(kind, env=None, **given):
        parts = {"dynamics": learnt_dynamics(), "initial_states": near_one}
        names = {"dynamics", "reward", "initial_states", "state_bounds", "episode_length"}
        task = point_task(**{**parts, **{name: given.pop(name) for name in names & {*given}}})
        how = {"each_step": PLAN, "first": PLAN}
        if kind is PolicySearchAgent:
            how = {"policy": linear_policy, "search": SEARCH}
        env = point_env() if env is None else env
        return kind(env, task, **{**how, "score_horizons": (), "seed": 0, **given})

    return make
