"""The environments of Stable-Baselines3: guarded, and in checkpoints."""

from __future__ import annotations

import cloudpickle
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from gpadjust.control import StepGuard
from gpadjust.control.checkpoint import pickled_environment, warn_unsaved

_OF_ALL = ("venv", "envs", "class_attributes", "observation_space", "action_space", "metadata")


def guarded(env: VecEnv) -> VecEnv:
    """A vectorised environment in which each one that is in this process has a guard."""
    inner = _layers(env)[-1]
    if isinstance(inner, DummyVecEnv):
        inner.envs = [StepGuard.around(each) for each in inner.envs]
    return env


def environment_state(env: VecEnv) -> bytes:
    """The pickled state of the environment; of its wrappers alone, if it cannot be pickled."""
    layers = _layers(env)
    inner = layers[-1]
    kept = [
        {name: value for name, value in vars(layer).items() if name not in _OF_ALL}
        for layer in layers
    ]
    if isinstance(inner, DummyVecEnv):
        content = pickled_environment((kept, inner.envs))
    else:
        content = None
        warn_unsaved(f"a {type(inner).__name__} keeps its environments elsewhere")
    return bytes(cloudpickle.dumps((kept[:-1], None))) if content is None else content


def restore_environment(env: VecEnv, content: bytes) -> bool:
    """Set the state of the environment, and return whether it was saved; else it is to be reset."""
    kept, envs = cloudpickle.loads(content)
    layers = _layers(env)
    for layer, attributes in zip(layers, kept, strict=envs is not None):
        vars(layer).update(attributes)
    if envs is not None:
        assert isinstance(layers[-1], DummyVecEnv), "as described"
        layers[-1].envs = envs
    return envs is not None


def _layers(env: VecEnv) -> list[VecEnv]:
    """A vectorised environment and what it wraps, from the outside."""
    layers = [env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers
