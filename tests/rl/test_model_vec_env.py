"""The model as a vectorised environment."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.rl import MixedReplayBuffer, ModelVecEnv
from gpadjust.systems import cart_pole
from gpadjust.systems.swing_up import REAL_CART_POLE, cart_pole_start, equation_physics
from tests.control.conftest import fails_beyond
from tests.point import POINT_SPEC
from tests.systems import uniform

WEIGHT = torch.ones(1, requires_grad=True)


def test_perfect_physics_are_the_real_environment():
    system, starts = cart_pole(), cart_pole_start(3)
    env, dynamics = system.make(), PhysicsDynamics(system.spec, equation_physics(REAL_CART_POLE))
    task = replace(system, start=lambda n: starts[:n]).task(dynamics)
    particles = ModelVecEnv(task, 3, env.observation_space, env.action_space)
    actions = np.random.default_rng(0).uniform(-10, 10, (25, 3, 1)).astype(np.float32)
    seen = [particles.reset()]
    steps = [particles.step(action) for action in actions]
    seen += [step[0] for step in steps]
    for i, start in enumerate(starts):
        obs, _ = env.reset(options={"state": start})
        np.testing.assert_allclose(seen[0][i], obs, rtol=1e-6)
        for t, (_, rewards, dones, infos) in enumerate(steps):
            obs, reward, terminated, truncated, _ = env.step(actions[t, i])
            found = infos[i]["terminal_observation"] if dones[i] else seen[t + 1][i]
            np.testing.assert_allclose(found, obs, rtol=1e-5, atol=1e-6)
            assert rewards[i] == pytest.approx(reward, rel=1e-5, abs=1e-7)
            assert bool(dones[i]) == (terminated or truncated)
            assert infos[i].get("TimeLimit.truncated", False) == truncated
        np.testing.assert_array_equal(seen[-1][i], seen[0][i])


LEARNERS = {
    "SAC": partial(SAC, learning_starts=64, train_freq=8, gradient_steps=8, learning_rate=3e-3),
    "PPO": partial(PPO, n_steps=64, batch_size=64, learning_rate=3e-3),
}


@pytest.mark.slow
@pytest.mark.parametrize(("learner", "survival"), [("SAC", False), ("PPO", True)])
def test_leaving_the_bounds_is_not_learnt(point_particles, learner, survival):
    """Neither where it would end costs, nor where it would end the danger of an early end."""
    parts = {"reward": lambda s, a, n: -1 - n[:, 0].square()}
    if survival:
        parts = {
            "reward": lambda s, a, n: 1 + 0 * n[:, 0],
            "terminated": lambda states: states[:, 0] < -0.5,
        }
    env = point_particles(
        num_envs=8,
        initial_states=lambda n: 1 + torch.rand(n, 1),
        episode_length=10,
        state_bounds=torch.tensor([[-2.5], [2.5]]),
        **parts,
    )
    seen = env if survival else VecNormalize(env, norm_obs=False)
    agent = LEARNERS[learner]("MlpPolicy", seen, policy_kwargs={"net_arch": [32]}, seed=0)
    agent.learn(8_000)
    assert env.num_left_bounds > 0
    env.num_left_bounds = 0
    obs, total = env.reset(), 0.0
    for _ in range(10):
        obs, rewards, _, _ = env.step(agent.predict(obs, deterministic=True)[0])
        total += rewards.mean()
    assert env.num_left_bounds == 0
    # To stay at zero is worth -10, to stay where it starts -33; to survive 10.
    assert total > (9 if survival else -14)


def moved(particles, *actions):
    """Reset particles, and step them by an action each."""
    particles.reset()
    return particles.step(np.array(actions, dtype=np.float32)[:, None])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_call_of_the_model_moves_all_particles(point_particles, point_dynamics, dtype):
    calls, step = [], point_dynamics.sample
    point_dynamics.sample = lambda *args: calls.append(len(args[0])) or step(*args)
    particles = point_particles(observation_space=spaces.Box(-np.inf, np.inf, (1,), dtype))
    assert particles.reset().dtype == dtype
    obs, rewards, dones, _ = moved(particles, 1, 1, 1)
    assert calls == [3]
    assert (obs.dtype, rewards.dtype, dones.dtype) == (dtype, np.float32, bool)


# Sampling


@pytest.fixture
def unsure_dynamics():
    """Of the point, learnt from few transitions."""
    dynamics = LearnedDynamics(POINT_SPEC, lambda X: X[:, :1] + 0.5 * X[:, 1:])
    states, actions = uniform(4, 1), uniform(4, 1, seed=1)
    dynamics.update(states, actions, states + 0.4 * actions + 0.3 * (3 * states).sin())
    return dynamics


@pytest.mark.parametrize("sampling", ["step", "trajectory"])
def test_particles_follow_functions_or_draws(point_particles, unsure_dynamics, sampling):
    given = {"dynamics": unsure_dynamics, "sampling": sampling, "episode_length": 1}
    particles = point_particles(num_envs=2, **given)
    first = moved(particles, 2, 2)[1]
    second = particles.step(np.full((2, 1), 2, dtype=np.float32))[1]
    np.testing.assert_equal(np.isclose(first, second, rtol=1e-6), sampling == "trajectory")
    assert first[0] != first[1]
    assert (moved(particles, 2, 2)[1] != first).all()
    rewards = []
    for again in (point_particles(num_envs=2, **given) for _ in range(2)):
        again.seed(7)
        rewards.append(moved(again, 2, 2)[1])
    np.testing.assert_array_equal(*rewards)


# Ends of episodes


def test_termination_ends_an_episode(point_particles):
    particles = point_particles(num_envs=2, terminated=lambda states: states[:, 0] > 1.7)
    assert not moved(particles, 1, 1)[2].any()
    obs, rewards, dones, infos = particles.step(np.array([[1.0], [0.0]], dtype=np.float32))
    assert dones.tolist() == [True, False]
    assert not infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"].tolist() == [2.0]
    assert obs[:, 0].tolist() == [1.0, 1.5]
    assert rewards.tolist() == [-4.0, -2.25]
    particles = point_particles(episode_length=1, terminated=lambda states: states[:, 0] > 0)
    *_, dones, infos = moved(particles, 1, 1, 1)  # at the time limit, too
    assert dones.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)
    # Each particle has its own clock.
    end = {"terminated": lambda states: states[:, 0] > 1.9}
    particles = point_particles(num_envs=2, episode_length=3, **end)
    moved(particles, 2, 0)  # ends the first
    ended = [particles.step(np.zeros((2, 1)))[2].tolist() for _ in range(3)]
    assert ended == [[False, False], [False, True], [True, False]]


def test_particles_that_leave_the_bounds_end_and_are_counted(point_particles):
    bounds = torch.tensor([[-5.0], [1.3]])
    particles = point_particles(num_envs=2, state_bounds=bounds)
    obs, rewards, dones, infos = moved(particles, 1, 0.1)
    assert dones.tolist() == [True, False]
    assert infos[0]["left_bounds"]
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"].tolist() == [1.0]
    assert rewards.tolist() == pytest.approx([-(1.05**2)] * 2)
    assert obs[:, 0].tolist() == pytest.approx([1.0, 1.05])
    assert particles.num_left_bounds == 1
    # Where all rewards are positive, leaving terminates.
    particles = point_particles(reward=lambda s, a, n: 2 + n[:, 0], state_bounds=bounds)
    _, rewards, dones, infos = moved(particles, 1, 0.1, -2)
    assert dones.tolist() == [True, False, False]
    assert not infos[0]["TimeLimit.truncated"]
    assert rewards[0] == rewards[2] == 2.0
    # Bounds give way to the starts.
    particles = point_particles(start=4.0, state_bounds=torch.tensor([[0.0], [2.0]]))
    assert not moved(particles, 1, 1, 1)[2].any()
    assert particles.task.state_bounds.tolist() == [[0.0], [5.0]]


def test_particles_that_leave_the_numbers_end(point_particles, point_dynamics):
    def broken(states, actions):
        following = states + actions
        following[1] = torch.inf
        following[2] = torch.nan
        return following

    point_dynamics.sample = broken
    particles = point_particles(terminated=lambda states: states[:, 0] > 10)
    obs, rewards, dones, infos = moved(particles, 1, 1, 1)
    assert dones.tolist() == [False, True, True]
    assert particles.num_left_bounds == 2
    for values in (obs, rewards, infos[1]["terminal_observation"]):
        assert np.isfinite(values).all()


CHOOSY = PhysicsDynamics(POINT_SPEC, fails_beyond(1.2))


@pytest.mark.parametrize("sampling", ["step", "trajectory"])
def test_particles_at_which_the_physics_fails_end(point_particles, sampling):
    """Rows are filled up to blocks of one size, which the physics may blame."""
    env = point_particles(dynamics=CHOOSY, sampling=sampling)
    moved(env, 0, 1, -1)
    obs, _, dones, infos = env.step(np.zeros((3, 1)))
    assert dones.tolist() == [False, True, False]
    assert infos[1]["left_bounds"]
    assert infos[1]["terminal_observation"] == 1.5
    assert obs[:, 0].tolist() == [1.0, 1.0, 0.5]
    for failing in (0, 3, 6):
        states = np.where(np.arange(7) == failing, 1.5, 1.0)[:, None]
        left = refreshed(env, states, np.zeros((7, 1))).dones[:7, 0].astype(bool)
        assert left.nonzero()[0].tolist() == [failing]


# Transitions of earlier models


def refreshed(env, states, actions):
    """A model buffer with transitions of an earlier model, refreshed by an environment."""
    mixed = MixedReplayBuffer(20, env.observation_space, env.action_space, "cpu")
    zeros = np.zeros(len(states), dtype=np.float32)
    mixed.add_model_rows(states, states + 99, actions, zeros, zeros, zeros)
    env.refresh(mixed.model_buffer)
    return mixed.model_buffer


@pytest.mark.parametrize("sampling", ["step", "trajectory"])
def test_refreshed_transitions_end_as_the_model_has_it(point_particles, unsure_dynamics, sampling):
    env = point_particles(dynamics=unsure_dynamics, sampling=sampling)
    assert refreshed(env, np.ones((0, 1)), np.ones((0, 1))).size() == 0
    states = np.linspace(0.1, 0.9, 7, dtype=np.float32)[:, None]
    buffer = refreshed(env, states, 0.2 * states)
    assert buffer.size() == 7
    pair = (torch.from_numpy(values).double() for values in (states, 0.4 * states))
    mean, variance = unsure_dynamics.predict(*pair)
    following = torch.from_numpy(buffer.next_observations[:7, 0])
    assert ((following - mean).abs() <= 6 * variance.sqrt() + 1e-6).all()
    rewards = torch.from_numpy(buffer.rewards[:7, 0])
    torch.testing.assert_close(rewards, -following[:, 0].square())


def test_functions_are_drawn_once_for_what_is_refreshed_and_the_episodes_after(
    point_particles, unsure_dynamics, monkeypatch
):
    drawn = []
    draw = unsure_dynamics.sample_functions
    monkeypatch.setattr(
        unsure_dynamics, "sample_functions", lambda n, *seed: drawn.append(n) or draw(n, *seed)
    )
    env = point_particles(dynamics=unsure_dynamics, sampling="trajectory")
    refreshed(env, np.ones((2, 1)), np.ones((2, 1)))
    moved(env, 1, 1, 1)
    assert drawn == [3]
    env.reset()  # other functions for other episodes
    assert drawn == [3, 3]


# As a vectorised environment


@pytest.mark.parametrize(
    "reward", [lambda s, a, n: (n[:, 0] > 0).long(), lambda s, a, n: WEIGHT * n[:, 0] / 1.5]
)
def test_rewards_may_be_whole_numbers_or_carry_gradients(point_particles, reward):
    assert moved(point_particles(reward=reward), 1, 1, 1)[1].tolist() == [1, 1, 1]


def test_attributes_are_those_of_all_particles(point_particles):
    particles = point_particles()
    assert particles.get_attr("episode_length", indices=[0, 2]) == [5, 5]
    particles.set_attr("worst_reward", 0.5)
    assert particles.get_attr("worst_reward") == [0.5, 0.5, 0.5]
    assert particles.env_is_wrapped(VecMonitor) == [False] * 3
    with pytest.raises(ValueError, match="all at once"):
        particles.set_attr("worst_reward", 0.5, indices=0)
    with pytest.raises(NotImplementedError, match="fly"):
        particles.env_method("fly")
