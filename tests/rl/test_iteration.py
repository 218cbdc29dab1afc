"""What an iteration of Dyna does: real steps, updates, model, model episodes."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from gpadjust.control import Task
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.rl import DynaOptions, DynaSAC, DynaTD3
from gpadjust.systems import cart_pole as swing_up
from gpadjust.systems.swing_up import CART_POLE_SPEC, cart_pole_reward
from tests.rl.conftest import model_rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "updates"),
    [
        ({}, 3 * (5 + 10)),
        ({"updates_per_model_step": 2}, 3 * (5 + 20)),
        ({"updates_per_model_step": 0}, 3 * 5),
        ({"updates_per_model_step": 0.3}, 3 * (5 + 3)),
        ({"updates_per_model_step": 0.25}, 3 * 5 + 7),  # of 7.5
        ({"model_episodes": 0}, 3 * 5),
        ({"model_episodes": 5, "num_particles": 2}, 3 * (5 + 25)),
        ({"gradient_steps": 2}, 3 * (2 + 10)),
        ({"last_model_episode": 2}, 3 * 5 + 2 * 10),
        ({"last_model_episode": 0}, 3 * 5),
        ({"episode_length": 3}, 3 * (5 + 6)),
        ({"learning_starts": 5}, 2 * 5 + 3 * 10),
        ({"train_freq": (2, "episode")}, 2 * 10 + 4 * 10),
    ],
)
def test_updates_are_as_many_as_promised(point_agent, options, updates):
    agent = point_agent(**{"updates_per_model_step": 1} | options).learn(15)
    assert agent._n_updates == updates


def test_model_rows_are_transitions_of_the_model(point_agent):
    agent = point_agent(terminated=lambda states: states[:, 0] > 9).learn(10)
    rows = agent.replay_buffer.model_buffer
    assert agent.num_timesteps == agent.replay_buffer.size() == 10
    assert agent.num_episodes == 2
    assert model_rows(agent) == 2 * 2 * 5
    n = rows.size()
    obs, following, actions, rewards, dones, timeouts = (
        getattr(rows, name)[:n, 0]
        for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    )
    np.testing.assert_allclose(following, obs + 0.5 * 2.0 * actions, atol=1e-5)
    np.testing.assert_allclose(rewards, -(following[:, 0] ** 2), atol=1e-5)
    starts = agent.replay_buffer.observations[[0, 5], 0, 0]
    assert set(obs[:2, 0]) == {starts[0]}
    assert set(obs[10:12, 0]) <= set(starts)
    assert dones.reshape(-1, 2).sum(1).tolist() == [0, 0, 0, 0, 2] * 2
    np.testing.assert_array_equal(dones, timeouts)


def test_options_of_the_model_are_taken(point_agent):
    starts = {"initial_states": lambda n: torch.full((n, 1), 0.25)}
    one = point_agent(**starts, train_freq=(15, "step"), model_episodes=4).learn(15)
    assert one.num_episodes == 3  # each is followed by its episodes in the model
    assert model_rows(one) == 3 * 4 * 5
    assert (one.replay_buffer.model_buffer.observations[:12] == 0.25).all()
    other = point_agent(model_buffer_size=15, seed=1).learn(10)
    assert other.replay_buffer.buffer_size == 500
    assert model_rows(other) == 15
    assert (one.replay_buffer.rewards[:5] != other.replay_buffer.rewards[:5]).any()


def test_episodes_that_terminate_in_the_model_end_there(point_agent, point_env):
    agent = point_agent(
        point_env(end=1.2),
        terminated=lambda states: states[:, 0] > 1.2,
        initial_states=lambda n: torch.full((n, 1), 1.19),
        model_episodes=8,
    ).learn(10)
    rows = agent.replay_buffer.model_buffer
    n = rows.size()
    assert n < 8 * 5 * agent.num_episodes
    over = rows.next_observations[:n, 0, 0] > 1.2
    assert over.any()
    np.testing.assert_array_equal(over, (rows.dones * (1 - rows.timeouts))[:n, 0].astype(bool))


def test_after_last_model_episode_batches_hold_no_model_rows(point_agent):
    agent = point_agent(last_model_episode=2, real_fraction=0.0, updates_per_model_step=1)
    mixed = []
    sample = agent.replay_buffer.sample

    def watch(*args, **options):
        mixed.append(agent.replay_buffer.mix)
        return sample(*args, **options)

    agent.replay_buffer.sample = watch
    agent.learn(20)
    assert mixed == [True] * 2 * (5 + 10) + [False] * 2 * 5
    assert model_rows(agent) == 2 * 2 * 5


@pytest.mark.slow
def test_a_long_run_in_pieces_goes_on(point_agent, sampled_dynamics):
    dynamics = sampled_dynamics()
    agent = point_agent(dynamics=dynamics)
    for total in (10, 20):  # the second call counts time steps from zero again
        agent.learn(10)
        assert dynamics.num_transitions == total
        assert agent.num_episodes == total // 5
        assert model_rows(agent) == 2 * total
    agent.learn(5, reset_num_timesteps=False)
    assert dynamics.num_transitions == 25
    assert agent.num_episodes == 5


@pytest.mark.slow
def test_dynamics_learn_each_real_transition_once(point_agent, learnt_dynamics):
    seen = []
    dynamics = learnt_dynamics()
    update = dynamics.update

    def watch(states, actions, next_states):
        seen.append(states)
        update(states, actions, next_states)

    dynamics.update = watch
    agent = point_agent(dynamics=dynamics, learning_starts=5).learn(20)
    assert torch.equal(torch.cat(seen), agent.recorded_episodes().states)
    assert [len(states) for states in seen] == [10, 5, 5]


class Stop(BaseCallback):
    """Stops a run at a step."""

    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        return self.num_timesteps < self.step


def test_a_run_that_was_stopped_within_a_episode_starts_another(point_agent, learnt_dynamics):
    dynamics = learnt_dynamics()
    agent = point_agent(dynamics=dynamics)
    agent.learn(10, callback=Stop(8))
    assert agent.replay_buffer.size() == 7  # what a callback stops at is not stored
    agent.learn(10, reset_num_timesteps=False)
    episodes = agent.recorded_episodes()
    follows = (episodes.states[1:] == episodes.next_states[:-1]).all(-1)
    assert follows.logical_not().nonzero().flatten().tolist() == [4, 6, 11]
    assert dynamics.num_transitions == 17


def test_states_beyond_the_bounds_are_not_followed(point_agent):
    bounds = torch.tensor([[0.9], [1.1]])
    agent = point_agent(state_bounds=bounds, initial_states=lambda n: torch.ones(n, 1)).learn(10)
    rows, n = agent.replay_buffer.model_buffer, model_rows(agent)
    assert 0 < n < 2 * 2 * 5
    following = rows.next_observations[:n]
    assert ((following > 0.9) & (following < 1.1)).all()
    stayed = (following == rows.observations[:n]).all(-1)[:, 0]
    assert stayed.any()
    assert rows.timeouts[:n, 0][stayed].all()
    assert rows.rewards[:n, 0][stayed].max() <= rows.rewards[:n, 0][~stayed].min(initial=0)


def test_model_episodes_that_teach_nothing_are_warned_of(point_agent):
    agent = point_agent(
        state_bounds=torch.tensor([[0.99], [1.01]]),
        initial_states=lambda n: torch.ones(n, 1),
        dynamics=PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + 5),
        reward_tolerance=None,
    )
    with pytest.warns(UserWarning, match="cannot learn from them"):
        agent.learn(5)


def test_a_first_episode_of_a_single_step_waits_for_the_second(
    point_agent, point_env, learnt_dynamics
):
    dynamics = learnt_dynamics()
    agent = point_agent(
        point_env(end=-9),
        terminated=lambda states: states[:, 0] > -9,
        dynamics=dynamics,
        updates_per_model_step=1,
    )
    assert agent.learn(1).num_episodes == 0
    agent.learn(2, reset_num_timesteps=False)
    assert agent.num_episodes == dynamics.num_transitions == 3
    assert agent._n_updates == 3 + 3 * 2


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [DynaSAC, DynaTD3])
def test_a_trivial_task_is_improved(point_agent, algorithm):
    def cost(agent):
        x = np.linspace(0.5, 1.5, 11, dtype=np.float32)[:, None]
        action, _ = agent.predict(x, deterministic=True)
        return float(((x + 0.5 * action) ** 2).mean())

    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.3)) if algorithm is DynaTD3 else None
    agent = point_agent(
        algorithm=algorithm,
        action_noise=noise,
        learning_rate=1e-2,
        model_episodes=10,
        batch_size=32,
        gamma=0.5,
        tau=0.05,
        policy_kwargs={"net_arch": [16]},
        updates_per_model_step=1,
    )
    before = cost(agent)
    agent.learn(30)
    assert cost(agent) < 0.2 * before


@pytest.mark.slow
def test_cart_pole(cart_pole):
    dynamics = LearnedDynamics(CART_POLE_SPEC, swing_up(0).physics)
    agent = DynaSAC(
        "MlpPolicy",
        cart_pole(),
        Task(dynamics, cart_pole_reward),
        DynaOptions(model_episodes=1, sampling="trajectory", score_horizons=()),
        batch_size=8,
        policy_kwargs={"net_arch": [8]},
        seed=0,
        device="cpu",
    ).learn(50)
    assert dynamics.num_transitions == 50
    assert 2 <= model_rows(agent) <= 50
    assert all(agent.wall_time[part] > 0 for part in ("fit", "rollout", "update"))


def pendulum_step(X):
    """Gymnasium's Pendulum-v1."""
    theta, speed, torque = X.unbind(-1)
    speed = (speed + (15 * theta.sin() + 3 * torque) * 0.05).clamp(-8, 8)
    return torch.stack([theta + speed * 0.05, speed], dim=-1)


def test_a_system_with_an_angle_of_another_order(point_agent):
    class SineFirst(gymnasium.ObservationWrapper):
        def observation(self, observation):
            return observation[[1, 0, 2]]

    def reward(states, actions, next_states):
        theta, speed = states.unbind(-1)
        theta = torch.atan2(theta.sin(), theta.cos())
        return -(theta.square() + 0.1 * speed.square() + 0.001 * actions[:, 0].square())

    env = SineFirst(gymnasium.make("Pendulum-v1", max_episode_steps=8))
    env.observation_space = spaces.Box(-8, 8, (3,))
    spec = StateSpec(["theta", "speed"], ["torque"], angles=["theta"])
    agent = point_agent(
        env, dynamics=PhysicsDynamics(spec, pendulum_step), reward=reward, episode_length=None
    ).learn(16)
    assert model_rows(agent) == 2 * 2 * 8


def test_several_environments(point_agent, point_env, learnt_dynamics):
    dynamics = learnt_dynamics()
    env = make_vec_env(point_env, n_envs=2, seed=0)
    agent = point_agent(env, dynamics=dynamics, train_freq=(4, "step"), gradient_steps=1)
    agent.learn(40)
    assert agent.num_timesteps == 40
    assert agent.num_episodes == 8
    assert dynamics.num_transitions == 40
    learnt = dynamics.state_dict()["transitions"]["states"]
    assert torch.equal(learnt.sort(0).values, agent.recorded_episodes().states.sort(0).values)


def test_normalised_environments(point_agent, normalised, learnt_dynamics):
    env = normalised()
    dynamics = learnt_dynamics()
    agent = point_agent(env, dynamics=dynamics).learn(15)
    assert env.obs_rms.count > 15
    raw = agent.recorded_episodes()
    assert torch.allclose(raw.next_states, raw.states + 0.5 * raw.actions, atol=0.1)
    rows = agent.replay_buffer.model_buffer
    start = torch.from_numpy(rows.observations[:2, 0]).double()
    assert torch.isin(start, raw.states).all()


def test_normalised_observations_are_what_the_policy_sees_in_the_model(
    point_agent, normalised, monkeypatch
):
    env = normalised()
    agent = point_agent(env)
    seen = []
    predict = agent.predict
    monkeypatch.setattr(agent, "predict", lambda obs, **rest: seen.append(obs) or predict(obs))
    agent.learn(5)
    in_model = seen[5:]
    assert len(in_model) == 5
    start = agent.replay_buffer.model_buffer.observations[:2, 0]
    np.testing.assert_allclose(in_model[0], env.normalize_obs(start), rtol=1e-6)
