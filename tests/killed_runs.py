"""Runs that can be killed at any moment, go on from what is on the disk, and write what they found.

Each is a function of a folder; `RUNS` has them by name. A process is forked for each from one that
has imported all this.
"""

import gymnasium
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import (
    EpisodeCheckpoint,
    MPCAgent,
    Planner,
    PolicySearch,
    PolicySearchAgent,
    Task,
    resume,
)
from gpadjust.control.episodes import generators
from gpadjust.dynamics import LearnedDynamics
from gpadjust.rl import DynaOptions, DynaSAC
from tests.point import POINT_SPEC, Faulty, Point, linear, near_one

TOTAL = 40  # steps, of episodes of five where none fails
FAILS = {8: "raises", 16: "nan", 23: "reward 1e30"}
PLAN = Planner(rounds=1, horizon=3, num_random=32, max_hold=1)


def reward(states, actions, next_states):
    return -next_states[:, 0].square()


def point(**parts):
    """The point, some of whose steps fail, and its task."""
    env = Faulty(gymnasium.wrappers.TimeLimit(Point(), 5), FAILS)
    fit = {"method": "map"}
    dynamics = LearnedDynamics(POINT_SPEC, lambda X: X[:, :1] + 0.4 * X[:, 1:], fit_options=fit)
    return env, Task(dynamics, reward, episode_length=5, **parts)


def write(agent, folder, learnt):
    """What the agent has learnt, and what its generators draw next."""
    recorded = agent.recorded_episodes()
    found = {
        "episodes": [recorded.states, recorded.actions, recorded.rewards, recorded.episode],
        "dynamics": agent.task.dynamics.state_dict(),
        "learnt": learnt,
        "counts": [agent.num_timesteps, agent.num_episodes],
        "random": generators(),
    }
    torch.save(found, folder / "found.pt")


def planned(folder):
    """An agent that plans."""
    path, (env, task) = folder / "run.ckpt", point()
    if path.exists():
        agent = resume(path, env, task)
    else:
        agent = MPCAgent(env, task, PLAN, first=PLAN, seed=0)
    agent.learn(TOTAL - agent.num_timesteps, EpisodeCheckpoint(path))
    write(agent, folder, agent.promised_reward)


def searched(folder):
    """An agent that improves a policy, and acts at random until it knows a start."""
    path, (env, task) = folder / "run.ckpt", point()
    if path.exists():
        agent = resume(path, env, task)
    else:
        search = PolicySearch(updates=12, num_starts=6, num_functions=2, learning_rate=0.05)
        agent = PolicySearchAgent(env, task, linear, search, seed=0)
    agent.learn(TOTAL - agent.num_timesteps, EpisodeCheckpoint(path))
    write(agent, folder, agent.policy.state_dict())


def trained(folder):
    """A learner of Stable-Baselines3, in a normalised environment."""
    path, (env, task) = folder / "run.ckpt", point(initial_states=near_one)
    env = VecNormalize(DummyVecEnv([lambda: env]))
    if path.exists():
        agent = resume(path, env, task)
    else:
        options = DynaOptions(model_episodes=2, score_horizons=())
        networks = {"policy_kwargs": {"net_arch": [8], "optimizer_kwargs": {"fused": True}}}
        agent = DynaSAC(
            "MlpPolicy", env, task, options, batch_size=8, seed=0, device="cpu", **networks
        )
    left = TOTAL - agent.num_timesteps
    agent.learn(left, EpisodeCheckpoint(path), reset_num_timesteps=False)
    write(agent, folder, [agent.get_parameters(), agent.env.obs_rms.mean])


RUNS = {each.__name__: each for each in (planned, searched, trained)}


def go(name, folder):
    """Begin a run, or go on with it."""
    torch.set_num_threads(1)
    folder.mkdir(exist_ok=True)
    RUNS[name](folder)
