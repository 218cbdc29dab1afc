"""Observations that hold the previous action."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from gpadjust.dynamics import CKADynamics, StateSpec
from gpadjust.envs import (
    CART_POLE_RAW_SPEC,
    CartPoleSwingUpEnv,
    RememberAction,
    cart_pole_reward,
    cart_pole_start,
    random_cart_pole_physics,
)
from gpadjust.rl import DynaSAC


def test_the_observation_ends_with_the_last_action():
    env = RememberAction(CartPoleSwingUpEnv(encode_angle=False))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (5,)
    assert observation[-1] == 0
    for force in (2.0, -1.0):
        observation, *_ = env.step(np.array([force], dtype=np.float32))
        assert observation[-1] == force
    assert pickle.loads(pickle.dumps(env)).observation_space == env.observation_space
    assert env.reset(seed=0)[0][-1] == 0


@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")  # of other things than faults
def test_gymnasium_finds_no_fault():
    check_env(RememberAction(CartPoleSwingUpEnv()), skip_render_check=True)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Discrete(2), "an action space that is a Box of one dimension; found Discrete"),
        (gym.spaces.Box(1, 2, (1,)), "the action zero, which is not in Box"),
    ],
)
def test_other_actions_are_refused(space, message):
    env = CartPoleSwingUpEnv()
    env.action_space = space
    with pytest.raises(ValueError, match=message):
        RememberAction(env)


def test_dyna_sac_learns_with_it():
    raw = CART_POLE_RAW_SPEC
    spec = StateSpec([*raw.states, "last"], raw.actions, previous={"last": raw.actions[0]})
    env = gym.wrappers.TimeLimit(RememberAction(CartPoleSwingUpEnv(encode_angle=False)), 5)

    def reward(states, actions, next_states):
        return cart_pole_reward(states[..., :4], actions, next_states[..., :4])

    def starts(n):
        return torch.cat([cart_pole_start(n), torch.zeros(n, 1, dtype=torch.float64)], -1)

    agent = DynaSAC(
        "MlpPolicy",
        env,
        dynamics=CKADynamics(spec, random_cart_pole_physics(0)),
        reward=reward,
        initial_states=starts,
        model_trials=2,
        batch_size=8,
        seed=0,
    )
    agent.learn(10)
    model = agent.replay_buffer.model
    assert model.size() == 2 * 2 * 5
    low, high = env.action_space.low, env.action_space.high
    actions = low + (model.actions[: model.size(), 0] + 1) / 2 * (high - low)
    np.testing.assert_allclose(model.next_observations[: model.size(), 0, -1:], actions, atol=1e-4)
