"""Runs that are interrupted, and go on as if they had not been."""

import numpy as np
import pytest
from filelock import FileLock
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from gpadjust.control import EpisodeCheckpoint, resume
from gpadjust.rl import DynaSAC, DynaTD3
from tests.point import PowerCut, forbid_unpickling, robot, scramble
from tests.systems import refused

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
        with FileLock(f"{path}.lock"), pytest.raises(RuntimeError, match="Another run writes"):
            second.learn(1, EpisodeCheckpoint(path))  # which does not spend the generators
        scramble()
        second.learn(total - start, [EpisodeCheckpoint(path)], reset_num_timesteps=False)
        assert_same(whole, second)
        assert_same(whole, resumed(path))
        return start

    return check


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layers", "sampling"), [(("monitored", "normalised"), "step"), ((), "trajectory")]
)
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(
    learnt_dynamics, layers, sampling, point_agent, point_task, wrapped, interrupted
):
    def agent():
        options = {"updates_per_model_step": 0.7, "sampling": sampling}
        return point_agent(wrapped(layers), dynamics=learnt_dynamics(), **options)

    def resumed(path):
        return resume(path, wrapped(layers), point_task(dynamics=learnt_dynamics()))

    assert interrupted(agent, resumed, 13) == 10


def test_steps_in_the_middle_of_episodes(point_agent, point_task, point_env, interrupted):
    """The first actions are of the action space, which has a generator of its own."""
    env = lambda: DummyVecEnv([point_env, point_env])  # noqa: E731

    def agent():
        return point_agent(env(), train_freq=(3, "step"), learning_starts=16)

    def resumed(path):
        return resume(path, env(), point_task())

    assert interrupted(agent, resumed, 16, TOTAL + 4) == 12


def test_td3_goes_on(point_agent, point_env, point_task, interrupted):
    def agent():
        noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.3))
        return point_agent(algorithm=DynaTD3, action_noise=noise, train_freq=(3, "step"))

    def resumed(path):
        return resume(path, point_env(), point_task(), DynaTD3)

    assert interrupted(agent, resumed, 14, TOTAL + 1) % 5  # within an episode


def test_an_environment_that_cannot_be_pickled_is_reset_but_its_wrappers_keep_their_statistics(
    point_agent, point_env, point_task, tmp_path
):
    def normalised():
        env = robot(point_env())
        return VecNormalize(DummyVecEnv([lambda: env]))

    path, agent = tmp_path / "run.ckpt", point_agent(normalised())
    agent.notes["costs"] = [1.0]
    with pytest.warns(UserWarning, match="environment cannot be pickled"):
        agent.learn(10, CallbackList([EpisodeCheckpoint(path)]))
    again = resume(path, normalised(), point_task())
    assert again.notes == {"costs": [1.0]}
    assert again.get_vec_normalize_env().obs_rms.count == agent.env.obs_rms.count
    assert again.learn(10, reset_num_timesteps=False).num_episodes == 4


def test_what_does_not_fit_is_refused_before_anything_is_unpickled(
    point_agent, point_env, point_task, wrapped, tmp_path, monkeypatch
):
    one, two = tmp_path / "one", tmp_path / "two"
    EpisodeCheckpoint(one).write(point_agent().learn(5))
    env = DummyVecEnv([point_env] * 2)
    EpisodeCheckpoint(two).write(point_agent(env, train_freq=1))
    forbid_unpickling(monkeypatch)
    for path, env, algorithm, message in [
        (one, wrapped(["normalised"]), DynaSAC, "environment is"),
        (one, point_env(), DynaTD3, "of another run: agent is .*:DynaSAC in .*:DynaTD3 here"),
        (two, point_env(), DynaSAC, "num_envs is 2 in the checkpoint, 1 here"),
    ]:
        refused(ValueError, message, resume, path, env, point_task(), algorithm)
