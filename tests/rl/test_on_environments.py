"""Agents on the environments of the library."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from gpadjust.control import Task
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.rl import DynaOptions, DynaSAC
from gpadjust.systems import CartPoleSwingUpEnv, RememberAction, cart_pole
from gpadjust.systems.swing_up import cart_pole_reward, cart_pole_spec, cart_pole_start

SMALL = {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 0, "device": "cpu"}


@pytest.mark.slow
def test_actions_taken_in_the_model_are_remembered():
    raw = cart_pole_spec(encode_angle=False)
    spec = StateSpec([*raw.states, "last"], raw.actions, previous={"last": raw.actions[0]})
    env = gym.wrappers.TimeLimit(RememberAction(CartPoleSwingUpEnv(encode_angle=False)), 5)

    def reward(states, actions, next_states):
        return cart_pole_reward(states[..., :4], actions, next_states[..., :4])

    def starts(n):
        return torch.cat([cart_pole_start(n), torch.zeros(n, 1, dtype=torch.float64)], -1)

    dynamics = LearnedDynamics(spec, cart_pole(0).physics)
    task = Task(dynamics, reward, initial_states=starts)
    agent = DynaSAC("MlpPolicy", env, task, DynaOptions(model_episodes=2), **SMALL).learn(10)
    model = agent.replay_buffer.model_buffer
    moved = slice(0, model.size())
    followed = (model.dones * (1 - model.timeouts))[moved, 0] == 0  # within the bounds
    assert followed.sum() > 10
    low, high = env.action_space.low, env.action_space.high
    actions = low + (model.actions[moved, 0] + 1) / 2 * (high - low)
    last = model.next_observations[moved, 0, -1:]
    np.testing.assert_allclose(last[followed], actions[followed], atol=1e-4)
