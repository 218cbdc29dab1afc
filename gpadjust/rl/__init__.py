"""Reinforcement learning inside adjusted physics, on Stable-Baselines3 (the extra ``rl``)."""

try:
    import stable_baselines3 as _
except ImportError as error:
    raise ImportError(
        'gpadjust.rl needs Stable-Baselines3 and Gymnasium; run `pip install "gpadjust[rl]"`.'
    ) from error

from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.dyna import Dyna, DynaSAC, DynaTD3
from gpadjust.rl.model_vec_env import ModelVecEnv
from gpadjust.rl.options import DynaOptions

__all__ = [
    "Dyna",
    "DynaOptions",
    "DynaSAC",
    "DynaTD3",
    "ModelVecEnv",
]
