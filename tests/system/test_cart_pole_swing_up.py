"""The cart-pole as a Gymnasium environment."""

import copy
import math
import pickle
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from gpadjust.systems import CartPoleSwingUpEnv
from gpadjust.systems.swing_up import (
    CART_POLE_SPEC,
    REAL_CART_POLE,
    CartPoleEquation,
    cart_pole_cost,
    cart_pole_start,
    equation_physics,
)
from tests.systems import refused

ID = "gpadjust/CartPoleSwingUp-v0"
PUSH = np.array([6.0], dtype=np.float32)


def rollout(env, num_steps=10, seed=0):
    actions = np.random.default_rng(seed).uniform(-10, 10, (num_steps, 1)).astype(np.float32)
    return [env.step(action) for action in actions]


def same(transitions, others):
    pairs = zip(transitions, others, strict=True)
    return all(np.array_equal(a[0], b[0]) and a[1:] == b[1:] for a, b in pairs)


def upright(**arguments):
    env = CartPoleSwingUpEnv(**arguments)
    env.reset(options={"state": [0.0, 0.0, 0.0, 0.0]})
    return env


@pytest.mark.filterwarnings("ignore:.*Box observation space m[a-z]+ value is:UserWarning")
@pytest.mark.filterwarnings("ignore:.*For Box action spaces, we recommend:UserWarning")
@pytest.mark.parametrize("encode_angle", [True, False])
def test_gymnasium_finds_no_fault(encode_angle):
    check_env(gym.make(ID, encode_angle=encode_angle).unwrapped)


def test_trajectory_is_that_of_the_physics(states_and_forces):
    env = CartPoleSwingUpEnv()
    env.reset(seed=0)
    physics = equation_physics(REAL_CART_POLE)
    state = torch.from_numpy(env.state).unsqueeze(0)
    for force in states_and_forces(25)[1].float():
        observation, reward, _, _, info = env.step(force.numpy())
        state = physics(torch.cat([state, force.double().unsqueeze(0)], dim=-1))
        assert np.array_equal(env.state, state[0].numpy())
        assert reward == -info["cost"] == -cart_pole_cost(state).item()
        assert np.array_equal(observation, CART_POLE_SPEC.observe(state)[0].float().numpy())


def test_start_is_drawn_around_hanging():
    env = CartPoleSwingUpEnv()
    env.reset(seed=0)
    states = [env.reset() and env.state for _ in range(2000)]
    for drawn in (np.array(states), cart_pole_start(2000).numpy()):
        np.testing.assert_allclose(drawn.mean(0), [0, math.pi, 0, 0], atol=0.02)
        np.testing.assert_allclose(np.cov(drawn.T), 0.04 * np.eye(4), atol=0.006)


@pytest.mark.parametrize("duplicate", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy])
def test_copy_goes_on_as_the_original(duplicate):
    env = gym.make(ID, render_mode="rgb_array")
    first = env.reset(seed=0)[0]
    rollout(env, 3)
    env.render()
    twin = duplicate(env)
    assert np.array_equal(duplicate(env).reset(seed=0)[0], first)
    assert same(rollout(env, 5), rollout(twin, 5))
    assert np.array_equal(env.reset()[0], twin.reset()[0])
    assert np.array_equal(env.render(), twin.render())


def test_frame_shows_pole_goal_and_force():
    env = gym.wrappers.HumanRendering(upright(render_mode="rgb_array"))  # in a window
    still = env.env.render()
    assert still.shape == (300, 600, 3)
    assert still.dtype == np.uint8
    assert len(np.unique(still.reshape(-1, 3), axis=0)) > 10

    def red_level():
        frame = env.env.render().astype(int)
        return np.nonzero((frame[..., 0] > 180) & (frame[..., 1] < 100))[0].mean()

    above = red_level()
    env.step(PUSH)
    assert not np.array_equal(env.env.render(), still)
    env.reset(options={"state": [0.0, math.pi, 0.0, 0.0]})
    assert above < 150 < red_level()
    env.close()


def test_raw_observation_is_the_state_and_does_not_wrap():
    env = CartPoleSwingUpEnv(encode_angle=False)
    for start in ([0.1, 7.0, 0.0, 9.0], [-100.0, 1.0, 100.0, -100.0]):
        observation, _ = env.reset(options={"state": start})
        assert np.array_equal(observation, np.array(start, dtype=np.float32))
        observation = env.step(PUSH)[0]
        assert np.array_equal(observation, env.state.astype(np.float32))
        assert np.isfinite(observation).all()
    assert env.observation_space.shape == (4,)


def test_forces_are_clipped_and_the_equation_is_that_given():
    assert same([upright().step(np.array([10.0]))], [upright().step(np.array([1e6]))])
    env = CartPoleSwingUpEnv(equation=CartPoleEquation(0.5, 0.5, 1.0, 0.1))
    env.reset(options={"state": [0.0, math.pi, 0.0, 0.0]})
    assert np.isclose(env.step(np.zeros(1))[4]["cost"], 1 - math.exp(-2 * 2.0**2))


def starting(state):
    return lambda: upright().reset(options={"state": state})


REFUSED = [
    (ValueError, "four finite numbers", starting([0.0, 1.0])),
    (ValueError, "four finite numbers", starting("up")),
    (ValueError, "four finite numbers", starting([0, 0, 1e39, 0])),
    (ValueError, "'start'", lambda: upright().reset(options={"start": [0.0] * 4})),
    (TypeError, r"must be a dictionary.*found \['s'\]", lambda: upright().reset(options=["s"])),
    (ValueError, "'human'.*HumanRendering", CartPoleSwingUpEnv, "human"),
    (TypeError, "encode_angle must be True or .*'no'", lambda: upright(encode_angle="no")),
    (gym.error.ResetNeeded, "reset", lambda: CartPoleSwingUpEnv().step(PUSH)),
    (gym.error.ResetNeeded, "reset", lambda: CartPoleSwingUpEnv("rgb_array").render()),
]


def test_bad_actions_starts_and_options_are_refused(monkeypatch):
    for error, words, *call in REFUSED:
        refused(error, words, *call)
    env = upright(render_mode="rgb_array")
    for action in (np.array([np.nan]), np.array([np.inf]), np.zeros(2), np.float32(1.0), "left"):
        refused(ValueError, "one finite force", env.step, action)
        assert np.array_equal(env.state, np.zeros(4))
    monkeypatch.setitem(sys.modules, "pygame", None)
    refused(gym.error.DependencyNotInstalled, "pygame-ce", env.render)
