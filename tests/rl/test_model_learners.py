"""Agents that plan, and agents whose policy is searched for, in the same loop as Dyna's."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise

from gpadjust.control import CrossEntropy, Planner, PolicySearch, Task
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.models import ZeroMeanGP
from gpadjust.rl import (
    EpisodeCheckpoint,
    ModelOptions,
    MPCAgent,
    PolicySearchAgent,
    resume,
)

pytestmark = pytest.mark.filterwarnings("ignore:A step of the last real episode")
QUICK = {"method": "map", "num_starts": 1, "num_screened": 0}
PLAN = Planner(search=CrossEntropy(1), horizon=3, num_random=32, max_hold=1)
SEARCH = PolicySearch(updates=12, num_starts=6, num_functions=2, learning_rate=0.05)
KINDS = [MPCAgent, PolicySearchAgent]


@pytest.fixture
def dynamics(point_dynamics):
    def make(physics=lambda X: X[:, :1] + 0.4 * X[:, 1:], **options):
        return LearnedDynamics(point_dynamics.spec, physics, fit_options=QUICK, **options)

    return make


@pytest.fixture
def make_agent(point_env, point_task, dynamics):
    """An agent of either kind for the point."""

    def make(kind, env=None, options=None, **given):
        parts = {"dynamics": dynamics(), "initial_states": near_one}
        names = {"dynamics", "reward", "initial_states", "state_bounds"} & {*given}
        task = point_task(**{**parts, **{name: given.pop(name) for name in names}})
        env = point_env() if env is None else env
        options = options or ModelOptions(score_horizons=())
        common = {"options": options, "seed": 0, "device": "cpu", "buffer_size": 500, **given}
        if kind is MPCAgent:
            return MPCAgent(env, task, PLAN, first=PLAN, **common)
        return PolicySearchAgent("linear", env, task, SEARCH, **common)

    return make


def near_one(n):
    return 0.5 + torch.rand(n, 1, dtype=torch.float64)


class PowerCutError(Exception):
    pass


def cut_at(step):
    def callback(local, _):
        if local["self"].num_timesteps == step:
            raise PowerCutError
        return True

    return callback


@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_the_system_and_brings_the_point_home(make_agent, kind, point_env):
    agent = make_agent(kind).learn(15)
    assert agent.num_episodes == 3
    assert agent.task.dynamics.num_transitions == 15
    mean, _ = evaluate_policy(agent, point_env(), n_eval_episodes=2, warn=False)
    assert mean > -1.0  # to stay costs some 5


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_episode_goes_by_the_physics(make_agent, kind):
    """Of the point's real cost the physics, a fifth too weak, saves most."""
    agent = make_agent(kind).learn(5)
    assert agent.recorded_episodes().rewards.sum() > -1.5


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_physics_the_first_episode_is_random(make_agent, kind, dynamics):
    agent = make_agent(kind, dynamics=dynamics(None, model=ZeroMeanGP))
    with pytest.raises(RuntimeError, match="knows nothing") if kind is MPCAgent else no_error():
        agent.predict(np.ones(1, dtype=np.float32))
    agent.learn(5)
    actions = agent.recorded_episodes().actions
    assert actions.unique().numel() > 1
    agent.learn(5, reset_num_timesteps=False)
    assert agent.recorded_episodes().num_transitions == 10


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_episodes_can_be_random(make_agent, kind):
    """Two episodes of five steps begin before the sixth step; the third is brought home."""
    agent = make_agent(kind, random_steps=6).learn(15)
    rewards = agent.recorded_episodes().rewards.reshape(3, 5).sum(1)
    assert rewards[:2].max() < -2 < rewards[2]
    agent.learn(5)
    assert agent.recorded_episodes(newest=5).rewards.sum() > -2  # random no more
    for wrong, error in ((-1, ValueError), (1.5, TypeError)):
        with pytest.raises(error, match="random_steps must be"):
            make_agent(kind, random_steps=wrong)


def no_error():
    from contextlib import nullcontext

    return nullcontext()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step", [7, pytest.param(11, marks=pytest.mark.slow)])
def test_an_interrupted_run_ends_as_another(make_agent, kind, step, tmp_path, tensors_of):
    path = tmp_path / "run.ckpt"
    whole = make_agent(kind).learn(15)
    with pytest.raises(PowerCutError):
        make_agent(kind).learn(15, callback=[EpisodeCheckpoint(path), as_callback(cut_at(step))])
    fresh = make_agent(kind)
    agent = resume(path, fresh.get_env(), fresh.task, algorithm=kind)
    agent.learn(15 - agent.num_timesteps, EpisodeCheckpoint(path), reset_num_timesteps=False)
    expected, found = tensors_of(whole), tensors_of(agent)
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        same = torch.equal(value, found[name]) if torch.is_tensor(value) else value == found[name]
        assert same, name


def test_two_environments_go_on_within_their_plans(make_agent, point_env, tmp_path, tensors_of):
    """Checkpoints lie in the middle of episodes, which go on by the plans that they had."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    def make():
        env = DummyVecEnv([point_env, point_env])
        return make_agent(MPCAgent, env, train_freq=(3, "step"))

    path = tmp_path / "run.ckpt"
    whole = make().learn(36)
    with pytest.raises(PowerCutError):
        make().learn(36, callback=[EpisodeCheckpoint(path), as_callback(cut_at(28))])
    fresh = make()
    agent = resume(path, fresh.get_env(), fresh.task)
    assert agent.num_timesteps == 24
    assert [episode.steps_done for episode in agent.planned.under_way.values()] == [2, 2]
    agent.learn(12, reset_num_timesteps=False)
    expected, found = tensors_of(whole), tensors_of(agent)
    for name, value in expected.items():
        same = torch.equal(value, found[name]) if torch.is_tensor(value) else value == found[name]
        assert same, name


def as_callback(function):
    from stable_baselines3.common.callbacks import ConvertCallback

    return ConvertCallback(function)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_saved_and_loaded(make_agent, kind, tmp_path):
    agent = make_agent(kind).learn(5)
    agent.save(tmp_path / "agent.zip")
    fresh = make_agent(kind)
    loaded = kind.load(tmp_path / "agent.zip", env=fresh.get_env(), task=fresh.task)
    seen = np.array([0.7], dtype=np.float32)
    actions = [each.predict(seen, deterministic=True)[0] for each in (agent, loaded)]
    np.testing.assert_array_equal(*actions)
    loaded.learn(5, reset_num_timesteps=False)
    assert loaded.task.dynamics.num_transitions > 5


@pytest.mark.parametrize("kind", KINDS)
def test_an_error_loses_no_episode(make_agent, kind, point_reward):
    agent = make_agent(kind, reward=lambda s, a, n: -3 * n[:, 0].square())
    with pytest.raises(ValueError, match="is not the environment's"):
        agent.learn(5)
    agent.task = replace(agent.task, reward=point_reward)
    agent.learn(5, reset_num_timesteps=False)
    assert agent.task.dynamics.num_transitions == 10


def test_noise_explores(make_agent):
    noise = NormalActionNoise(np.zeros(1), 0.5 * np.ones(1))
    plain, noisy = (make_agent(MPCAgent, action_noise=each).learn(5) for each in (None, noise))
    assert not torch.equal(plain.recorded_episodes().actions, noisy.recorded_episodes().actions)
    assert noisy.recorded_episodes().actions.abs().max() <= 2


def test_several_environments(make_agent, point_env):
    from stable_baselines3.common.vec_env import DummyVecEnv

    env = DummyVecEnv([point_env, point_env])
    agent = make_agent(MPCAgent, env, train_freq=(5, "step")).learn(20)
    assert agent.num_episodes == 4


def test_promises_that_are_not_kept_are_told(make_agent):
    """The physics says that any action helps, but the system goes the other way."""

    def wrong(X):
        return X[:, :1] - 0.9 * X[:, 1:]

    known = make_agent(MPCAgent).task.dynamics.spec
    agent = make_agent(
        PolicySearchAgent, dynamics=PhysicsDynamics(known, wrong), options=ModelOptions()
    )
    with pytest.warns(UserWarning, match="where the model promised .* do not trust"):
        agent.learn(5)


def test_a_promise_that_data_made_against_the_physics_is_told(make_agent, dynamics):
    """After an episode the model knows that the point moves some ten times as far."""
    known = dynamics(lambda X: X[:, :1] + 0.05 * X[:, 1:])
    agent = make_agent(PolicySearchAgent, dynamics=known, options=ModelOptions()).learn(5)
    agent.promise = 10.0
    with pytest.warns(UserWarning, match="In 100% of its predictions data had overridden the phys"):
        agent.learn(5, reset_num_timesteps=False)
    assert agent.logger.name_to_value["model/overrides"] == 1


def test_observations_in_another_order_cost_no_episode():
    from gymnasium.wrappers import TransformObservation

    from gpadjust.systems import CartPoleSwingUpEnv, cart_pole
    from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward

    env = CartPoleSwingUpEnv()
    order = [0, 3, 1, 2, 4]
    shuffled = TransformObservation(env, lambda seen: seen[order], env.observation_space)
    task = Task(
        LearnedDynamics(CART_POLE_SPEC, cart_pole(0).physics),
        cart_pole_reward,
        episode_length=25,
    )
    agent = MPCAgent(shuffled, task, PLAN, first=PLAN, seed=0)
    with pytest.raises(ValueError, match="sine and cosine of the angle 'theta'"):
        agent.learn(25)
    assert agent.num_timesteps == 0


def test_a_search_reports_where_sb3_prints(make_agent, capsys):
    make_agent(PolicySearchAgent, verbose=1).learn(5)
    said = capsys.readouterr().out
    assert "policy search: update 12 of 12, value" in said
    make_agent(PolicySearchAgent).learn(5)
    assert "policy search" not in capsys.readouterr().out


def test_what_is_promised_and_found_is_logged(make_agent):
    agent = make_agent(PolicySearchAgent).learn(10)
    found = agent.logger.name_to_value
    assert {"model/real_reward", "model/promised_reward", "model/search_left_bounds"} <= {*found}


@pytest.mark.parametrize("kind", KINDS)
def test_the_promise_is_of_the_episode_that_was_learnt(make_agent, kind):
    """Also where the policy was improved since, and promises something else of the next one."""
    agent = make_agent(kind)
    agent.first = replace(PLAN, horizon=None)  # of an agent that plans
    for _ in range(2):
        agent.learn(5, reset_num_timesteps=False)
        logged = agent.logger.name_to_value
        assert agent.promised_reward == logged["model/promised_reward"]
    if kind is PolicySearchAgent:
        assert agent.promise != agent.promised_reward


def test_a_controller_is_made_once_an_episode(make_agent, monkeypatch):
    made = []
    task = MPCAgent.model_task
    monkeypatch.setattr(MPCAgent, "model_task", lambda self: made.append(1) or task(self))
    agent = make_agent(MPCAgent).learn(10)
    state, before = agent.mpc, len(made)
    for _ in range(3):
        agent.predict(np.array([0.5]))
    assert len(made) == before <= 6  # two episodes, of which each is learnt, too
    assert agent.mpc is state
    agent.tolerance = None
    assert agent.mpc.tolerance is None


def test_plans_that_leave_the_bounds_are_told(make_agent, dynamics):
    bounds = torch.tensor([[-2.0], [2.0]], dtype=torch.float64)
    away = dynamics(lambda X: X[:, :1] + 3.0)
    agent = make_agent(MPCAgent, dynamics=away, state_bounds=bounds)
    with pytest.warns(
        UserWarning, match="leaves the bounds of the states in 100% of the functions"
    ):
        agent.learn(2)
    assert agent.logger.name_to_value["model/plan_left_bounds"] == 1


def test_policies_that_leave_the_bounds_are_told(make_agent):
    bounds = torch.tensor([[0.99], [1.01]], dtype=torch.float64)
    agent = make_agent(
        PolicySearchAgent, state_bounds=bounds, initial_states=lambda n: torch.ones(n, 1).double()
    )
    with pytest.warns(UserWarning, match="left the bounds of the states in the model"):
        agent.learn(5)


def test_bad_arguments_are_refused(point_env, point_task):
    with pytest.raises(ValueError, match="no policy 'Mlp', but there are mlp, linear, rbf"):
        PolicySearchAgent("Mlp", point_env(), point_task())
    with pytest.raises(TypeError, match=r"search must be a PolicySearch\(...\); found 3"):
        PolicySearchAgent("mlp", point_env(), point_task(), 3)
    with pytest.raises(ValueError, match="MPCAgent needs a task to learn"):
        MPCAgent(point_env(), None)
    with pytest.raises(TypeError, match=r"options must be ModelOptions\(...\); found 1"):
        MPCAgent(point_env(), point_task(), options=1)


@pytest.mark.slow
def test_the_cart_pole_swings_up_in_two_trials():
    from gpadjust.systems import cart_pole
    from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward

    env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
    f_p = cart_pole(3).physics
    task = Task(LearnedDynamics(CART_POLE_SPEC, f_p), cart_pole_reward)
    agent = MPCAgent(env, task, seed=3).learn(50)
    assert agent.recorded_episodes(newest=25).rewards.mean() > -0.45


def test_several_environments_explore_by_noise_of_their_own(make_agent, point_env):
    from stable_baselines3.common.vec_env import DummyVecEnv

    env = DummyVecEnv([point_env, point_env])
    noise = NormalActionNoise(np.zeros(1), 0.5 * np.ones(1))
    agent = make_agent(MPCAgent, env, train_freq=(5, "step"), action_noise=noise).learn(20)
    first, second = agent.recorded_episodes().actions.reshape(2, -1)
    assert not torch.equal(first, second)


def test_a_searched_policy_sees_what_is_not_normalised(make_agent, point_env):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    agent = make_agent(PolicySearchAgent, VecNormalize(DummyVecEnv([point_env])))
    agent.learn(15)
    episodes = agent.recorded_episodes(newest=1)
    with torch.no_grad():
        before = agent.policy.module(episodes.next_states)
    env = agent.get_vec_normalize_env()
    seen = env.normalize_obs(episodes.next_states.numpy())
    action, _ = agent.predict(seen, deterministic=True)
    np.testing.assert_allclose(action, before.numpy(), atol=1e-4)


def test_promises_are_of_the_steps_that_are_made_and_of_no_random_ones(make_agent, point_task):
    """Each step costs 1 until the point is home, which ends the episode; no warning is given."""
    agent = make_agent(
        MPCAgent,
        reward=lambda states, actions, next_states: -torch.ones(len(states)).double(),
        options=ModelOptions(reward_tolerance=None, score_horizons=()),
    )
    agent.task = replace(agent.task, terminated=lambda states: states[:, 0].abs() < 0.5)
    agent.first = replace(PLAN, horizon=None)
    agent.learn(5)
    assert agent.promised_reward == pytest.approx(-1)
    random = make_agent(PolicySearchAgent, random_steps=20, options=ModelOptions())
    random.learn(15)
    assert "model/promised_reward" not in random.logger.name_to_value


def test_what_has_no_effect_is_refused(make_agent):
    for option, value in {"learning_starts": 9, "gradient_steps": 7, "learning_rate": 1.0}.items():
        with pytest.raises(TypeError, match=f"MPCAgent has no {option}, .* give .* instead"):
            make_agent(MPCAgent, **{option: value})
    with pytest.raises(ValueError, match=r"computes on the CPU, .* found device 'cuda'"):
        make_agent(PolicySearchAgent, device="cuda")
    with pytest.raises(TypeError, match=r"first must be a Planner\(\.\.\.\); found 3"):
        MPCAgent(None, None, first=3)
    with pytest.raises(TypeError, match=r"policy must be one of 'mlp', .* found a Linear"):
        PolicySearchAgent(torch.nn.Linear(1, 1), None)


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_knows_its_class(make_agent, kind, tmp_path):
    path = tmp_path / "run.ckpt"
    agent = make_agent(kind).learn(5, EpisodeCheckpoint(path))
    assert type(resume(path, agent.get_env(), make_agent(kind).task)) is kind


def test_a_searched_policy_is_saved_by_itself(make_agent, tmp_path):
    policy = make_agent(PolicySearchAgent).learn(5).policy
    policy.save(tmp_path / "policy.zip")
    again = type(policy).load(tmp_path / "policy.zip", device="cpu")
    seen = np.array([0.4], dtype=np.float32)
    assert np.array_equal(again.predict(seen)[0], policy.predict(seen)[0])


def test_a_planner_that_was_loaded_says_what_it_needs(make_agent, tmp_path):
    agent = make_agent(MPCAgent).learn(5)
    agent.save(tmp_path / "agent.zip")
    again = MPCAgent.load(tmp_path / "agent.zip", task=replace(agent.task, episode_length=None))
    with pytest.raises(ValueError, match="give the task an episode_length, or the agent an env"):
        again.predict(np.ones(1, dtype=np.float32))
