"""What is refused before a real step is made."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC, TD3

from gpadjust.control import EpisodeCheckpoint
from gpadjust.dynamics import LearnedDynamics
from gpadjust.physics import PhysicsError
from gpadjust.rl import Dyna, DynaSAC
from tests.point import POINT_SPEC

LINE, PLANE = spaces.Box(-1, 1, (1,)), spaces.Box(-1, 1, (2,))


def shaped(observation_space, action_space=LINE):
    env = gymnasium.Env()
    env.observation_space, env.action_space = observation_space, action_space
    return {"env": env}


def stepped(particles):
    particles.reset()
    particles.step(np.ones((3, 1), dtype=np.float32))


OPTIONS = [
    ({"n_steps": 3}, "no n-step returns; found n_steps=3"),
    ({"optimize_memory_usage": True}, "optimize_memory_usage"),
    ({"real_fraction": 2}, "real_fraction must be .*; found 2"),
    ({"updates_per_model_step": float("inf")}, "updates_per_model_step must be .*; found inf"),
    ({"model_episodes": 2.5}, "model_episodes must be a whole number; found 2.5"),
    ({"last_model_episode": -1}, "last_model_episode must be at least 0; found -1"),
    ({"num_particles": 0}, "num_particles must be at least 1; found 0"),
    ({"sampling": "swarm"}, "Unknown sampling 'swarm'"),
    ({"refresh_model_data": 1}, "refresh_model_data must be True or False; found 1"),
    ({"reward_tolerance": "no"}, "reward_tolerance must be a number; found 'no'"),
    ({"gradient_steps": 0}, "gradient_steps"),
    ({"policy": "MultiInputPolicy", **shaped(spaces.Dict({"x": LINE}))}, "has 1 entri"),
    (shaped(PLANE), "observation has 1 entries"),
    (shaped(LINE, PLANE), "action has 1 entries"),
    (shaped(LINE, spaces.Discrete(2)), r"only supports.*Box.*Discrete"),
]
CALLS = [
    (lambda at: DynaSAC("MlpPolicy", at.env(), at.task().dynamics), r"must be a Task\(dynamics,"),
    (lambda at: DynaSAC("MlpPolicy", at.env(), at.task(), model_episodes=2), "'model_episodes'"),
    (lambda at: type("Other", (TD3, Dyna), {}), r"Dyna first .* class Other\(Dyna, .* found TD3"),
    (lambda at: type("Other", (Dyna, PPO), {}), "then an off-policy learner, .* found PPO"),
    (lambda at: at.agent(at.env().unwrapped, episode_length=None).learn(5), "no time limit"),
    (lambda at: at.agent(use_sde=True).learn(5, at.checkpoint), "cannot resume use_sde=True"),
    (lambda at: at.sac().learn(5, at.checkpoint), "is for learners with a model"),
    (lambda at: at.agent().model_env(3), "initial_states"),
    (lambda at: at.agent().predict(np.array([np.nan], dtype=np.float32)), "No action can be chos"),
    (lambda at: at.particles(observation_space=PLANE), "observation has 1 entries"),
    (lambda at: at.particles(num_envs=0), "num_envs must be at least 1; found 0"),
    (lambda at: at.particles(initial_states=None), "needs a task with initial_states"),
    (
        lambda at: stepped(at.particles(initial_states=torch.zeros)),
        r"initial_states\(3\) must return .* 3 x 1; found \(3,\)",
    ),
    (lambda at: stepped(at.particles(reward=lambda s, a, n: n[:, 0] / 0)), "reward.*inf"),
]
FUNCTIONS = [
    ({"initial_states": lambda n: torch.ones(n)}, r"initial_states\(2\) must return .* 2 x 1"),
    (
        {"initial_states": lambda n: torch.full((n, 1), torch.nan)},
        r"initial_states\(2\) returned .*expected finite",
    ),
    ({"reward": lambda s, a, n: n}, r"reward must return one value per row, shape \(2,\)"),
    ({"terminated": lambda s: s}, r"terminated must return one value per row"),
    ({"dynamics": LearnedDynamics(POINT_SPEC, lambda X: X)}, "1 states .* got 2 columns"),
]


@pytest.mark.parametrize(("options", "words"), OPTIONS)
def test_an_option_is_refused(point_agent, options, words):
    with pytest.raises((TypeError, ValueError, AssertionError), match=words):
        point_agent(**options)


@pytest.mark.parametrize(("call", "words"), CALLS)
def test_a_call_is_refused(
    point_agent, point_env, point_task, point_particles, tmp_path, call, words
):
    path = tmp_path / "run.ckpt"
    at = SimpleNamespace(agent=point_agent, env=point_env, task=point_task)
    at.particles, at.checkpoint = point_particles, EpisodeCheckpoint(path)
    at.sac = lambda: SAC("MlpPolicy", point_env(), policy_kwargs={"net_arch": [8]})
    with pytest.raises((TypeError, ValueError), match=words):
        call(at)
    assert not path.exists()


@pytest.mark.parametrize(("parts", "words"), FUNCTIONS)
def test_wrong_functions_are_found_before_the_first_real_step(point_agent, parts, words):
    agent = point_agent(**parts)
    with pytest.raises((ValueError, PhysicsError), match=words):
        agent.learn(5)
    assert agent.num_timesteps == 0


def test_noisy_rewards_may_be_tolerated(point_agent, point_reward):
    def noisy(*transition):
        return 1.05 * point_reward(*transition)

    with pytest.raises(ValueError, match="raise reward_tolerance; None checks nothing"):
        point_agent(reward=noisy).learn(5)
    for tolerance in (0.1, None):
        assert point_agent(reward=noisy, reward_tolerance=tolerance).learn(5).num_episodes == 1
