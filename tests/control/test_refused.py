"""What is refused where it is made, before it costs a step."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch

from gpadjust.control import (
    MPC,
    ActionRate,
    BoundedPolicy,
    EpisodeCheckpoint,
    MPCAgent,
    Planner,
    PolicySearch,
    PolicySearchAgent,
    Return,
)
from gpadjust.dynamics import PhysicsDynamics, StateSpec
from gpadjust.states import Sensors
from tests.point import POINT_SPEC, linear, near_one

BOUNDS = [[-1.0], [2.0]]
GOAL = StateSpec(["x", "goal"], ["force"], exogenous=["goal"])


def wave(states, steps):
    return states[:, 1:]


def env_of(at, **spaces):
    """The environment of the point, with other spaces."""
    env = at.env()
    for name, space in spaces.items():
        setattr(env, name, space)
    return env


def tracking(at, **parts):
    return at.task(dynamics=PhysicsDynamics(GOAL, lambda X: X[:, :1]), reference=wave, **parts)


BOX = gymnasium.spaces.Box
VALUES = [
    (lambda at: Planner("return"), r"such as Return\(\); found 'return'"),
    (lambda at: Planner(num_random=0), "num_random must be at least 1; found 0"),
    (lambda at: Planner(num_functions=0), "num_functions must be at least 1; found 0"),
    (lambda at: Planner(horizon=0), "horizon must be finite and above 0; found 0"),
    (lambda at: Planner(spread=0.0), "spread must be above 0 and below 1; found 0.0"),
    (lambda at: Planner(max_hold=True), "max_hold must be a whole number; found True"),
    (
        lambda at: Planner(Return(quantile=0.1), num_functions=1),
        "is one over functions, but num_functions is 1, one of",
    ),
    (lambda at: Return(quantile=1.0), "quantile must be at least 0 and below 1"),
    (lambda at: Planner(rounds=1.5), "rounds must be a whole number; found 1.5"),
    (lambda at: Planner(correlation=1.0), "correlation must be .* below 1"),
    (
        lambda at: MPC(at.task(episode_length=None), BOUNDS, first=Planner()),
        "give the task an episode_length, or the planner a horizon",
    ),
    (lambda at: PolicySearch(updates=0), "updates must be at least 1; found 0"),
    (
        lambda at: PolicySearch(Return(quantile=0.2)),
        "num_functions is None, the mean alone; give num_func",
    ),
    (
        lambda at: PolicySearch().improve(lambda states: states, at.task()),
        "policy must be a module with parameters",
    ),
    (
        lambda at: PolicySearch().improve(at.policy, at.task(episode_length=None)),
        "task with episode_length",
    ),
    (
        lambda at: PolicySearch().improve(at.policy, at.task(action_rate=0.1)),
        "PolicySearch cannot learn a task with action_rate",
    ),
    (
        lambda at: BoundedPolicy(POINT_SPEC, BOUNDS, first_actions=[3.0]),
        r"1 numbers within \[-1.0\] and \[2.0\]; found \[3",
    ),
    (lambda at: EpisodeCheckpoint("run.ckpt", every=0), "every must be at least 1; found 0"),
    (lambda at: EpisodeCheckpoint("run.ckpt")({}, {}), "for learners with a model"),
]
TASKS = [
    (lambda at: at.task(action_rate=0.0), "most of an action rate must be .* above 0"),
    (lambda at: at.task(action_rate="fast"), "most of an action rate must be a number"),
    (lambda at: at.task(action_rate=[0.1, 0.2]), "one for each of 1 actions; found 2"),
    (lambda at: ActionRate(price=-1.0), r"price must be .* at least 0"),
    (lambda at: at.task(probability=95), "probability must be above 0 and below 1; found 95"),
    (
        lambda at: at.task(constraints=lambda s: s),
        "constraints must be a function of states, actions that led to them",
    ),
    (lambda at: at.task(state_bounds=torch.ones(2, 4)), "Expected state_bounds of shape 2 x 1"),
    (
        lambda at: at.task(state_bounds=[[1.0], [-1.0]]),
        "Expected state_bounds, each lower one below its upper one, got",
    ),
    (lambda at: at.task(episode_length=0), "episode_length must be at least 1; found 0"),
    (lambda at: at.task(dynamics="cka"), "dynamics must be an object of a Dynamics; found 'cka'"),
    (lambda at: at.task(reward=None), "reward must be a function of states, .*found None"),
    (lambda at: at.task(reward=1.0), "reward must be a function of .*; found 1.0"),
    (
        lambda at: at.task(reward=lambda states: 0),
        "a function of states, actions, next states; found <function",
    ),
    (lambda at: at.task(sensors=Sensors(["x"])), "known where episodes start"),
    (lambda at: at.task(sensors=["x"]), "sensors"),
    (lambda at: at.task(reference=wave), "exogenous states, but the spec has none"),
    (
        lambda at: tracking(at, initial_states=near_one, sensors=Sensors(["x"])),
        "takes set-points for constant; leave reference out",
    ),
    (
        lambda at: PhysicsDynamics(POINT_SPEC, at.step, physics_error={"y": 0.1}),
        r"physics_error names states among .'x'.; found 'y'",
    ),
    (
        lambda at: PhysicsDynamics(POINT_SPEC, at.step, physics_error={"x": -1}),
        "at least 0; found -1",
    ),
    (
        lambda at: at.tried(constraints=lambda states, actions: states < 1),
        r"numbers that are at most 0 where they hold.*booleans",
    ),
    (
        lambda at: at.tried(constraints=lambda states, actions: states[:, 0] - 1),
        r"shape 2 x c; found \(2,\)",
    ),
]
AGENTS = [
    (lambda at: at.searcher(search=3), r"PolicySearch\(...\); found 3"),
    (lambda at: at.searcher(policy="mlp"), "makes a BoundedPolicy .* found 'mlp'"),
    (lambda at: at.searcher(policy=lambda *_: 3), "BoundedPolicy .* found 3"),
    (lambda at: at.planner(first=3), r"first must be a Planner\(...\); found 3"),
    (lambda at: at.planner(reward_tolerance="no"), "reward_tolerance must be a number"),
    (lambda at: at.planner(score_horizons=(0,)), "horizon"),
    (lambda at: at.planner(learning_rate=1.0), "learning_rate"),
    (lambda at: at.planner(random_steps=-1), "random_steps must be"),
    (lambda at: MPCAgent(at.env(), at.task()).learn("x"), "total_timesteps must be a whole number"),
    (lambda at: MPCAgent(None, at.task()), "env must be an environment of Gymnasium"),
    (lambda at: MPCAgent("CartPole-v1", at.task()), "env must be an environment of Gymnasium"),
    (lambda at: MPCAgent(at.env(), None), r"task must be a Task.* needs to learn; found"),
    (
        lambda at: MPCAgent(env_of(at, observation_space=BOX(-1, 1, (2,))), at.task()),
        "the observation has 1 entries",
    ),
    (
        lambda at: MPCAgent(env_of(at, action_space=gymnasium.spaces.Discrete(2)), at.task()),
        "the action has 1 entries",
    ),
    (
        lambda at: MPCAgent(env_of(at, action_space=BOX(-np.inf, np.inf, (1,))), at.task()),
        r"Actions must have bounds, .*; found Box",
    ),
]


@pytest.mark.parametrize(("call", "words"), [*VALUES, *TASKS, *AGENTS])
def test_it_is_refused(call, words, make_agent, point_env, point_task):
    def tried(**parts):
        point_task(**parts).try_functions(torch.zeros(2, 1), torch.zeros(2, 1))

    at = SimpleNamespace(
        env=point_env,
        task=point_task,
        tried=tried,
        step=lambda X: X[:, :1] + 0.5 * X[:, 1:],
        policy=linear(POINT_SPEC, BOUNDS),
        planner=lambda **given: make_agent(MPCAgent, **given),
        searcher=lambda **given: make_agent(PolicySearchAgent, **given),
    )
    with pytest.raises((TypeError, ValueError), match=words):
        call(at)
