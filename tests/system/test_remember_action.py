"""Observations that hold the previous action."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gpadjust.systems import CartPoleSwingUpEnv, RememberAction
from tests.systems import refused


def test_the_observation_ends_with_the_last_actions_the_newest_first():
    env = RememberAction(CartPoleSwingUpEnv(encode_angle=False), steps=3)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (7,)
    for force in (1.0, 2.0, 3.0, 4.0):
        observation, *_ = env.step(np.array([force], dtype=np.float32))
    assert observation[-3:].tolist() == [4.0, 3.0, 2.0]
    assert env.reset(seed=0)[0][-3:].tolist() == [0.0, 0.0, 0.0]


def test_the_action_is_remembered_as_the_environment_takes_it():
    env, plain = RememberAction(CartPoleSwingUpEnv()), CartPoleSwingUpEnv()
    env.reset(seed=0)
    plain.reset(seed=0)
    for force, taken in ((25.0, 10.0), (-11.0, -10.0)):
        observation = env.step(np.array([force], dtype=np.float32))[0]
        assert observation[-1] == taken
        assert env.observation_space.contains(observation)
        expected = plain.step(np.array([taken], dtype=np.float32))[0]
        assert np.array_equal(observation[:-1], expected)


@pytest.mark.parametrize(("dtype", "expected"), [(np.float16, np.float32), (int, np.float64)])
def test_observations_have_the_dtype_that_takes_both(dtype, expected):
    space = gym.spaces.Box(-1000, 1000, (5,), dtype=dtype)
    env = RememberAction(
        gym.wrappers.TransformObservation(
            CartPoleSwingUpEnv(), lambda seen: (100 * seen).astype(dtype), space
        )
    )
    assert env.observation_space.dtype == expected
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.array([0.25], dtype=np.float32))
    assert first.dtype == second.dtype == expected
    assert second[-1] == 0.25
    assert env.observation_space.contains(second)


def test_a_registered_environment_can_be_made_again():
    env = RememberAction(gym.make("gpadjust/CartPoleSwingUp-v0", encode_angle=False))
    first, force = env.reset(seed=3)[0], np.array([2.0], dtype=np.float32)
    twins = gym.make(env.spec), pickle.loads(pickle.dumps(copy.deepcopy(env)))
    second = env.step(force)[0]
    for twin in twins:
        assert isinstance(twin, RememberAction)
        assert twin.spec == env.spec
        assert np.array_equal(twin.reset(seed=3)[0], first)
        assert np.array_equal(twin.step(force)[0], second)


@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")  # of other things than faults
def test_gymnasium_finds_no_fault():
    check_env(RememberAction(CartPoleSwingUpEnv()), skip_render_check=True)


def test_other_actions_are_refused():
    for space, message in (
        (gym.spaces.Discrete(2), "an action space that is a Box of one dimension; found Discrete"),
        (gym.spaces.Box(1, 2, (1,)), "the action zero, which is not in Box"),
    ):
        env = CartPoleSwingUpEnv()
        env.action_space = space
        refused(ValueError, message, RememberAction, env)
    refused(ValueError, "steps must be", RememberAction, CartPoleSwingUpEnv(), steps=0)
