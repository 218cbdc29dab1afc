"""A system in one object: its environment, its task, its physics with and without unknowns."""

import pickle
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
import torch

from gpadjust import systems
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.states import Sensors
from gpadjust.systems import System
from gpadjust.systems.swing_up import REAL_CART_POLE, believed_cart_pole, equation_physics
from tests.point import assert_equal
from tests.systems import normal, refused, uniform

SPEC = StateSpec(["x", "v"], ["force"])


class Cart(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, mass=1.0):
        self.mass = mass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.zeros(2)
        return self.state.copy(), {}

    def step(self, action):
        x, v = self.state
        self.state = np.array([x + 0.1 * v, v + 0.1 * action[0] / self.mass])
        return self.state.copy(), -abs(self.state[0]), False, False, {}


def coast(X):
    x, v, force = X.split(1, -1)
    return torch.cat([x + 0.1 * v, v + 0.1 * force], -1)


def reward(states, actions, next_states):
    return -next_states[:, 0].abs()


def cart(**options):
    return System(Cart, SPEC, coast, reward, **options)


def test_the_environment_ends_where_the_system_says():
    env = cart(episode_length=3).make(mass=2.0)
    assert env.unwrapped.mass == 2.0
    env.reset(seed=0)
    assert [env.step(np.ones(1))[3] for _ in range(3)] == [False, False, True]
    assert isinstance(cart().make(), Cart)


def test_the_environments_own_time_limit_may_only_be_longer():
    def pendulum(length):  # gymnasium truncates it after 200 steps
        system = System(lambda: gym.make("Pendulum-v1"), SPEC, coast, reward, episode_length=length)
        return system.make()

    assert isinstance(pendulum(3), gym.wrappers.TimeLimit)
    for length in (None, 200):
        assert isinstance(pendulum(length).env, gym.wrappers.OrderEnforcing)  # as it was
    refused(ValueError, r"at most the environment's own time limit, 200 .* 300", pendulum, 300)


def test_the_task_has_what_the_system_knows():
    given = {
        "terminated": lambda states: states[:, 0] > 1,
        "constraints": lambda states, actions: states[:, :1] - 1,
        "state_bounds": torch.tensor([[-1.0, -1.0], [1.0, 1.0]], dtype=torch.float64),
        "episode_length": 9,
    }
    start = lambda n: torch.zeros(n, 2, dtype=torch.float64)  # noqa: E731
    system = cart(start=start, physics_error={"v": 0.1}, **given)
    dynamics = PhysicsDynamics(SPEC, coast)
    task = system.task(dynamics)
    assert (task.dynamics, task.reward, task.initial_states) == (dynamics, reward, start)
    assert_equal({name: getattr(task, name) for name in given}, given)
    first, second = system.task().dynamics, system.task().dynamics
    assert isinstance(first, LearnedDynamics)
    assert first.physics_error == {"v": 0.1}
    assert first is not second


REFUSED = [
    ({"env": Cart()}, "env must be a function, its class or `lambda: env`"),
    ({"spec": "x"}, "spec must be a StateSpec"),
    ({"reward": None}, "reward must be a function"),
    ({"physics": 3.0}, "callable"),
    ({"sensors": ["x"]}, r"sensors must be .*found .*'x'"),
    ({"physics_error": 0.1}, r"physics_error must be .*found 0.1"),
]


@pytest.mark.parametrize(("parts", "words"), REFUSED)
def test_what_is_no_part_of_a_system_is_refused(parts, words):
    refused(TypeError, words, replace, cart(), **parts)


def test_the_cart_pole_is_that_of_its_id():
    ours, known = systems.cart_pole().make(), gym.make("gpadjust/CartPoleSwingUp-v0")
    push, steps = np.array([3.0], dtype=np.float32), []
    for env in (ours, known):
        env.reset(seed=4)
        steps.append([env.step(push)[:4] for _ in range(25)])
    assert_equal(*steps)
    assert steps[0][-1][3]
    assert ours.unwrapped.equation == REAL_CART_POLE
    system = systems.cart_pole(3, encode_angle=False)
    assert system.make().observation_space.shape == (4,)
    assert (system.physics.rhs, system.physics.step) == (believed_cart_pole(3), 0.1)


def test_an_environment_shows_the_states_or_what_is_measured_of_them():
    class Blind(Cart):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

        def reset(self, **options):
            state, info = super().reset(**options)
            return state[:1], info

    only = {"start": lambda n: torch.zeros(n, 2).double(), "sensors": Sensors(["x"])}
    blind = System(Blind, SPEC, coast, reward, **only)
    assert isinstance(blind.make(), Blind)
    assert cart(**only).make().reset(seed=0)[0].shape == (1,)
    for parts in ({"noise": {"x": 0.1}}, {"sensors": Sensors(["x", "v", "sum"], lambda s: s)}):
        words = r"must observe the states .2 entries.*found Box"
        refused(ValueError, words, replace(blind, **parts).make)
    both = Sensors(["both"], lambda states: 3 + states.sum(-1, keepdim=True))
    assert replace(blind, env=Cart, sensors=both).make().reset(seed=0)[0].tolist() == [3.0]
    words = r"no output 'x'; the outputs are \('both',\)"
    refused(ValueError, words, replace(blind, env=Cart, sensors=both, noise={"x": 1.0}).make)


def test_no_system_hides_a_module():
    """`import gpadjust.systems.cart_pole as m` gave the function of that name."""
    for path in Path(systems.__file__).parent.glob("[!_]*.py"):
        found = getattr(systems, path.stem, None)
        assert found is None or isinstance(found, ModuleType), path.stem


def test_each_row_has_the_parameters_that_it_is_given():
    system = pickle.loads(pickle.dumps(systems.cart_pole(noise={"x": 0.1}, unknowns=True)))
    assert system.make().reset(seed=0)[0].shape == (5,)
    X, guesses = normal(20, 5), [u.guess for u in system.unknowns.values()]
    several = [[0.5, 0.5, 0.6, 0.1], [0.4, 0.7, 0.5, 0.3], [*guesses[:3], 0.0]]
    several = torch.tensor(several, dtype=torch.float64)
    for values, outputs in zip(several, system.physics(X, several), strict=True):
        equation = systems.CartPoleEquation(*values.tolist())
        torch.testing.assert_close(outputs, equation_physics(equation)(X), rtol=1e-12, atol=1e-12)
    known = systems.cart_pole()
    assert not known.unknowns
    torch.testing.assert_close(outputs, known.physics(X), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_its_parameters_are_found_by_least_squares():
    system = systems.cart_pole(unknowns=True)
    states, actions = normal(40, 4, seed=1), uniform(40, 1, high=10.0, seed=1)
    truth = {name: 1.2 * u.guess for name, u in system.unknowns.items()}
    values = torch.tensor([*truth.values()], dtype=torch.float64)
    following = system.physics(torch.cat([states, actions], -1), values)
    dynamics = PhysicsDynamics(system.spec, system.physics)
    dynamics.update(states, actions, following)
    found = dynamics.physics_parameters
    assert {n: found[n].median().item() for n in found} == pytest.approx(truth, rel=1e-4)


def test_noise_of_sensors_has_its_size_and_leaves_rewards_alone():
    noise = {"theta": 0.1, "x_dot": 0.5}
    seen, true = systems.cart_pole(noise=noise).make(), systems.cart_pole().make()
    spec, errors = systems.cart_pole().spec, []
    push = np.zeros(1, dtype=np.float32)
    for seed in range(12):
        for env in (seen, true):
            env.reset(seed=seed)
        for _ in range(25):
            (observed, paid, *_), (_, cost, *_) = seen.step(push), true.step(push)
            assert paid == cost
            assert observed.dtype == np.float32
            state = spec.decode(torch.from_numpy(observed).double())
            errors.append(spec.change(torch.from_numpy(true.unwrapped.state), state))
    sd = torch.stack(errors).std(0)
    torch.testing.assert_close(sd, torch.tensor([0, 0.1, 0.5, 0]).double(), rtol=0.1, atol=1e-5)
    refused(ValueError, "no state 'y'", cart(noise={"y": 0.1}).make)
