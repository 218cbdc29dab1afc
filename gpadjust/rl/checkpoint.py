"""Checkpoints from which a run goes on exactly as if nothing had happened."""

from __future__ import annotations

import io
import json
import os
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
from filelock import AcquireReturnProxy, FileLock, Timeout
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from gpadjust.control import Task
from gpadjust.files import sync_folder
from gpadjust.rl.buffer import CompactReplayBuffer
from gpadjust.rl.model_learner import ModelLearner
from gpadjust.rl.random_state import RandomState

_FORMAT = "gpadjust episode checkpoint, version 2"
_OF_ALL = ("venv", "envs", "class_attributes", "observation_space", "action_space", "metadata")
_BUFFERS = ("replay_buffer", "model_buffer")


class EpisodeCheckpoint(BaseCallback):
    """Writes the whole state of a Dyna run after each episode; :func:`resume` goes on.

    The file holds networks and optimisers, both buffers, what the dynamics learnt, the state of the
    environment, and all random generators, so that an interrupted run ends with the same weights,
    bit for bit, as one that was not (on the same machine and versions). It is replaced atomically:
    whenever the process dies, a whole checkpoint is on the disk. While it learns, a run holds a
    lock beside the file (``.lock``): another run that would write there is refused.

    Callbacks keep their own state: it is not in the file, unless they write it into
    ``agent.notes``. One that draws random numbers (an ``EvalCallback`` with
    ``deterministic=False``) or counts steps begins anew, and may so change what follows.

    The environment must be picklable for this; one that is not (a real robot) is reset when the
    run goes on, which is then another run, and a warning says so; wrappers such as
    ``VecNormalize`` keep their statistics.

    Args:
        path: The file.
        every: Number of rollouts (episodes, unless ``train_freq`` says otherwise) between two
            checkpoints.

    Raises:
        ValueError: If ``every`` is not positive.
        RuntimeError: When learning starts, if another run writes to this file.

    Example:
        >>> checkpoint = EpisodeCheckpoint("run.ckpt")  # agent.learn(1250, callback=checkpoint)
        >>> # after an interruption: agent = resume("run.ckpt", env, task)
        >>> # agent.learn(1250 - agent.num_timesteps, checkpoint, reset_num_timesteps=False)
    """

    model: ModelLearner

    def __init__(self, path: str | Path, every: int = 1) -> None:
        if every < 1:
            raise ValueError(f"every must be at least 1; found {every}.")
        super().__init__()
        self.path = Path(path).absolute()
        self.every = every
        self._rollouts = 0

    def _init_callback(self) -> None:
        if not isinstance(self.model, ModelLearner):
            raise TypeError(
                "EpisodeCheckpoint is for learners with a model, such as DynaSAC; found "
                f"{type(self.model).__name__}."
            )
        if self.model.use_sde:
            raise ValueError(
                "EpisodeCheckpoint cannot resume generalised state-dependent exploration exactly; "
                f"use {type(self.model).__name__} with use_sde=False."
            )
        self.model.held.enter_context(_locked(self.path))

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # The updates of the last episode are done, and the next has not begun.
        if self._rollouts % self.every == 0:
            _write(self.model, self.path)
        self._rollouts += 1

    def _on_training_end(self) -> None:
        if self.model.num_timesteps >= self.model._total_timesteps:
            _write(self.model, self.path)
        # Otherwise a callback stopped the run within an episode.


def save_checkpoint(agent: ModelLearner, path: str | Path) -> None:
    """Write the state of a run between two episodes to a file, atomically; see :func:`resume`.

    Raises:
        RuntimeError: If a run writes to this file.
    """
    with _locked(Path(path)):
        _write(agent, Path(path))


def _write(agent: ModelLearner, path: Path) -> None:
    saved = io.BytesIO()
    agent.save(saved)
    env = agent.get_env()
    assert env is not None, "an agent that learnt has one"
    environment = _environment_state(env)
    manifest = {
        "format": _FORMAT,
        "algorithm": type(agent).__name__,
        "environment": _described(env),
        "task": None if agent.task is None else agent.task.describe(),
        "num_new": agent.replay_buffer.num_new,
        "num_ended": agent.replay_buffer.num_ended,
        "action_space": agent.action_space.np_random.bit_generator.state,
    }
    parts = {
        "manifest.json": json.dumps(manifest, default=_plain).encode(),
        "agent.zip": saved.getvalue(),
        **{f"{name}.npz": _packed(_buffer(agent, name).filled()) for name in _BUFFERS},
        "random.npz": _packed(RandomState.capture().as_arrays()),
        "environment.pkl": environment,
    }
    temporary = path.with_name(f".{path.name}.part")  # one of a killed process is overwritten
    try:
        with open(temporary, "wb") as file:
            with zipfile.ZipFile(file, "w") as archive:
                for name, content in parts.items():
                    archive.writestr(name, content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.absolute().parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def resume(
    path: str | Path,
    env: GymEnv,
    task: Task,
    algorithm: type[ModelLearner] | None = None,
) -> Any:
    """Read the agent of a run that :class:`EpisodeCheckpoint` wrote, ready to go on.

    Go on with ``agent.learn(total - agent.num_timesteps, reset_num_timesteps=False)``.

    What can be checked is, before anything is unpickled: the class of the agent, the environment's
    wrappers and spaces, and the task. Buffers, generators and what the dynamics learnt are read
    without pickle; the agent's settings and the state of the environment are pickles. So open only
    files that you trust.

    Args:
        path: The checkpoint.
        env: The environment, made and wrapped as for the first part of the run. What it wraps is
            replaced by the one of the checkpoint, in its state.
        task: The task of the run, its dynamics fitted or not.
        algorithm: The class of the agent. Default: the one that the checkpoint names, of the
            library or of what you have imported.

    Returns:
        The agent. ``learn`` restores the random generators; until then you may use them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is no checkpoint, or is of another algorithm, environment or task.
        RuntimeError: If the run had other dynamics, or another physics.
    """
    manifest, parts = _read(path)
    if algorithm is None:
        algorithm = _known(manifest["algorithm"])
    vec_env = algorithm._wrap_env(env, verbose=0)
    _check(path, manifest, vec_env, task, algorithm)
    agent = algorithm.load(
        io.BytesIO(parts["agent.zip"]), env=vec_env, task=task, force_reset=False
    )
    for name in _BUFFERS:
        _buffer(agent, name).fill(_unpacked(parts[f"{name}.npz"]))
    for name in ("num_new", "num_ended"):
        setattr(agent.replay_buffer, name, manifest[name])
    agent.action_space.np_random.bit_generator.state = manifest["action_space"]
    agent._random_state = RandomState.from_arrays(_unpacked(parts["random.npz"]))
    _restore_environment(agent, vec_env, *pickle.loads(parts["environment.pkl"]))
    return agent


def _known(name: str) -> type[ModelLearner]:
    """The class of an agent by its name, of all that are imported."""
    known: dict[str, type[ModelLearner]] = {}
    waiting: list[type[ModelLearner]] = [ModelLearner]
    while waiting:
        for each in waiting.pop().__subclasses__():
            known.setdefault(each.__name__, each)
            waiting.append(each)
    if name not in known:
        raise ValueError(
            f"The checkpoint is of the class {name!r}, which is none of {', '.join(known)}; import "
            "it, or pass algorithm, the class of the agent."
        )
    return known[name]


def _locked(path: Path) -> AcquireReturnProxy[Any]:
    """Acquire the lock of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path.absolute().with_name(f"{path.name}.lock"))
    try:
        return lock.acquire(blocking=False)
    except Timeout as error:
        raise RuntimeError(
            f"Another run writes checkpoints to {path}, and holds the lock {lock.lock_file}. "
            "Wait for it, or give this run a file of its own."
        ) from error


def _read(path: str | Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The manifest of a checkpoint and its other parts, as they are on the disk."""
    try:
        with zipfile.ZipFile(path) as archive:
            parts = {name: archive.read(name) for name in archive.namelist()}
            manifest = json.loads(parts.pop("manifest.json"))
        missing = {
            "agent.zip",
            "environment.pkl",
            "random.npz",
            *(f"{name}.npz" for name in _BUFFERS),
        } - {*parts}
        if missing:
            raise ValueError(f"it has no {min(missing)}")
        if manifest["format"] != _FORMAT:
            raise ValueError(f"its format is {manifest['format']!r}, expected {_FORMAT!r}")
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is not a checkpoint of EpisodeCheckpoint ({error}). An agent that was saved "
            "by agent.save is read by DynaSAC.load."
        ) from error
    return manifest, parts


def _check(
    path: str | Path,
    manifest: dict[str, Any],
    env: VecEnv,
    task: Task,
    algorithm: type[ModelLearner],
) -> None:
    """Raise a ValueError unless a checkpoint is of this agent, environment and task."""
    if not isinstance(task, Task):
        raise TypeError(f"task must be a Task(dynamics, reward, ...); found {task!r}.")
    own = {
        "algorithm": algorithm.__name__,
        "environment": _described(env),
        "task": json.loads(json.dumps(task.describe(), default=_plain)),
    }
    for part, here in own.items():
        found = manifest[part]
        if part == "algorithm" or found is None:
            found, here = {part: found}, {part: here}
        different = [
            f"{name} is {found.get(name)} in the checkpoint, {here.get(name)} here"
            for name in {**here, **found}
            if found.get(name) != here.get(name)
        ]
        if different:
            raise ValueError(
                f"{path} is of another {part}: {'; '.join(different)}. Pass {part} as in the first "
                "part of the run."
            )


def _buffer(agent: ModelLearner, name: str) -> CompactReplayBuffer:
    return agent.replay_buffer if name == "replay_buffer" else agent.replay_buffer.model_buffer


def _packed(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _unpacked(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def _plain(value: Any) -> Any:
    """Numbers of NumPy as JSON has them."""
    return value.tolist()


def _layers(env: VecEnv) -> list[VecEnv]:
    """A vectorised environment and what it wraps, from the outside."""
    layers = [env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers


def _described(env: VecEnv) -> dict[str, Any]:
    """What an environment is, in plain values."""
    layers = _layers(env)
    inner: list[gym.Env[Any, Any]] = getattr(layers[-1], "envs", [])
    names = [type(layer).__name__ for layer in layers]
    if inner:
        one = inner[0]
        while isinstance(one, gym.Wrapper):
            names.append(type(one).__name__)
            one = one.env
        names.append(type(one).__name__)
    return {
        "wrappers": " of ".join(names),
        "num_envs": env.num_envs,
        "observation_space": str(env.observation_space),
        "action_space": str(env.action_space),
    }


def _environment_state(vec_env: VecEnv) -> bytes:
    """The pickled state of the environment; of its wrappers alone, if it cannot be pickled."""
    layers = _layers(vec_env)
    inner = layers[-1]
    problem = f"a {type(inner).__name__} keeps its environments elsewhere"
    kept = [
        {name: value for name, value in vars(layer).items() if name not in _OF_ALL}
        for layer in layers
    ]
    if isinstance(inner, DummyVecEnv):
        try:
            return bytes(cloudpickle.dumps((kept, inner.envs)))
        except Exception as error:  # pickling runs the user's code
            problem = f"{type(error).__name__}: {error}"
    warnings.warn(
        f"The state of the environment cannot be saved ({problem}), so a resumed run resets it and "
        "will not be bit-identical. Make the environment picklable, in a DummyVecEnv.",
        UserWarning,
        stacklevel=4,
    )
    return bytes(cloudpickle.dumps((kept[:-1], None)))


def _restore_environment(
    agent: ModelLearner, vec_env: VecEnv, kept: list[dict[str, Any]], envs: list[Any] | None
) -> None:
    layers = _layers(vec_env)
    for layer, attributes in zip(layers, kept, strict=envs is not None):
        vars(layer).update(attributes)
    if envs is None:
        agent._last_obs = None  # the environment is reset
    else:
        assert isinstance(layers[-1], DummyVecEnv), "as described"
        layers[-1].envs = envs
