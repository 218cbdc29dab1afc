"""What Dyna refuses."""

import gymnasium
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from gpadjust.dynamics import StateSpec
from gpadjust.rl import DynaSAC
from tests.rl.conftest import model_rows

POINT_SPEC = StateSpec(["x"], ["v"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_steps": 3}, "no n-step returns; found n_steps=3"),
        ({"replay_buffer_class": dict}, "must be MixedReplayBuffer .*found dict"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        ({"real_fraction": 2}, "real_fraction must be .*; found 2"),
        ({"updates_per_model_step": float("inf")}, "updates_per_model_step must be .*; found inf"),
        ({"state_bounds": torch.ones(2, 4)}, r"state_bounds must be of shape 2 x 1"),
        ({"state_bounds": torch.tensor([[1.0], [-1.0]])}, "below its upper one; found"),
        ({"model_buffer_size": -1}, "model_buffer_size must be at least 1; found -1"),
        ({"model_episodes": -1}, "model_episodes must be at least 0; found -1"),
        ({"updates_per_model_step": -0.5}, "updates_per_model_step must be .*; found -0.5"),
        ({"updates_per_model_step": float("nan")}, "updates_per_model_step must be .*; found nan"),
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
    agent = point_agent(initial_states=lambda n: torch.ones(n, 1))
    assert agent.model_env(3).reset().shape == (3, 1)
