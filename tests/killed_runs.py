"""A run that can be killed at any moment, goes on from what is on the disk, and writes its results.

A process is forked for it from one that has imported all this.
"""

import gymnasium
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import EpisodeCheckpoint, Task, resume
from gpadjust.control.episodes import generators
from gpadjust.dynamics import LearnedDynamics
from gpadjust.rl import DynaOptions, DynaSAC
from tests.control.conftest import KINDS as AGENTS
from tests.control.conftest import Kind
from tests.point import POINT_SPEC, Faulty, Point, near_one

TOTAL = 25  # steps, of episodes of five where none fails
FAILS = {8: "raises", 16: "nan", 23: "reward 1e30"}
DYNA = {
    "policy": "MlpPolicy",
    "options": DynaOptions(model_episodes=2, score_horizons=()),
    "batch_size": 8,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8], "optimizer_kwargs": {"fused": True}},
}
KINDS = {
    **AGENTS,
    DynaSAC: Kind(DYNA, learnt=lambda agent: [agent.get_parameters(), agent.env.obs_rms.mean]),
}


def reward(states, actions, next_states):
    return -next_states[:, 0].square()


def go(kind, folder):
    """Begin a run of an agent, or go on with it."""
    torch.set_num_threads(1)
    folder.mkdir(exist_ok=True)
    path, point = folder / "run.ckpt", Faulty(gymnasium.wrappers.TimeLimit(Point(), 5), FAILS)
    fit = {"method": "map"}
    dynamics = LearnedDynamics(POINT_SPEC, lambda X: X[:, :1] + 0.4 * X[:, 1:], fit_options=fit)
    env, task, call = point, Task(dynamics, reward, episode_length=5), {}
    if kind is DynaSAC:
        env, call = VecNormalize(DummyVecEnv([lambda: point])), {"reset_num_timesteps": False}
        task = Task(dynamics, reward, initial_states=near_one, episode_length=5)
    if path.exists():
        agent = resume(path, env, task)
    else:
        agent = kind(env=env, task=task, seed=0, **KINDS[kind].options)
    agent.learn(TOTAL - agent.num_timesteps, EpisodeCheckpoint(path), **call)
    recorded = agent.recorded_episodes()
    found = {
        "episodes": [recorded.states, recorded.actions, recorded.rewards, recorded.episode],
        "dynamics": agent.task.dynamics.state_dict(),
        "learnt": KINDS[kind].learnt(agent),
        "counts": [
            agent.num_timesteps,
            agent.num_episodes,
            getattr(agent, "promised_reward", None),
        ],
        "random": generators(),
    }
    torch.save(found, folder / "found.pt")
