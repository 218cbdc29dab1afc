"""Dyna agents in files, and their parameters."""

import threading
import zipfile

import numpy as np
import pytest
import torch

from gpadjust.dynamics import PhysicsDynamics
from gpadjust.rl import DynaSAC
from tests.point import POINT_SPEC, robot


def test_a_loaded_agent_predicts_the_same_and_its_dynamics_learn_all(
    point_agent, point_env, learnt_dynamics, point_task, tmp_path
):
    agent, path = point_agent(dynamics=learnt_dynamics()).learn(10), tmp_path / "agent.zip"
    agent.save(path)
    obs = np.linspace(-1, 1, 7, dtype=np.float32)[:, None]
    both = (each.predict(obs, deterministic=True)[0] for each in (agent, DynaSAC.load(path)))
    np.testing.assert_array_equal(*both)
    for given in ({"env": point_env()}, {}):
        with pytest.raises(ValueError, match=r"needs a task to learn.*DynaSAC.load"):
            DynaSAC.load(path, **given).learn(5)
    with pytest.raises(AssertionError, match="must set the environment"):  # of Stable-Baselines3
        DynaSAC.load(path, task=point_task()).learn(5)
    task = point_task(dynamics=learnt_dynamics(), reward=lambda s, a, n: s[:, 0])
    with pytest.raises(ValueError, match="is not the environment's"):
        DynaSAC.load(path, env=point_env(), task=task).learn(5)
    agent.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = DynaSAC.load(path, env=point_env(), task=point_task(dynamics=learnt_dynamics()))
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert loaded.num_episodes == 2
    loaded.learn(5, reset_num_timesteps=False)
    assert loaded.task.dynamics.num_transitions == loaded.num_timesteps == 15
    assert loaded.num_episodes == 3


def test_the_file_holds_neither_physics_nor_functions_nor_environment(
    point_agent, point_env, tmp_path
):
    class Unpicklable:
        """A function that no pickler can take."""

        def __init__(self, function):
            self.function, self.lock = function, threading.Lock()

        def __call__(self, *args):
            return self.function(*args)

    agent = point_agent(
        robot(point_env()),
        dynamics=PhysicsDynamics(POINT_SPEC, Unpicklable(lambda X: X[:, :1] + 0.5 * X[:, 1:])),
        reward=Unpicklable(lambda states, actions, next_states: -next_states[:, 0].square()),
        initial_states=Unpicklable(lambda n: torch.ones(n, 1)),
    )
    agent.learn(5, Unpicklable(lambda agent, event, values: None))
    agent.save(tmp_path / "agent.zip")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        data = archive.read("data").decode()
    for name in ("task", "dynamics", "env", "fit_callbacks"):
        assert f'"{name}":' not in data


def test_both_buffers_are_saved_together(point_agent, tmp_path):
    agent = point_agent().learn(10)
    agent.replay_buffer.model_buffer.device = torch.device("meta")  # as if saved on another machine
    agent.save_replay_buffer(tmp_path / "buffer.pkl")
    other = point_agent(seed=1)
    other.load_replay_buffer(tmp_path / "buffer.pkl")
    other.replay_buffer.sample(4)
    for one, again in [
        (agent.replay_buffer, other.replay_buffer),
        (agent.replay_buffer.model_buffer, other.replay_buffer.model_buffer),
    ]:
        np.testing.assert_array_equal(one.observations, again.observations)
        assert again.size() == one.size() > 0
        assert again.device == other.device
