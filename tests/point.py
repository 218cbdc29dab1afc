"""A point on a line, what learns to move it in moments, and what interrupts that.

Its fixtures are imported by rooms.
"""

import operator
import random
import threading
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch

from gpadjust.control import BoundedPolicy, Task
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec

linear = partial(BoundedPolicy, net_arch=())
POINT_SPEC = StateSpec(["x"], ["v"])


class Point(gymnasium.Env):
    """A point on a line, moved by half the action and some noise; beyond `end` it is over."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))

    def __init__(self, end=None, max_action=2.0):
        self.end = end
        self.action_space = gymnasium.spaces.Box(-max_action, max_action, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(0.5, 1.5, 1).astype(np.float32)
        return self.x, {}

    def step(self, action):
        noise = 0.02 * self.np_random.normal(size=1)
        self.x = (self.x + 0.5 * action + noise).astype(np.float32)
        over = self.end is not None and bool(self.x[0] > self.end)
        return self.x, -(float(self.x[0]) ** 2), over, False, {}


@pytest.fixture
def point_env():
    """Makes the point's environment, of 5 steps: `point_env(end=None)`."""

    def make(episode_length=5, **options):
        return gymnasium.wrappers.TimeLimit(Point(**options), episode_length)

    return make


@pytest.fixture
def point_dynamics():
    """The point, as it is."""
    return PhysicsDynamics(POINT_SPEC, lambda X: X[:, :1] + 0.5 * X[:, 1:])


@pytest.fixture
def crude_dynamics():
    """Makes dynamics that learn the point from a physics, by a point fit."""
    return partial(LearnedDynamics, POINT_SPEC, fit_options={"method": "map"})


@pytest.fixture
def learnt_dynamics(crude_dynamics):
    """Makes dynamics that learn the point from a physics that errs."""
    return partial(crude_dynamics, lambda X: X[:, :1] + 0.4 * X[:, 1:])


@pytest.fixture
def point_reward():
    return lambda states, actions, next_states: -next_states[:, 0].square()


@pytest.fixture
def point_task(point_dynamics, point_reward):
    """Makes the point's task; every part can be given."""

    def make(**parts):
        known = {"dynamics": point_dynamics, "reward": point_reward, "episode_length": 5}
        return Task(**{**known, **parts})

    return make


def near_one(n):
    """Starts of the point."""
    return 0.5 + torch.rand(n, 1, dtype=torch.float64)


# Interrupted runs


class PowerCut(Exception):  # noqa: N818
    """Ends a run."""


def scramble():
    """Draws from all generators, as other code between two runs may."""
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    random.seed(99)


# The first step, steps in the middle, and the last of an episode
FAULTS = {1: "raises", 4: "nan", 9: "1e30", 12: "reward nan", 13: "reward 1e30", 18: "inf"}


class Faulty(gymnasium.Wrapper):
    """A machine of which some steps fail, by their numbers from 1, each in a way of `FAULTS`."""

    def __init__(self, env, faults):
        super().__init__(env)
        self.faults, self.steps = faults, 0

    def step(self, action):
        self.steps += 1
        fault = self.faults.get(self.steps, "")
        if fault == "raises":
            raise OSError("the robot fell")
        observation, reward, *others = self.env.step(action)
        if fault.startswith("reward"):
            reward = float(fault.split()[1])
        elif fault:
            observation = np.full_like(observation, float(fault))
        return observation, reward, *others


class Shouting(gymnasium.Wrapper):
    """Another wrapper."""


def robot(env):
    """An environment that cannot be pickled."""
    env.unwrapped.lock = threading.Lock()
    return env


def forbid_unpickling(monkeypatch):
    """Lets whatever unpickles fail."""
    for room in ("pickle", "cloudpickle"):
        for call in ("load", "loads"):
            monkeypatch.setattr(f"{room}.{call}", lambda *_, **__: pytest.fail("unpickled"))


def flat(name, value, found):
    """All numbers of nested values, by name."""
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if isinstance(value, dict):
        for key, part in value.items():
            flat(f"{name}/{key}", part, found)
    elif isinstance(value, torch.Tensor | np.ndarray):
        found[name] = torch.as_tensor(value)
    else:
        found[name] = value


def assert_equal(one, other):
    """Asserts that the numbers of two nested values are the same, bit by bit."""
    found, expected = {}, {}
    flat("", one, found)
    flat("", other, expected)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        is_same = torch.equal if torch.is_tensor(value) else operator.eq
        assert is_same(value, expected[name]), name
