"""Reinforcement learning inside adjusted physics, on Stable-Baselines3 (the extra ``rl``)."""

from gpadjust.rl.callbacks import DynaCallback
from gpadjust.rl.checkpoint import TrialCheckpoint, resume, save_checkpoint
from gpadjust.rl.dyna_sac import DynaSAC
from gpadjust.rl.mixed_replay_buffer import MixedReplayBuffer
from gpadjust.rl.model_vec_env import ModelVecEnv

__all__ = [
    "DynaCallback",
    "DynaSAC",
    "MixedReplayBuffer",
    "ModelVecEnv",
    "TrialCheckpoint",
    "resume",
    "save_checkpoint",
]
