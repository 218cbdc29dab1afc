"""What an iteration of Dyna does: real steps, updates, model, model episodes."""

import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.rl import DynaSAC, DynaTD3
from gpadjust.systems import RememberAction
from tests.rl.conftest import COLUMNS, model_rows

POINT_FIT = {"method": "map"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "updates"),
    [
        ({}, 3 * (5 + 10)),
        ({"updates_per_model_step": 0}, 3 * 5),
        ({"updates_per_model_step": 0.3}, 3 * (5 + 3)),
        ({"updates_per_model_step": 0.25}, 3 * 5 + 7),  # of 7.5
        ({"model_episodes": 0}, 3 * 5),
        ({"model_episodes": 5, "num_particles": 2}, 3 * (5 + 25)),
        ({"gradient_steps": 2}, 3 * (2 + 10)),
        ({"last_model_episode": 2}, 3 * 5 + 2 * 10),
        ({"episode_length": 3}, 3 * (5 + 6)),
        ({"learning_starts": 5}, 2 * 5 + 3 * 10),
        ({"train_freq": (2, "episode")}, 2 * 10 + 4 * 10),
    ],
)
def test_updates_are_as_many_as_promised(point_agent, options, updates):
    agent = point_agent(**{"updates_per_model_step": 1} | options).learn(15)
    assert agent._n_updates == updates


def test_model_rows_are_transitions_of_the_model(point_agent):
    ends = {"terminated": lambda states: states[:, 0] > 9, "episode_length": None}
    agent = point_agent(**ends).learn(10)
    rows = agent.replay_buffer.model_buffer
    assert agent.num_timesteps == agent.replay_buffer.size() == 10
    assert agent.num_episodes == 2
    assert model_rows(agent) == 2 * 2 * 5
    columns = (getattr(rows, name)[: rows.size(), 0] for name in COLUMNS)
    obs, following, actions, rewards, dones, timeouts = columns
    np.testing.assert_allclose(following, obs + 0.5 * 2.0 * actions, atol=1e-5)
    np.testing.assert_allclose(rewards, -(following[:, 0] ** 2), atol=1e-5)
    starts = agent.replay_buffer.observations[[0, 5], 0, 0]
    assert set(obs[:2, 0]) == {starts[0]}
    assert set(obs[10:12, 0]) <= set(starts)
    assert dones.reshape(-1, 2).sum(1).tolist() == [0, 0, 0, 0, 2] * 2
    np.testing.assert_array_equal(dones, timeouts)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [DynaSAC, DynaTD3])
def test_a_trivial_task_is_improved(point_agent, algorithm):
    def cost(agent):
        x = np.linspace(0.5, 1.5, 11, dtype=np.float32)[:, None]
        action, _ = agent.predict(x, deterministic=True)
        return float(((x + 0.5 * action) ** 2).mean())

    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.3)) if algorithm is DynaTD3 else None
    options = {"model_episodes": 10, "updates_per_model_step": 1, "action_noise": noise}
    options |= {"learning_rate": 1e-2, "batch_size": 32, "gamma": 0.5, "tau": 0.05}
    agent = point_agent(algorithm=algorithm, policy_kwargs={"net_arch": [16]}, **options)
    before = cost(agent)
    assert cost(agent.learn(30)) < 0.2 * before


def test_options_of_the_model_are_taken(point_agent):
    starts = {"initial_states": lambda n: torch.full((n, 1), 0.25)}
    agent = point_agent(**starts, train_freq=(15, "step"), model_episodes=4, buffer_size=50)
    assert agent.learn(15).num_episodes == 3  # each is followed by its episodes in the model
    assert model_rows(agent) == 50 < 3 * 4 * 5
    assert (agent.replay_buffer.model_buffer.observations[10:12] == 0.25).all()


def test_episodes_that_terminate_in_the_model_end_there(point_agent, point_env):
    ends = {"terminated": lambda states: states[:, 0] > 1.2, "model_episodes": 8}
    starts = {"initial_states": lambda n: torch.full((n, 1), 1.19)}
    agent = point_agent(point_env(end=1.2), **ends, **starts).learn(10)
    rows, n = agent.replay_buffer.model_buffer, model_rows(agent)
    assert n < 8 * 5 * agent.num_episodes
    over = rows.next_observations[:n, 0, 0] > 1.2
    assert over.any()
    np.testing.assert_array_equal(over, (rows.dones * (1 - rows.timeouts))[:n, 0].astype(bool))


def test_after_last_model_episode_batches_hold_no_model_rows(point_agent):
    agent = point_agent(last_model_episode=2, real_fraction=0.0, updates_per_model_step=1)
    buffer, mixed = agent.replay_buffer, []
    sample = buffer.sample
    buffer.sample = lambda *args, **options: mixed.append(buffer.mix) or sample(*args, **options)
    agent.learn(15)
    assert mixed == [True] * 2 * (5 + 10) + [False] * 5
    assert model_rows(agent) == 2 * 2 * 5


@pytest.mark.slow
def test_dynamics_learn_each_real_transition_once(point_agent, learnt_dynamics):
    dynamics, batches = learnt_dynamics(), []
    update = dynamics.update
    dynamics.update = lambda *data: batches.append(data[0]) or update(*data)
    agent = point_agent(dynamics=dynamics, learning_starts=5)
    for reset in (True, False):  # the first call counts time steps from zero
        agent.learn(10, reset_num_timesteps=reset)
    assert torch.equal(torch.cat(batches), agent.recorded_episodes().states)
    assert [len(states) for states in batches] == [10, 5, 5]


def test_a_run_that_was_stopped_within_a_episode_starts_another(point_agent, learnt_dynamics):
    def stop(local_names, global_names):
        return agent.num_timesteps < 8

    agent = point_agent(dynamics=learnt_dynamics())
    agent.learn(10, callback=stop)
    assert agent.replay_buffer.size() == 7  # what a callback stops at is not stored
    agent.learn(10, reset_num_timesteps=False)
    episodes = agent.recorded_episodes()
    follows = (episodes.states[1:] == episodes.next_states[:-1]).all(-1)
    assert follows.logical_not().nonzero().flatten().tolist() == [4, 6, 11]
    assert agent.task.dynamics.num_transitions == 17


def test_model_episodes_that_teach_nothing_are_warned_of(point_agent):
    jump = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + 5)
    starts = {"initial_states": lambda n: torch.ones(n, 1), "reward_tolerance": None}
    bounds = torch.tensor([[0.99], [1.01]])
    with pytest.warns(UserWarning, match="cannot learn from them"):
        point_agent(state_bounds=bounds, dynamics=jump, **starts).learn(5)


def test_a_first_episode_of_a_single_step_waits_for_the_second(
    point_agent, point_env, learnt_dynamics
):
    ends = {"terminated": lambda states: states[:, 0] > -9, "updates_per_model_step": 1}
    agent = point_agent(point_env(end=-9), dynamics=learnt_dynamics(), **ends)
    assert agent.learn(1).num_episodes == 0
    agent.learn(2, reset_num_timesteps=False)
    assert agent.num_episodes == agent.task.dynamics.num_transitions == 3
    assert agent._n_updates == 3 + 3 * 2


def test_actions_taken_in_the_model_are_remembered(point_agent, point_env):
    spec = StateSpec(["x", "last"], ["v"], previous={"last": "v"})
    dynamics = LearnedDynamics(spec, lambda X: X[:, :1] + 0.4 * X[:, 1:], fit_options=POINT_FIT)
    agent = point_agent(RememberAction(point_env()), dynamics=dynamics).learn(10)
    rows, n = agent.replay_buffer.model_buffer, model_rows(agent)
    assert n == 2 * 2 * 5
    last, actions = rows.next_observations[:n, 0, 1], 2 * rows.actions[:n, 0, 0]
    np.testing.assert_allclose(last, actions, atol=1e-4)


def test_several_environments(point_agent, point_env, learnt_dynamics):
    env = make_vec_env(point_env, n_envs=2, seed=0)
    several = {"train_freq": (4, "step"), "gradient_steps": 1, "dynamics": learnt_dynamics()}
    agent = point_agent(env, **several).learn(40)
    assert agent.num_timesteps == 40
    assert agent.num_episodes == 8
    learnt = agent.task.dynamics.state_dict()["transitions"]["states"]
    assert torch.equal(learnt.sort(0).values, agent.recorded_episodes().states.sort(0).values)


def test_the_policy_gets_normalised_observations_and_the_dynamics_raw_ones(
    point_agent, normalised, monkeypatch
):
    env = normalised()
    agent, observations = point_agent(env), []
    predict = agent.predict
    monkeypatch.setattr(
        agent, "predict", lambda obs, **rest: observations.append(obs) or predict(obs)
    )
    agent.learn(5)
    in_model = observations[5:]
    assert len(in_model) == 5
    start = agent.replay_buffer.model_buffer.observations[:2, 0]
    np.testing.assert_allclose(in_model[0], env.normalize_obs(start), rtol=1e-6)
    raw = agent.recorded_episodes()
    assert torch.allclose(raw.next_states, raw.states + 0.5 * raw.actions, atol=0.1)
    assert torch.isin(torch.from_numpy(start).double(), raw.states).all()
