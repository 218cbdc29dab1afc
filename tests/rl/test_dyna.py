"""Soft actor-critic that also trains in a model."""

import csv
import threading
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.models import Prediction, ZeroMeanGP
from gpadjust.physics import PhysicsError
from gpadjust.rl import DynaCallback, DynaOptions, DynaSAC, DynaTD3, ModelVecEnv
from gpadjust.rl.buffer import CompactReplayBuffer
from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward, cart_pole_start

POINT_SPEC = StateSpec(["x"], ["v"])


@pytest.fixture
def normalised(point_env):
    """Makes normalised environments of the point."""
    return lambda n=1: VecNormalize(DummyVecEnv([point_env] * n))


def model_rows(agent):
    return agent.replay_buffer.model_buffer.size()


# What a run does


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


def test_model_steps_are_no_time_steps(point_agent):
    agent = point_agent().learn(15)
    assert agent.num_timesteps == 15
    assert agent.replay_buffer.size() == 15
    assert model_rows(agent) == 3 * 2 * 5
    assert agent.num_episodes == 3


def test_model_rows_are_transitions_of_the_model(point_agent):
    agent = point_agent(terminated=lambda states: states[:, 0] > 9).learn(10)
    rows = agent.replay_buffer.model_buffer
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


def test_initial_states_may_be_given(point_agent):
    agent = point_agent(initial_states=lambda n: torch.full((n, 1), 0.25)).learn(5)
    assert (agent.replay_buffer.model_buffer.observations[:2] == 0.25).all()


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


def test_each_episode_that_ended_is_followed_by_model_episodes(point_agent):
    agent = point_agent(train_freq=(15, "step"), model_episodes=4).learn(15)
    assert agent.num_episodes == 3
    assert model_rows(agent) == 3 * 4 * 5


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
    with pytest.warns(UserWarning, match="has learnt nothing of use from the model"):
        agent.learn(5)


def test_the_model_buffer_keeps_the_newest(point_agent):
    agent = point_agent(model_buffer_size=15).learn(10)
    assert agent.replay_buffer.buffer_size == 500
    assert model_rows(agent) == 15


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


@pytest.mark.filterwarnings("ignore:The draws of")  # there are 16
def test_cart_pole(cart_pole):
    dynamics = LearnedDynamics(
        CART_POLE_SPEC,
        cart_pole(0).physics,
        fit_options={"num_screened": 8, "num_starts": 1, "num_samples": 3, "num_draws": 16},
    )
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


def test_two_runs_are_the_same(point_agent, sampled_dynamics, assert_same):
    agents = [point_agent(dynamics=sampled_dynamics(), seed=3).learn(10) for _ in range(2)]
    assert_same(*agents)


def test_another_seed_is_another_run(point_agent):
    one, other = (point_agent(seed=seed).learn(5) for seed in (0, 1))
    assert (one.replay_buffer.rewards[:5] != other.replay_buffer.rewards[:5]).any()


# Callbacks and the logger


def test_metrics_of_the_model_are_logged(point_agent, learnt_dynamics, tmp_path):
    agent = point_agent(dynamics=learnt_dynamics())
    agent.set_logger(configure(str(tmp_path), ["csv"]))
    agent.learn(20, log_interval=1)
    agent.logger.close()
    with open(tmp_path / "progress.csv") as file:
        last = [*csv.DictReader(file)][-1]
    shares = [float(last[f"model/share_{part}"]) for part in ("fit", "rollout", "update")]
    assert sum(shares) == pytest.approx(1, abs=1e-3)
    for name in ("nlpd", "coverage", "rmse/x", "fit_seconds", "ep_rew_mean"):
        assert np.isfinite(float(last[f"model/{name}"]))
    assert float(last["model/left_bounds"]) == 0


def test_particles_that_left_the_bounds_are_logged_once(point_agent, point_dynamics):
    runaway = PhysicsDynamics(
        point_dynamics.spec, lambda X: X[:, :1] + torch.where(X[:, :1] > 1.0, 1e6, 0.0)
    )
    starts = torch.tensor([[0.6], [1.4], [0.8]])
    agent = point_agent(
        dynamics=runaway,
        model_episodes=3,
        initial_states=lambda n: starts[:n],
        updates_per_model_step=1,
    )
    agent.learn(5)
    assert agent.logger.name_to_value["model/left_bounds"] == 1
    assert model_rows(agent) == 1 + 2 * 5
    assert agent._n_updates == 5 + 1 + 2 * 5


def test_callbacks_of_stable_baselines(point_agent, normalised, point_env, tmp_path):
    evaluated = VecNormalize(make_vec_env(point_env), training=False)
    evaluation = EvalCallback(
        evaluated, n_eval_episodes=1, eval_freq=10, log_path=str(tmp_path), verbose=0
    )
    saving = CheckpointCallback(
        10, str(tmp_path), "agent", save_replay_buffer=True, save_vecnormalize=True
    )
    agent = point_agent(normalised())
    agent.learn(100, [evaluation, saving, StopTrainingOnMaxEpisodes(4)])
    assert agent.num_timesteps == 20
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [10, 20]
    names = {file.name for file in tmp_path.iterdir()}
    assert {
        "agent_10_steps.zip",
        "agent_replay_buffer_20_steps.pkl",
        "agent_vecnormalize_20_steps.pkl",
    } <= names


def test_progress_bar(point_agent, capsys):
    with pytest.warns(match="rich is experimental"):
        point_agent().learn(10, progress_bar=True)
    assert "10/10" in capsys.readouterr().out


# Saving and loading


@pytest.fixture(scope="module")
def once():
    """What is made once for several tests, none of which changes it."""
    return {}


@pytest.fixture
def saved(once, point_agent, learnt_dynamics, tmp_path_factory):
    """An agent after two episodes, and its file."""
    if not once:
        agent = point_agent(dynamics=learnt_dynamics()).learn(10)
        path = tmp_path_factory.mktemp("saved") / "agent.zip"
        agent.save(path)
        once["saved"] = agent, path
    return once["saved"]


def test_a_loaded_agent_predicts_the_same(saved):
    agent, path = saved
    obs = np.linspace(-1, 1, 7, dtype=np.float32)[:, None]
    loaded = DynaSAC.load(path)
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0]
    )


def test_without_dynamics_a_loaded_agent_only_predicts(saved, point_env):
    _, path = saved
    with pytest.raises(ValueError, match=r"needs a task to learn.*DynaSAC.load"):
        DynaSAC.load(path, env=point_env()).learn(5)
    with pytest.raises(ValueError, match=r"needs a task to learn"):
        DynaSAC.load(path).learn(5)


def test_with_dynamics_but_no_environment_it_says_so(saved, learnt_dynamics, point_task):
    _, path = saved
    loaded = DynaSAC.load(path, task=point_task(dynamics=learnt_dynamics()))
    with pytest.raises(ValueError, match="env"):
        loaded.learn(5)


def test_with_dynamics_a_loaded_agent_goes_on(
    point_agent, point_env, sampled_dynamics, point_task, tmp_path
):
    agent, path = point_agent(dynamics=sampled_dynamics()).learn(10), tmp_path / "agent.zip"
    agent.save(path)
    dynamics = sampled_dynamics()
    loaded = DynaSAC.load(path, env=point_env(), task=point_task(dynamics=dynamics))
    x = torch.linspace(0, 1, 5).double()[:, None]
    for one, other in zip(dynamics.predict(x, x), agent.task.dynamics.predict(x, x), strict=True):
        assert torch.equal(one, other)
    assert loaded.num_episodes == 2
    loaded.learn(5, reset_num_timesteps=False)
    assert dynamics.num_transitions == 15
    assert loaded.num_timesteps == 15
    assert loaded.num_episodes == 3


def test_what_the_dynamics_learnt_outlives_an_agent_without_them(
    saved, tmp_path, learnt_dynamics, point_task
):
    agent, path = saved
    again = tmp_path / "again.zip"
    DynaSAC.load(path).save(again)
    dynamics = learnt_dynamics()
    DynaSAC.load(again, task=point_task(dynamics=dynamics))
    assert dynamics.num_transitions == agent.task.dynamics.num_transitions


def test_dynamics_of_another_kind_are_not_loaded(saved, point_task):
    _, path = saved
    other = LearnedDynamics(StateSpec(["x"], ["v"]), model=ZeroMeanGP)
    with pytest.raises(RuntimeError, match=r"model is .*CKA.* in the state, .*ZeroMeanGP.* here"):
        DynaSAC.load(path, task=point_task(dynamics=other))


def test_a_wrong_reward_is_found_after_loading_too(saved, point_env, learnt_dynamics, point_task):
    _, path = saved
    task = point_task(dynamics=learnt_dynamics(), reward=lambda s, a, n: s[:, 0])
    loaded = DynaSAC.load(path, env=point_env(), task=task)
    with pytest.raises(ValueError, match="is not the environment's"):
        loaded.learn(5)


def test_the_file_holds_neither_physics_nor_functions_nor_environment(
    point_agent, point_env, tmp_path
):
    class Unpicklable:
        """A physics, reward and so on that no pickler can take."""

        def __init__(self, function):
            self.function, self.lock = function, threading.Lock()

        def __call__(self, *args):
            return self.function(*args)

        def __reduce__(self):
            raise AssertionError("pickled")

    env = point_env()
    env.unwrapped.robot = threading.Lock()
    spec = StateSpec(["x"], ["v"])
    agent = point_agent(
        env,
        dynamics=PhysicsDynamics(spec, Unpicklable(lambda X: X[:, :1] + 0.5 * X[:, 1:])),
        reward=Unpicklable(lambda states, actions, next_states: -next_states[:, 0].square()),
        terminated=Unpicklable(lambda states: states[:, 0] > 99),
        initial_states=Unpicklable(lambda n: torch.ones(n, 1)),
    )
    agent.learn(5, DynaCallback())
    agent.save(tmp_path / "agent.zip")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        data = archive.read("data").decode()
    for name in ("task", "dynamics", "env", "model_hooks"):
        assert f'"{name}":' not in data


def test_both_buffers_are_saved_together(point_agent, tmp_path):
    agent = point_agent().learn(10)
    agent.replay_buffer.model_buffer.device = torch.device("meta")  # as if saved on another machine
    agent.save_replay_buffer(tmp_path / "buffer.pkl")
    other = point_agent(seed=1)
    other.load_replay_buffer(tmp_path / "buffer.pkl")
    for one, again in [
        (agent.replay_buffer, other.replay_buffer),
        (agent.replay_buffer.model_buffer, other.replay_buffer.model_buffer),
    ]:
        np.testing.assert_array_equal(one.observations, again.observations)
        assert again.size() == one.size() > 0
        assert again.device == other.device


def test_parameters_can_be_moved(saved, point_agent, learnt_dynamics):
    agent, path = saved
    for source in (agent.get_parameters(), str(path)):
        other = point_agent(dynamics=learnt_dynamics(), seed=9)
        other.set_parameters(source)
        assert other.task.dynamics.num_transitions == 10
        obs = np.zeros((1, 1), dtype=np.float32)
        np.testing.assert_array_equal(
            other.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0]
        )


def test_parameters_without_dynamics_are_refused_unless_told(saved, point_agent, learnt_dynamics):
    agent, _ = saved
    networks = {k: v for k, v in agent.get_parameters().items() if k != "dynamics"}
    other = point_agent(dynamics=learnt_dynamics(), seed=9)
    with pytest.raises(
        ValueError, match=r"with the state of the dynamics, 'dynamics'; found \['act"
    ):
        other.set_parameters(networks)
    other.set_parameters(networks, exact_match=False)
    assert not other.task.dynamics.is_fitted


def test_a_task_that_is_given_after_loading_knows_what_was_learnt(
    saved, point_env, point_task, crude_dynamics
):
    agent, path = saved
    loaded = DynaSAC.load(path, env=point_env())
    known = {k: v for k, v in agent.get_parameters().items() if k != "dynamics"}
    loaded.set_parameters(known, exact_match=False)
    loaded.task = point_task(dynamics=crude_dynamics(agent.task.dynamics.physics))
    loaded.learn(5, reset_num_timesteps=False)
    assert loaded.task.dynamics.num_transitions == 15


def test_parameters_are_taken_as_a_whole(saved, point_agent, learnt_dynamics, tensors_of):
    agent, _ = saved
    broken = agent.get_parameters()
    broken["policy"] = {}
    other = point_agent(dynamics=learnt_dynamics(), seed=9).learn(5)
    with pytest.raises(RuntimeError, match="Missing key"):
        other.set_parameters(broken)
    assert other.task.dynamics.num_transitions == 5


def test_another_physics_is_not_loaded(saved, point_task, crude_dynamics):
    _, path = saved
    other = crude_dynamics(lambda X: X[:, :1] + 0.1 * X[:, 1:])
    with pytest.raises(RuntimeError, match="physics"):
        DynaSAC.load(path, task=point_task(dynamics=other))


# Errors lose nothing


def test_a_wrong_reward_is_mended_and_nothing_is_lost(point_agent, point_task, learnt_dynamics):
    dynamics = learnt_dynamics()
    wrong = point_task(dynamics=dynamics, reward=lambda states, actions, following: states[:, 0])
    agent = point_agent(task=wrong)
    before = [p.clone() for p in agent.policy.parameters()]
    with pytest.raises(ValueError, match="is not the environment's"):
        agent.learn(5)
    assert all(torch.equal(*pair) for pair in zip(before, agent.policy.parameters(), strict=True))
    agent.task = point_task(dynamics=dynamics)
    agent.learn(5, reset_num_timesteps=False)
    assert torch.equal(
        dynamics.state_dict()["transitions"]["states"], agent.recorded_episodes().states
    )
    assert agent.num_episodes == 2
    assert model_rows(agent) == 2 * 2 * 5


@pytest.mark.parametrize("fails", ["fit", "rollout"])
def test_a_physics_that_fails_for_a_while_loses_no_transition(
    point_agent, crude_dynamics, fails, monkeypatch
):
    """Where the dynamics learn, or after that, where particles move."""
    broken = []

    def physics(X):
        if broken:
            raise PhysicsError("the simulator's licence has expired")
        return X[:, :1] + 0.4 * X[:, 1:]

    dynamics = crude_dynamics(physics)
    agent = point_agent(dynamics=dynamics)
    agent.learn(5)
    if fails == "rollout":
        monkeypatch.setattr(ModelVecEnv, "reset", lambda env: broken.append(1) or env._states)
    breaks = BreaksAt(8, broken) if fails == "fit" else None
    with pytest.raises(PhysicsError, match="licence"):
        agent.learn(5, breaks, reset_num_timesteps=False)
    assert dynamics.num_transitions == (5 if fails == "fit" else 10)
    broken.clear()
    monkeypatch.undo()
    agent.learn(5, reset_num_timesteps=False)
    assert torch.equal(
        dynamics.state_dict()["transitions"]["states"], agent.recorded_episodes().states
    )
    assert agent.num_episodes == 3


def test_other_dynamics_learn_all_that_there_is(point_agent, point_task, learnt_dynamics):
    agent = point_agent(dynamics=learnt_dynamics()).learn(10)
    other = learnt_dynamics()
    agent.task = point_task(dynamics=other)
    agent.learn(5, reset_num_timesteps=False)
    assert other.num_transitions == 15


def test_transitions_at_which_the_physics_fails_are_left_out(point_agent, crude_dynamics):
    def physics(X):
        bad = (X[:, 0] < 0.4).nonzero().flatten().tolist()
        if bad:
            raise PhysicsError("not below .4", bad)
        return X[:, :1] + 0.4 * X[:, 1:]

    dynamics = crude_dynamics(physics)
    agent = point_agent(dynamics=dynamics)
    with pytest.warns(UserWarning, match=r"fails at \d of \d new transitions"):
        agent.learn(20)
    states = agent.recorded_episodes().states
    assert agent.num_episodes == 4
    assert dynamics.num_transitions == int((states >= 0.4).sum()) < 20


def test_a_buffer_that_holds_no_episode_is_refused(point_agent):
    with pytest.raises(ValueError, match="buffer_size must hold an episode of 5 steps"):
        point_agent(buffer_size=3).learn(5)


class Falls(gymnasium.Wrapper):
    """A robot that has to be set up again after its eighth step."""

    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 8:
            raise OSError("the robot fell")
        return super().step(action)


def test_an_environment_that_fails_within_an_episode(point_agent, point_env, learnt_dynamics):
    dynamics = learnt_dynamics()
    agent = point_agent(Falls(point_env()), dynamics=dynamics)
    with pytest.raises(OSError, match="fell"):
        agent.learn(10)
    agent.learn(5, reset_num_timesteps=False)
    recorded = agent.recorded_episodes()
    assert dynamics.num_transitions == recorded.num_transitions == 5 + 2 + 5
    follows = (recorded.states[1:] == recorded.next_states[:-1]).all(-1)
    assert follows.logical_not().nonzero().flatten().tolist() == [4, 6]
    starts = recorded.draw_starts(100).unique().tolist()
    assert starts == recorded.states[[0, 5, 7], 0].sort().values.tolist()


class BreaksAt(BaseCallback):
    """At a step, what was empty is not any more."""

    def __init__(self, step, broken):
        super().__init__()
        self.step, self.broken = step, broken

    def _on_step(self):
        self.broken += [True] * (self.num_timesteps == self.step)
        return True


class Jams(gymnasium.Wrapper):
    """At some steps the system does not move, and says so."""

    def __init__(self, env, jams):
        super().__init__(env)
        self.jams, self.steps = jams, 0

    def step(self, action):
        before = self.env.unwrapped.x.copy()
        observation, reward, terminated, truncated, info = self.env.step(action)
        failed = self.steps in self.jams
        self.steps += 1
        if failed:
            self.env.unwrapped.x = observation = before
        return observation, reward, terminated, truncated or failed, info | {"step_failed": failed}


@pytest.mark.parametrize("jams", [(0,), (3,), (5, 6), (4, 9)])
def test_a_step_that_failed_is_no_data(point_agent, point_env, learnt_dynamics, jams):
    dynamics = learnt_dynamics()
    agent = point_agent(Jams(point_env(), jams), dynamics=dynamics, reward_tolerance=None)
    agent.learn(15)
    assert agent.replay_buffer.size() == agent.num_timesteps - len(jams)
    recorded = agent.recorded_episodes()
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)
    follows = (recorded.states[1:] == recorded.next_states[:-1]).all(-1)
    starts = [0, *(1 + follows.logical_not().nonzero().flatten()).tolist()]
    assert recorded.begins.nonzero().flatten().tolist() == starts
    assert (recorded.episode.diff() > 0).nonzero().flatten().add(1).tolist() == starts[1:]
    assert dynamics.num_transitions <= recorded.num_transitions


def test_of_several_environments_one_may_fail(point_agent, point_env):
    env = DummyVecEnv([lambda: Jams(point_env(), (3,)), point_env])
    agent = point_agent(env, train_freq=(5, "step"), reward_tolerance=None).learn(20)
    recorded = agent.recorded_episodes()
    assert recorded.num_transitions == 19
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)
    batch = agent.replay_buffer.sample(200)
    moved = batch.next_observations - batch.observations
    torch.testing.assert_close(moved, batch.actions, atol=0.1, rtol=0)


class Counts(gymnasium.Wrapper):
    num_steps = 0

    def step(self, action):
        Counts.num_steps += 1
        return super().step(action)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"initial_states": lambda n: torch.ones(n)}, r"initial_states\(2\) must return .* 2 x 1"),
        ({"initial_states": lambda n: torch.full((n, 1), torch.nan)}, "finite states; found"),
        ({"reward": lambda s, a, n: n}, r"reward must return one value per row, shape \(2,\)"),
        ({"terminated": lambda s: s}, r"terminated must return one value per row"),
        (
            {"dynamics": LearnedDynamics(POINT_SPEC, lambda X: X)},
            "next values of the 1 states .* got 2 columns",
        ),
    ],
)
def test_wrong_functions_are_found_before_the_first_real_step(
    point_agent, point_env, parts, message
):
    Counts.num_steps = 0
    agent = point_agent(Counts(point_env()), **parts)
    with pytest.raises((ValueError, PhysicsError), match=message):
        agent.learn(5)
    assert Counts.num_steps == 0


# A family


def test_one_that_never_uses_its_model_is_the_learner(point_agent, point_env, normalised):
    for algorithm, learner, noisy in [(DynaSAC, SAC, False), (DynaTD3, TD3, True)]:
        noise = NormalActionNoise(np.zeros(1), np.full(1, 0.3)) if noisy else None
        shared = {
            "batch_size": 8,
            "buffer_size": 500,
            "learning_starts": 3,
            "train_freq": (1, "episode"),
            "gradient_steps": -1,
            "policy_kwargs": {"net_arch": [8]},
            "action_noise": noise,
            "device": "cpu",
            "seed": 0,
        }
        ours = point_agent(normalised(), algorithm, last_model_episode=0, **shared).learn(25)
        theirs = learner("MlpPolicy", normalised(), **shared).learn(25)
        assert ours._n_updates == theirs._n_updates == 25
        pairs = zip(
            ours.policy.state_dict().items(), theirs.policy.state_dict().items(), strict=True
        )
        for (name, weights), (other, expected) in pairs:
            assert name == other
            assert torch.equal(weights, expected), name
        for name in CompactReplayBuffer.rows:
            one, other = (getattr(agent.replay_buffer, name) for agent in (ours, theirs))
            np.testing.assert_array_equal(one, other)
        assert model_rows(ours) == 0


@pytest.mark.slow
def test_td3_swings_up_the_cart_pole(cart_pole, cart_pole_dynamics):
    """In the known system, after 12 episodes; to hang costs .95, to swing up some .3."""
    agent = DynaTD3(
        "MlpPolicy",
        cart_pole(),
        Task(cart_pole_dynamics, cart_pole_reward, initial_states=cart_pole_start),
        DynaOptions(model_episodes=20, num_particles=5),
        action_noise=NormalActionNoise(np.zeros(1), np.full(1, 0.2)),
        learning_rate=1e-3,
        gamma=0.95,
        tau=0.02,
        policy_kwargs={"net_arch": [128, 128]},
        device="cpu",
        seed=0,
    ).learn(12 * 25)
    torch.manual_seed(1)
    env = agent.model_env(20)
    obs, costs = env.reset(), []
    for _ in range(25):
        obs, rewards, _, _ = env.step(agent.predict(obs, deterministic=True)[0])
        costs.append(-rewards.mean())
    assert np.mean(costs) < 0.6


def test_particles_have_action_noise_of_their_own(point_agent):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.3))
    agent = point_agent(algorithm=DynaTD3, action_noise=noise, model_episodes=3)
    agent.learn(5)
    first = agent.replay_buffer.model_buffer.actions[:3, 0, 0]  # at the same start
    assert len(set(first.tolist())) == 3
    assert (np.abs(first) <= 1).all()
    silent = point_agent(algorithm=DynaTD3, model_episodes=3).learn(5)
    assert len(set(silent.replay_buffer.model_buffer.actions[:3, 0, 0].tolist())) == 1


def test_target_networks_are_updated_as_seldom_as_told(point_agent, monkeypatch):
    """Steps of 2 particles in the model owe 2 updates; 10 of them are made together."""
    chunks = []
    train = SAC.train
    monkeypatch.setattr(
        SAC, "train", lambda agent, n, batch: chunks.append(n) or train(agent, n, batch)
    )
    agent = point_agent(target_update_interval=10, updates_per_model_step=1).learn(10)
    assert chunks == [5, 10, 5, 10]
    assert agent.owed_updates == 0


class Own(Dynamics):
    """Dynamics of a user's, that know the point but for a shift."""

    is_fitted = True

    def predict(self, states, actions):
        mean = states + 0.5 * actions + 0.1
        return Prediction(mean, torch.full_like(mean, 0.2**2))

    def sample(self, states, actions):
        mean, variance = self.predict(states, actions)
        return mean + variance.sqrt() * torch.randn_like(mean)

    def sample_functions(self, num_functions, seed=None):
        return lambda states, actions: self.predict(states, actions).mean

    def update(self, states, actions, next_states):
        pass

    def describe(self):
        return {"class": "Own"}

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def test_the_foresight_of_a_users_own_dynamics_is_logged(point_agent, point_dynamics):
    agent = point_agent(dynamics=Own(point_dynamics.spec)).learn(5, log_interval=100)
    logged = agent.logger.name_to_value
    assert logged["model/rmse/x"] == pytest.approx(0.1, abs=0.03)
    assert logged["model/coverage"] == 1
    assert np.isfinite(logged["model/nlpd"])


def logged_of(agent, episodes):
    """What the log holds of the model after so many episodes of the point, of 5 steps each."""
    agent.learn(5 * episodes, log_interval=100)
    return {name for name in agent.logger.name_to_value if name.startswith("model/")}


def test_trajectories_are_scored_before_they_are_learnt(point_agent, sampled_dynamics):
    agent = point_agent(dynamics=sampled_dynamics(), score_horizons=(4, 2, 9))
    assert agent.options.score_horizons == (2, 4, 9)
    scores = {f"model/{name}_{k}" for name in ("nlpd", "coverage", "energy") for k in (2, 4, 9)}
    assert not logged_of(agent, 1) & scores
    # No episode has 9 steps.
    assert logged_of(agent, 1) & scores == {name for name in scores if "_9" not in name}
    logged = agent.logger.name_to_value
    assert 0 <= logged["model/coverage_4"] <= 1
    assert logged["model/energy_2"] > 0
    assert logged["model/score_seconds"] > 0
    assert logged["model/fit_seconds"] > 0


def test_without_doubt_energies_alone_are_logged(point_agent):
    scores = {name for name in logged_of(point_agent(score_horizons=(1, 5)), 1) if "_" in name}
    assert scores >= {"model/energy_1", "model/energy_5"}
    assert not any("nlpd" in name or "coverage" in name for name in scores)


def test_to_score_trajectories_changes_nothing(point_agent, sampled_dynamics, assert_same):
    one, other = (
        point_agent(dynamics=sampled_dynamics(), score_horizons=horizons).learn(15)
        for horizons in ((1, 5), ())
    )
    assert not any("energy" in name for name in other.logger.name_to_value)
    assert_same(one, other)


class Stiff(Own):
    """Dynamics that have no functions."""

    def sample_functions(self, num_functions, seed=None):
        raise NotImplementedError("No features of this kernel.")


def test_dynamics_without_functions_are_learnt_without_scores_of_trajectories(
    point_agent, point_dynamics
):
    agent = point_agent(dynamics=Stiff(point_dynamics.spec), score_horizons=(1, 5))
    with pytest.warns(UserWarning, match=r"No features of this kernel\. Pass score_horizons"):
        logged = logged_of(agent, 1)
    assert "model/coverage" in logged
    assert "model/energy_1" not in logged
    logged_of(point_agent(dynamics=Stiff(point_dynamics.spec), score_horizons=()), 1)


@pytest.mark.parametrize("horizons", [5, (0,), (1, 1), (1.5,)])
def test_horizons_that_are_no_numbers_of_steps(horizons):
    with pytest.raises((TypeError, ValueError), match="horizon"):
        DynaOptions(score_horizons=horizons)


# Bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_steps": 3}, "no n-step returns; found n_steps=3"),
        ({"replay_buffer_class": dict}, "must be MixedReplayBuffer .*found dict"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        ({"real_fraction": 2}, "real_fraction must be .*; found 2"),
        ({"updates_per_model_step": float("inf")}, "updates_per_model_step must be .*; found inf"),
        ({"state_bounds": torch.ones(2, 4)}, r"state_bounds must be of shape 2 x 1"),
        (
            {"state_bounds": torch.tensor([[1.0], [-1.0]])},
            r"below its upper one; found",
        ),
        ({"model_buffer_size": -1}, "model_buffer_size must be at least 1; found -1"),
        ({"model_episodes": -1}, "model_episodes must be at least 0; found -1"),
        (
            {"updates_per_model_step": -0.5},
            "updates_per_model_step must be .*; found -0.5",
        ),
        (
            {"updates_per_model_step": float("nan")},
            "updates_per_model_step must be .*; found nan",
        ),
        ({"last_model_episode": -1}, "last_model_episode must be at least 0; found -1"),
        ({"episode_length": 0}, "episode_length must be at least 1; found 0"),
        ({"num_particles": 0}, "num_particles must be at least 1; found 0"),
        ({"sampling": "swarm"}, "Unknown sampling 'swarm'"),
        ({"gradient_steps": 0}, "gradient_steps"),
    ],
)
def test_bad_arguments_are_refused(point_agent, options, message):
    with pytest.raises(ValueError, match=message):
        point_agent(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dynamics": "cka"}, "dynamics must be an object of a Dynamics; found 'cka'"),
        ({"reward": None}, "reward must be a function .*found None"),
        ({"refresh_model_data": 1}, "refresh_model_data must be True or False; found 1"),
        ({"episode_length": 2.5}, "episode_length must be a whole number; found 2.5"),
        ({"reward": 1.0}, "reward must be a function; found 1.0"),
        ({"reward": lambda states: states}, r"reward is called with 3 .*found reward\(states\)"),
        ({"terminated": lambda: None}, r"terminated is called with 1 .*found terminated\(\)"),
        ({"initial_states": torch.ones(3, 1)}, "initial_states must be a function"),
        ({"model_episodes": 2.5}, "model_episodes must be a whole number; found 2.5"),
        ({"updates_per_model_step": "2"}, "updates_per_model_step must be a number; found '2'"),
        ({"reward_tolerance": "no"}, "reward_tolerance must be a number; found 'no'"),
    ],
)
def test_arguments_of_another_type_are_refused(point_agent, options, message):
    with pytest.raises(TypeError, match=message):
        point_agent(**options)


def test_what_has_its_place_elsewhere_is_told(point_env, point_dynamics, point_task):
    with pytest.raises(TypeError, match=r"task must be a Task\(dynamics, reward"):
        DynaSAC("MlpPolicy", point_env(), point_dynamics)
    with pytest.raises(TypeError, match=r"pass DynaOptions\(model_episodes=2\) as options"):
        DynaSAC("MlpPolicy", point_env(), point_task(), model_episodes=2)


class Shaped(gymnasium.Env):
    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


LINE = spaces.Box(-1, 1, (1,))


@pytest.mark.parametrize(
    ("policy", "observations", "actions", "message"),
    [
        ("MultiInputPolicy", spaces.Dict({"x": LINE}), LINE, "observation has 1 entries"),
        ("MlpPolicy", spaces.Box(-1, 1, (2,)), LINE, "observation has 1 entries"),
        ("MlpPolicy", LINE, spaces.Box(-1, 1, (2,)), "action has 1 entries"),
    ],
)
def test_other_spaces_are_refused(point_agent, policy, observations, actions, message):
    with pytest.raises(ValueError, match=message):
        point_agent(Shaped(observations, actions), policy=policy)


def test_discrete_actions_are_refused_by_stable_baselines(point_agent):
    with pytest.raises(AssertionError, match=r"only supports.*Box.*Discrete"):
        point_agent(Shaped(LINE, spaces.Discrete(2)))


def test_a_wrong_reward_is_refused_before_it_is_used(point_agent):
    agent = point_agent(reward=lambda states, actions, next_states: -states[:, 0].square())
    with pytest.raises(ValueError, match=r"transition \d+ gave .* but the function says"):
        agent.learn(5)
    assert model_rows(agent) == 0


def test_terminations_that_were_not_told_are_refused(point_agent, point_env):
    with pytest.raises(ValueError, match="terminated=True, but none was given"):
        point_agent(point_env(end=-9)).learn(5)


def test_terminations_that_come_late_are_refused(point_agent, point_env):
    env = point_env()
    agent = point_agent(env).learn(5)
    env.unwrapped.end = -9
    with pytest.raises(ValueError, match="terminated=True, but none was given"):
        agent.learn(5, reset_num_timesteps=False)


def test_noisy_rewards_may_be_tolerated(point_agent, point_reward):
    def noisy(*transition):
        return 1.05 * point_reward(*transition)

    with pytest.raises(ValueError, match="raise reward_tolerance; None checks nothing"):
        point_agent(reward=noisy).learn(5)
    for tolerance in (0.1, None):
        assert point_agent(reward=noisy, reward_tolerance=tolerance).learn(5).num_episodes == 1


def test_a_time_limit_put_around_by_hand_is_read(point_agent):
    agent = point_agent(episode_length=None).learn(5)
    assert model_rows(agent) == 2 * 5


def test_several_environments_cannot_train_by_episodes(point_agent, point_env):
    with pytest.raises(ValueError, match=r"With 2 environments .*such as \(5, 'step'\)"):
        point_agent(DummyVecEnv([point_env] * 2)).learn(10)


def test_an_unknown_time_limit_is_refused(point_agent, point_env):
    with pytest.raises(ValueError, match=r"no time limit .*give the task an episode_length"):
        point_agent(point_env().unwrapped, episode_length=None).learn(5)


def test_a_model_without_starts_is_refused(point_agent):
    with pytest.raises(ValueError, match="initial_states"):
        point_agent().model_env(3)
    assert point_agent(initial_states=lambda n: torch.ones(n, 1)).model_env(3).reset().shape == (
        3,
        1,
    )


def test_states_that_are_no_numbers_never_reach_the_buffer(point_agent, point_dynamics):
    step = point_dynamics.sample

    def broken(states, actions):
        following = step(states, actions)
        following[0] = torch.nan
        return following

    point_dynamics.sample = broken
    agent = point_agent(model_episodes=3).learn(10)
    assert np.isfinite(agent.replay_buffer.model_buffer.next_observations).all()
    assert model_rows(agent) == 2 * (1 + 2 * 5)
    assert all(p.isfinite().all() for p in agent.policy.parameters())
