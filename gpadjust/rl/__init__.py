"""Reinforcement learning inside adjusted physics, on Stable-Baselines3 (the extra ``rl``)."""

try:
    import stable_baselines3 as _  # noqa: F401
except ImportError as error:
    raise ImportError(
        'gpadjust.rl needs Stable-Baselines3 and Gymnasium; run `pip install "gpadjust[rl]"`.'
    ) from error

from gpadjust.rl.callbacks import DynaCallback
from gpadjust.rl.checkpoint import TrialCheckpoint, resume, save_checkpoint
from gpadjust.rl.dyna_sac import DynaSAC
from gpadjust.rl.informative_trials import InformativeTrials, TrialPlan
from gpadjust.rl.mixed_replay_buffer import MixedReplayBuffer
from gpadjust.rl.model_vec_env import ModelVecEnv

__all__ = [
    "DynaCallback",
    "DynaSAC",
    "InformativeTrials",
    "MixedReplayBuffer",
    "ModelVecEnv",
    "TrialCheckpoint",
    "TrialPlan",
    "resume",
    "save_checkpoint",
]
