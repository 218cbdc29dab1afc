"""Small systems, and agents that learn them in moments."""

from dataclasses import fields

import gymnasium
import numpy as np
import pytest
import torch

from gpadjust.control import Task
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.rl import DynaOptions, DynaSAC
from gpadjust.systems.cart_pole import CART_POLE_SPEC, REAL_CART_POLE, equation_physics

POINT_SPEC = StateSpec(["x"], ["v"])
QUICK = {"num_starts": 1, "num_screened": 0}
FEW_SAMPLES = {**QUICK, "num_samples": 3, "num_draws": 16}


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
def crude_dynamics(point_dynamics):
    """Makes dynamics that learn the point from a physics, by a quick search."""
    quick = {"method": "map", **QUICK}
    return lambda physics: LearnedDynamics(point_dynamics.spec, physics, fit_options=quick)


@pytest.fixture
def learnt_dynamics(crude_dynamics):
    """Makes dynamics that learn the point from a physics that errs."""
    return lambda: crude_dynamics(lambda X: X[:, :1] + 0.4 * X[:, 1:])


@pytest.fixture
def sampled_dynamics(point_dynamics):
    """As `learnt_dynamics`, by full Bayes, with few samples."""
    return lambda: LearnedDynamics(
        point_dynamics.spec, lambda X: X[:, :1] + 0.4 * X[:, 1:], fit_options=FEW_SAMPLES
    )


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


@pytest.fixture
def point_agent(point_env, point_task):
    """Makes an agent for the point; parts of the task, options and arguments can be given.

    It scores no trajectories, and makes an update for five steps in the model, unless it is told.
    """

    def make(env=None, algorithm=DynaSAC, **given):
        def taken(kind, **defaults):
            names = {entry.name for entry in fields(kind)} & {*given}
            return {**defaults, **{name: given.pop(name) for name in names}}

        task = given.pop("task", None) or point_task(**taken(Task))
        few = {"model_episodes": 2, "updates_per_model_step": 0.2, "score_horizons": ()}
        options = DynaOptions(**taken(DynaOptions, **few))
        defaults = {
            "policy": "MlpPolicy",
            "batch_size": 8,
            "buffer_size": 500,
            "policy_kwargs": {"net_arch": [8]},
            "device": "cpu",
            "seed": 0,
        }
        env = point_env() if env is None else env
        return algorithm(env=env, task=task, options=options, **{**defaults, **given})

    return make


@pytest.fixture
def cart_pole():
    """Makes the cart-pole's environment."""
    return lambda **options: gymnasium.make("gpadjust/CartPoleSwingUp-v0", **options)


@pytest.fixture
def cart_pole_dynamics():
    """The real cart-pole."""
    return PhysicsDynamics(CART_POLE_SPEC, equation_physics(REAL_CART_POLE))


@pytest.fixture
def tensors_of():
    """All that an agent has learnt, by name: parameters, optimisers, both buffers, dynamics."""

    def flatten(name, value, found):
        if isinstance(value, dict):
            for key, part in value.items():
                flatten(f"{name}/{key}", part, found)
        elif isinstance(value, (list, tuple)):
            for key, part in enumerate(value):
                flatten(f"{name}/{key}", part, found)
        elif isinstance(value, (torch.Tensor, np.ndarray)):
            found[name] = torch.as_tensor(value).detach().clone()
        else:
            found[name] = value

    def tensors(agent):
        found = {}
        flatten("parameters", agent.get_parameters(), found)
        flatten("log_ent_coef", getattr(agent, "log_ent_coef", None), found)
        for name in ("observations", "next_observations", "actions", "rewards", "dones"):
            for buffer in (agent.replay_buffer, agent.replay_buffer.model_buffer):
                flatten(f"{name}{buffer is agent.replay_buffer}", getattr(buffer, name), found)
        flatten("counts", [agent.num_timesteps, agent.num_episodes, agent._n_updates], found)
        normalizer = agent.get_vec_normalize_env()
        if normalizer is not None:
            flatten("obs_rms", vars(normalizer.obs_rms), found)
            flatten("ret_rms", vars(normalizer.ret_rms), found)
        return found

    return tensors


@pytest.fixture
def assert_same(tensors_of):
    """Asserts that two agents, or what `tensors_of` them, are the same, bit by bit."""

    def check(one, other):
        one, other = (part if isinstance(part, dict) else tensors_of(part) for part in (one, other))
        assert one.keys() == other.keys()
        for name, value in one.items():
            if torch.is_tensor(value):
                assert torch.equal(value, other[name]), name
            else:
                assert value == other[name], name

    return check
