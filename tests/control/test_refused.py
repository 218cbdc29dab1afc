"""Refusals: where an object is made, at a call, and before the first real step."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch

from gpadjust import ZeroMeanGP
from gpadjust.control import (
    MPC,
    ActionRate,
    EpisodeCheckpoint,
    MPCAgent,
    Objective,
    Planner,
    PolicySearch,
    PolicySearchAgent,
    Return,
)
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.rl import DynaSAC, ModelVecEnv
from gpadjust.states import Sensors
from tests.control.conftest import BOUNDS, ZERO, half_step, point_of
from tests.point import POINT_SPEC, linear, near_one

GOAL = StateSpec(["x", "goal"], ["force"], exogenous=["goal"])
X = Sensors(["x"])
BLIND = LearnedDynamics(POINT_SPEC, model=ZeroMeanGP)
BOX = gymnasium.spaces.Box


def wave(states, steps):
    return states[:, 1:]


def wall(states, actions):
    return states[:, :1] - 1


class Wrong(Objective):
    def make_score(self, task):
        return lambda rollout: rollout.rewards.sum(-1)  # k x n


def env_of(at, **spaces):
    """The environment of the point, with other spaces."""
    env = at.env()
    for name, space in spaces.items():
        setattr(env, name, space)
    return env


def tracking(at, **parts):
    parts = {"reference": wave, **parts}
    return at.task(dynamics=PhysicsDynamics(GOAL, lambda X: X[:, :1]), **parts)


def tried(at, **parts):
    at.task(**parts).try_functions(torch.zeros(2, 1), torch.zeros(2, 1))


def plan(planner=None, state=ZERO, bounds=BOUNDS, num_steps=3, task=None):
    (planner or Planner()).plan(task or point_of(), state, bounds, num_steps)


def improve(at, policy=None, **parts):
    PolicySearch().improve(policy or at.policy, at.task(**parts))


TASK = [
    (lambda at: at.task(action_rate=0.0), "most of an action rate must be .* above 0"),
    (lambda at: at.task(action_rate=[0.1, 0.2]), "one for each of 1 actions; found 2"),
    (lambda at: ActionRate(price=-1.0), r"price must be .* at least 0"),
    (lambda at: at.task(probability=95), "probability must be above 0 and below 1; found 95"),
    (lambda at: at.task(constraints=lambda s: s), "constraints must be .* actions that led to"),
    (lambda at: at.task(state_bounds=[[1.0], [-1.0]]), "state_bounds, each lower one below its up"),
    (lambda at: at.task(episode_length=0), "episode_length must be at least 1; found 0"),
    (lambda at: at.task(dynamics="cka"), "dynamics must be an object of a Dynamics; found 'cka'"),
    (lambda at: at.task(reward=None), "reward must be a function of states, .*found None"),
    (lambda at: at.task(reward=lambda s: 0), "states, actions, next states; found <function"),
    (lambda at: at.task(sensors=X), "known starts of episodes"),
    (lambda at: at.task(sensors=["x"]), "sensors"),
    (lambda at: at.task(reference=wave), "exogenous states, but the spec has none"),
    (lambda at: tracking(at, initial_states=near_one, sensors=X), "reference or sensors, not both"),
    (
        lambda at: PhysicsDynamics(POINT_SPEC, half_step, physics_error={"y": 0.1}),
        r"physics_error names states among .'x'.; found 'y'",
    ),
    (
        lambda at: PhysicsDynamics(POINT_SPEC, half_step, physics_error={"x": -1}),
        "at least 0; found -1",
    ),
    (lambda at: tried(at, constraints=lambda s, a: s < 1), "at most 0 where they hold.*booleans"),
    (lambda at: tried(at, constraints=lambda s, a: s[:, 0]), r"shape 2 x c; found \(2,\)"),
]
PLANS = [
    (lambda at: Planner("return"), r"such as Return\(\); found 'return'"),
    (lambda at: Planner(num_random=0), "num_random must be at least 1; found 0"),
    (lambda at: Planner(num_functions=0), "num_functions must be at least 1; found 0"),
    (lambda at: Planner(horizon=0), "horizon must be finite and above 0; found 0"),
    (lambda at: Planner(rounds=1.5), "rounds must be a whole number; found 1.5"),
    (lambda at: Planner(spread=0.0), "spread must be above 0 and below 1; found 0.0"),
    (lambda at: Planner(max_hold=True), "max_hold must be a whole number; found True"),
    (lambda at: Planner(Return(quantile=0.1), num_functions=1), "but num_functions is 1; give"),
    (lambda at: Return(quantile=1.0), "quantile must be at least 0 and below 1"),
    (lambda at: Planner(correlation=1.0), "correlation must be .* below 1"),
    (lambda at: plan(state=torch.zeros(2)), r"state of shape 1, found \(2,\)"),
    (lambda at: plan(bounds=BOUNDS * torch.inf), r"finite action_bounds, .*inf"),
    (lambda at: plan(num_steps=None), "a number of steps >= 1 to plan, found None"),
    (lambda at: plan(Planner(Wrong())), r"Wrong must return one score per seq.* shape \(1, 128\)"),
    (
        lambda at: plan(Planner(horizon=0.05), task=point_of(spec=replace(POINT_SPEC, step=0.1))),
        r"horizon must be one step at least, .* 0\.1 in the time",
    ),
    (lambda at: plan(task=at.task(dynamics=BLIND)), "has not learnt"),
    (
        lambda at: MPC(at.task(episode_length=None), BOUNDS, first=Planner()),
        "give the task an episode_length, or the planner a horizon",
    ),
]
POLICIES = [
    (lambda at: PolicySearch(updates=0), "updates must be at least 1; found 0"),
    (lambda at: PolicySearch(Return(quantile=0.2)), "num_functions is None; give num_functions of"),
    (lambda at: improve(at, lambda states: states), "policy must be a module with parameters"),
    (lambda at: improve(at, episode_length=None), "task with episode_length"),
    (lambda at: improve(at, action_rate=0.1), "PolicySearch cannot learn a task with action_rate"),
    (
        lambda at: improve(at, reward=lambda s, a, n: n[:, 0].detach(), initial_states=near_one),
        "Write the reward in torch",
    ),
    (lambda at: EpisodeCheckpoint("run.ckpt")({}, {}), "for learners with a model"),
]
AGENTS = [
    (lambda at: at.searcher(search=3), r"PolicySearch\(...\); found 3"),
    (lambda at: at.searcher(policy="mlp"), "makes a BoundedPolicy .* found 'mlp'"),
    (lambda at: at.planner(first=3), r"first must be a Planner\(...\); found 3"),
    (lambda at: at.planner(reward_tolerance="no"), "reward_tolerance must be a number"),
    (lambda at: at.planner(score_horizons=(0,)), "horizon"),
    (lambda at: at.planner(learning_rate=1.0), "learning_rate"),
    (lambda at: MPCAgent(at.env(), at.task()).learn("x"), "total_timesteps must be a whole number"),
    (lambda at: MPCAgent(None, at.task()), "env must be an environment of Gymnasium"),
    (lambda at: MPCAgent(at.env(), None), r"task must be a Task.* needs to learn; found"),
    (
        lambda at: MPCAgent(env_of(at, observation_space=BOX(-1, 1, (2,))), at.task()),
        "the observation has 1 entries",
    ),
    (
        lambda at: MPCAgent(env_of(at, observation_space=BOX(-1, 1, (2,))), at.hidden),
        "spec of the sensors the observation has 1 entries",
    ),
    (
        lambda at: MPCAgent(env_of(at, action_space=gymnasium.spaces.Discrete(2)), at.task()),
        "the action has 1 entries",
    ),
    (
        lambda at: MPCAgent(env_of(at, action_space=BOX(-np.inf, np.inf, (1,))), at.task()),
        r"Actions must have finite bounds, .*; found Box",
    ),
    (
        lambda at: MPCAgent(at.env(), tracking(at)),
        "spec of the dynamics the observation has 2 entries",
    ),
    (lambda at: DynaSAC("MlpPolicy", at.env(), at.task(constraints=wall)), "DynaSAC .* MPCAgent"),
    (lambda at: DynaSAC("MlpPolicy", at.env(), at.task(action_rate=0.5)), "DynaSAC .* MPCAgent"),
    (lambda at: DynaSAC("MlpPolicy", at.env(), at.hidden), "DynaSAC .* sensors; MPCAgent can"),
    (
        lambda at: ModelVecEnv(at.hidden, 1, at.env().observation_space, at.env().action_space),
        "ModelVecEnv cannot learn a task with sensors",
    ),
]
LATER = [  # at `learn`, before the first real step
    (lambda at: at.searcher(constraints=wall), "PolicySearch .* constraints; MPCAgent can"),
    (lambda at: at.planner(dynamics=BLIND, sensors=X), "give the dynamics a physics"),
    (
        lambda at: at.planner(at.env().unwrapped, episode_length=None),
        "no time limit; give the task an episode_length",
    ),
]
REFUSED = [*TASK, *PLANS, *POLICIES, *AGENTS]


@pytest.fixture
def at(make_agent, point_env, point_task):
    return SimpleNamespace(
        env=point_env,
        task=point_task,
        hidden=point_task(initial_states=near_one, sensors=X),
        policy=linear(POINT_SPEC, BOUNDS),
        planner=partial(make_agent, MPCAgent),
        searcher=partial(make_agent, PolicySearchAgent),
    )


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_it_is_refused(call, words, at):
    with pytest.raises((TypeError, ValueError, RuntimeError), match=words):
        call(at)


@pytest.mark.parametrize(("make", "words"), LATER)
def test_it_is_refused_before_a_real_step(make, words, at):
    agent = make(at)
    with pytest.raises(ValueError, match=words):
        agent.learn(5)
    assert agent.num_timesteps == 0
