"""Dyna agents that learn small systems in moments."""

from dataclasses import fields

import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import Task
from gpadjust.rl import DynaOptions, DynaSAC, ModelVecEnv
from tests.point import *  # noqa: F403
from tests.point import assert_equal

COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def taken(given, kind):
    """Those of the given options that are fields of a class; they are removed."""
    return {e.name: given.pop(e.name) for e in fields(kind) if e.name in given}


@pytest.fixture
def point_agent(point_env, point_task):
    """Makes an agent for the point; parts of the task, options and arguments can be given.

    It scores no trajectories, and makes an update for five steps in the model, unless it is told.
    """

    def make(env=None, algorithm=DynaSAC, **given):
        task = given.pop("task", None) or point_task(**taken(given, Task))
        few = {"model_episodes": 2, "updates_per_model_step": 0.2, "score_horizons": ()}
        options = DynaOptions(**{**few, **taken(given, DynaOptions)})
        defaults = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}, "batch_size": 8}
        defaults |= {"buffer_size": 500, "device": "cpu", "seed": 0}
        env = point_env() if env is None else env
        return algorithm(env=env, task=task, options=options, **{**defaults, **given})

    return make


@pytest.fixture
def tensors_of():
    """All that an agent has learnt: parameters, optimisers, both buffers, dynamics."""

    def tensors(agent):
        buffers = (agent.replay_buffer, agent.replay_buffer.model_buffer)
        normalizer = agent.get_vec_normalize_env()
        return {
            "parameters": agent.get_parameters(),
            "dynamics": agent.task.dynamics.state_dict(),
            "log_ent_coef": getattr(agent, "log_ent_coef", None),
            "buffers": [[getattr(each, name) for name in COLUMNS] for each in buffers],
            "episodes": [vars(agent.replay_buffer.episodes), agent.replay_buffer.num_learnt],
            "counts": [agent.num_timesteps, agent.num_episodes, agent._n_updates],
            "normalised": normalizer and [vars(normalizer.obs_rms), vars(normalizer.ret_rms)],
        }

    return tensors


@pytest.fixture
def assert_same(tensors_of):
    """Asserts that two agents have learnt the same, bit by bit."""
    return lambda one, other: assert_equal(tensors_of(one), tensors_of(other))


@pytest.fixture
def normalised(point_env):
    """Makes normalised environments of the point."""
    return lambda n=1: VecNormalize(DummyVecEnv([point_env] * n))


@pytest.fixture
def point_particles(point_env, point_task):
    """Makes particles that are points, from x = 1; every argument can be given."""

    def make(num_envs=3, start=1.0, **given):
        env = point_env()
        starts = {"initial_states": lambda n: torch.full((n, 1), start)}
        task = point_task(**{**starts, **taken(given, Task)})
        names = ("observation_space", "action_space")
        spaces = (given.pop(name, getattr(env, name)) for name in names)
        return ModelVecEnv(task, num_envs, *spaces, **given)

    return make


def model_rows(agent):
    """The number of transitions of the model."""
    return agent.replay_buffer.model_buffer.size()
