"""Runs that are interrupted, and go on as if they had not been."""

import numpy as np
import pytest
from filelock import FileLock
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from gpadjust import systems
from gpadjust.control import EpisodeCheckpoint, resume
from gpadjust.rl import DynaSAC, DynaTD3
from tests.point import PowerCut, Shouting, forbid_unpickling, robot, scramble

TOTAL = 20  # four episodes of the point


class CutAt(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise PowerCut
        return True


@pytest.fixture
def wrapped(point_env):
    """Makes the environment of the point in the layers that have these names."""

    def make(layers):
        env = point_env() if not layers else DummyVecEnv([point_env])
        for layer in layers:
            env = {"normalised": VecNormalize, "monitored": VecMonitor}[layer](env)
        return env

    return make


def go_on(agent, *callbacks):
    return agent.learn(TOTAL - agent.num_timesteps, [*callbacks], reset_num_timesteps=False)


@pytest.fixture
def interrupted(assert_same, tmp_path):
    """Asserts that a run that is cut at a step ends as one that is not; from where it goes on."""

    def check(agent, resumed, step, total=TOTAL):
        path, whole = tmp_path / "run.ckpt", agent().learn(total)
        with pytest.raises(PowerCut):
            agent().learn(total, [EpisodeCheckpoint(path), CutAt(step)])
        scramble()
        second = resumed(path)
        start = second.num_timesteps
        scramble()
        second.learn(total - start, [EpisodeCheckpoint(path)], reset_num_timesteps=False)
        assert_same(whole, second)
        assert_same(whole, resumed(path))
        return start

    return check


@pytest.mark.slow
@pytest.mark.parametrize("layers", [("normalised",), ("monitored", "normalised"), ()])
@pytest.mark.parametrize("learns", [False, True])
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(
    point_dynamics, sampled_dynamics, layers, learns, point_agent, point_task, wrapped, interrupted
):
    def parts():
        return {"dynamics": sampled_dynamics() if learns else point_dynamics}

    def agent():
        return point_agent(wrapped(layers), **parts(), updates_per_model_step=0.7)

    def resumed(path):
        return resume(path, wrapped(layers), point_task(**parts()))

    step = 13 if learns else 6
    assert interrupted(agent, resumed, step) == step // 5 * 5


def test_many_interruptions(point_agent, point_task, point_env, assert_same, tmp_path):
    path = tmp_path / "run.ckpt"
    whole = point_agent(learning_starts=7).learn(TOTAL)
    agent = point_agent(learning_starts=7)  # the action space draws the first actions
    for step in (4, 6, 8, 19):
        with pytest.raises(PowerCut):
            go_on(agent, EpisodeCheckpoint(path), CutAt(step))
        scramble()
        agent = resume(path, point_env(), point_task())
    assert_same(whole, go_on(agent))


def test_steps_in_the_middle_of_episodes(point_agent, point_task, point_env, interrupted):
    def agent():
        return point_agent(DummyVecEnv([point_env, point_env]), train_freq=(3, "step"))

    def resumed(path):
        return resume(path, DummyVecEnv([point_env, point_env]), point_task())

    assert interrupted(agent, resumed, 16, TOTAL + 4) == 12


def test_td3_goes_on(point_agent, point_env, point_task, interrupted):
    def agent():
        noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.3))
        return point_agent(algorithm=DynaTD3, action_noise=noise, train_freq=(3, "step"))

    def resumed(path):
        return resume(path, point_env(), point_task(), DynaTD3)

    assert interrupted(agent, resumed, 14, TOTAL + 1) % 5  # within an episode


@pytest.mark.slow
@pytest.mark.parametrize("sampling", ["step", "trajectory"])
def test_cart_pole_of_co_kriging(sampling, cart_pole, point_agent, interrupted):
    def parts():
        return VecNormalize(DummyVecEnv([cart_pole])), systems.cart_pole().task()

    def agent():
        env, task = parts()
        return point_agent(env, task=task, sampling=sampling, updates_per_model_step=1)

    assert interrupted(agent, lambda path: resume(path, *parts()), 88, 100) == 75


def test_a_refused_call_does_not_spend_the_generators(
    point_agent, point_env, point_task, assert_same, tmp_path
):
    path = tmp_path / "run.ckpt"
    whole = point_agent().learn(TOTAL)
    with pytest.raises(PowerCut):
        point_agent().learn(TOTAL, [EpisodeCheckpoint(path), CutAt(13)])
    agent = resume(path, point_env(), point_task())
    with FileLock(f"{path}.lock"), pytest.raises(RuntimeError, match="Another run writes"):
        go_on(agent, EpisodeCheckpoint(path))
    scramble()
    assert_same(whole, go_on(agent, EpisodeCheckpoint(path)))


def test_an_environment_that_cannot_be_pickled_is_reset_but_its_wrappers_keep_their_statistics(
    point_agent, point_env, point_task, tmp_path
):
    def normalised():
        env = robot(point_env())
        return VecNormalize(DummyVecEnv([lambda: env]))

    path = tmp_path / "run.ckpt"
    agent = point_agent(normalised())
    agent.notes["costs"] = [1.0]
    with pytest.warns(UserWarning, match="environment cannot be pickled"):
        agent.learn(10, CallbackList([EpisodeCheckpoint(path)]))
    again = resume(path, normalised(), point_task())
    assert again.notes == {"costs": [1.0]}
    assert again.get_vec_normalize_env().obs_rms.count == agent.env.obs_rms.count
    go_on(again)
    assert again.num_episodes == 4
    assert again.replay_buffer.size() == TOTAL


def test_what_does_not_fit_is_refused_before_anything_is_unpickled(
    point_agent, point_env, point_task, wrapped, tmp_path, monkeypatch
):
    path, two = tmp_path / "run.ckpt", DummyVecEnv([point_env] * 2)
    EpisodeCheckpoint(path).write(point_agent().learn(5))
    EpisodeCheckpoint(tmp_path / "two").write(point_agent(two, train_freq=1))
    forbid_unpickling(monkeypatch)
    for file, env, algorithm, message in [
        (path, Shouting(point_env()), DynaSAC, "DummyVecEnv of StepGuard of Monitor of Shout"),
        (path, wrapped(["normalised"]), DynaSAC, "environment is"),
        (path, point_env(), DynaTD3, "of another run: agent is .*:DynaSAC in .*:DynaTD3 here"),
        (tmp_path / "two", point_env(), DynaSAC, "num_envs is 2 in the checkpoint, 1 here"),
    ]:
        with pytest.raises(ValueError, match=message):
            resume(file, env, point_task(), algorithm)
