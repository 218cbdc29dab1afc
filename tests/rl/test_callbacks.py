"""Callbacks that know of the model."""

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EveryNTimesteps

from gpadjust.rl import DynaCallback


class Watch(DynaCallback):
    def __init__(self):
        super().__init__()
        self.fits, self.returns = [], []

    def on_model_fit(self, metrics):
        self.fits.append(metrics)

    def on_model_episodes(self, returns):
        self.returns.append(returns)


def test_hooks_of_the_model(point_agent, learnt_dynamics):
    watch = Watch()
    agent = point_agent(
        dynamics=learnt_dynamics(), model_episodes=3, num_particles=2, refresh_model_data=False
    )
    agent.learn(10, [watch])
    assert [*watch.fits[0]] == ["fit_seconds"]
    assert watch.fits[1].keys() >= {"fit_seconds", "nlpd", "coverage"}
    assert all(np.isfinite([*metrics.values()]).all() for metrics in watch.fits)
    assert [len(returns) for returns in watch.returns] == [2, 1, 2, 1]
    rewards = agent.replay_buffer.model_buffer.rewards[: 5 * 6, 0]
    assert np.concatenate(watch.returns).sum() == pytest.approx(rewards.sum(), rel=1e-5)
    agent.learn(5, reset_num_timesteps=False)
    assert len(watch.fits) == 2


def test_hooks_are_for_dyna_only(point_env):
    agent = SAC("MlpPolicy", point_env(), policy_kwargs={"net_arch": [8]})
    with pytest.raises(TypeError, match=r"Watch is for Dyna agents.*found SAC"):
        agent.learn(5, Watch())


def test_hooks_inside_another_callback(point_agent):
    watch = Watch()
    point_agent().learn(10, EveryNTimesteps(5, watch))
    assert len(watch.fits) == 2


def test_a_callback_that_overrides_nothing(point_agent):
    assert point_agent().learn(10, DynaCallback()).num_episodes == 2
