"""Reinforcement learning inside adjusted physics, on Stable-Baselines3 (the extra ``rl``)."""

try:
    import stable_baselines3 as _  # noqa: F401
except ImportError as error:
    raise ImportError(
        'gpadjust.rl needs Stable-Baselines3 and Gymnasium; run `pip install "gpadjust[rl]"`.'
    ) from error

from gpadjust.rl.actor_policy import actor_policy
from gpadjust.rl.agents import DynaSAC, DynaTD3
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.callbacks import DynaCallback
from gpadjust.rl.checkpoint import EpisodeCheckpoint, resume, save_checkpoint
from gpadjust.rl.dyna import Dyna
from gpadjust.rl.model_learner import ModelLearner
from gpadjust.rl.model_vec_env import ModelVecEnv
from gpadjust.rl.mpc_agent import MPCAgent
from gpadjust.rl.options import DynaOptions, ModelOptions
from gpadjust.rl.policy_search_agent import PolicySearchAgent

__all__ = [
    "Dyna",
    "DynaCallback",
    "DynaOptions",
    "DynaSAC",
    "DynaTD3",
    "EpisodeCheckpoint",
    "MPCAgent",
    "MixedReplayBuffer",
    "ModelLearner",
    "ModelOptions",
    "ModelVecEnv",
    "PolicySearchAgent",
    "actor_policy",
    "resume",
    "save_checkpoint",
]
