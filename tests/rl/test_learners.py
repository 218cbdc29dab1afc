"""A family: SAC and TD3 with a model."""

import numpy as np
import pytest
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

from gpadjust.rl import Dyna, DynaSAC, DynaTD3
from tests.point import assert_equal
from tests.rl.conftest import COLUMNS, model_rows


@pytest.mark.parametrize(
    ("algorithm", "learner", "noise"),
    [(DynaSAC, SAC, None), (DynaTD3, TD3, NormalActionNoise(np.zeros(1), np.full(1, 0.3)))],
)
def test_one_that_never_uses_its_model_is_the_learner(
    point_agent, normalised, algorithm, learner, noise
):
    shared = {"learning_starts": 3, "train_freq": (1, "episode"), "gradient_steps": -1}
    shared |= {"batch_size": 8, "buffer_size": 500, "action_noise": noise, "seed": 0}
    shared |= {"policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
    ours = point_agent(normalised(), algorithm, last_model_episode=0, **shared).learn(25)
    theirs = learner("MlpPolicy", normalised(), **shared).learn(25)
    assert ours._n_updates == theirs._n_updates == 25
    assert_equal(ours.policy.state_dict(), theirs.policy.state_dict())
    buffers = ours.replay_buffer, theirs.replay_buffer
    assert_equal(*([getattr(each, name) for name in COLUMNS] for each in buffers))
    assert model_rows(ours) == 0


def test_another_learner_needs_no_code(point_agent, point_env, point_task, tmp_path):
    class Other(Dyna, DDPG):
        """As a user writes it."""

    agent = point_agent(algorithm=Other).learn(10)
    assert agent.num_episodes == 2
    assert model_rows(agent) > 0
    agent.save(tmp_path / "agent.zip")
    again = Other.load(tmp_path / "agent.zip", env=point_env(), task=point_task())
    assert_equal(again.policy.state_dict(), agent.policy.state_dict())


def test_particles_have_action_noise_of_their_own(point_agent):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.3))
    agent = point_agent(algorithm=DynaTD3, action_noise=noise, model_episodes=3)
    agent.learn(5)
    first = agent.replay_buffer.model_buffer.actions[:3, 0, 0]  # at the same start
    assert len(set(first.tolist())) == 3
    assert (np.abs(first) <= 1).all()
    silent = point_agent(algorithm=DynaTD3, model_episodes=3).learn(5)
    assert len(set(silent.replay_buffer.model_buffer.actions[:3, 0, 0].tolist())) == 1


def test_target_networks_are_updated_as_seldom_as_told(point_agent, monkeypatch):
    """Steps of 2 particles in the model owe 2 updates; 10 of them are made together."""
    chunks = []
    train = SAC.train
    monkeypatch.setattr(
        SAC, "train", lambda agent, n, batch: chunks.append(n) or train(agent, n, batch)
    )
    agent = point_agent(target_update_interval=10, updates_per_model_step=1).learn(10)
    assert chunks == [5, 10, 5, 10]
    assert agent.owed_updates == 0
