"""Checkpoints from which a run goes on exactly as if it had not been interrupted."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import time
import warnings
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

import cloudpickle
import numpy as np
import torch
from filelock import AcquireReturnProxy, FileLock, Timeout
from torch import Tensor

from gpadjust.checks import check_kind, checked_whole
from gpadjust.control.recorded_episodes import RecordedEpisodes
from gpadjust.control.task import Task
from gpadjust.files import sync_folder

_FORMAT = "gpadjust episode checkpoint, version 5"


class TaskAgent(ABC):
    """Base of all agents: a task, which real episodes complete, and the parts of a checkpoint.

    Attributes:
        task: The task; not saved.
        wall_time: Seconds spent on each part of the work.
    """

    task: Any
    env: Any
    num_episodes: int
    num_timesteps: int
    wall_time: dict[str, float]
    _random_state: RandomState | None = None  # of a run that goes on, until `learn`

    def ready_task(self) -> Task:
        """The task, if the agent can learn with it."""
        return self.task

    def model_task(self) -> Task:
        """The task, with what environment and real episodes tell where it says nothing.

        Raises:
            ValueError: If nobody says how long an episode is.
        """
        return self.recorded_episodes().complete(
            self.ready_task(), self.episode_length(), self.action_bounds()
        )

    @abstractmethod
    def action_bounds(self) -> Tensor:
        """Lower and upper bounds of the actions, ``2 x action_dim``."""

    def episode_length(self) -> int:
        """Steps of an episode: those of the task, or else the time limit of the environment.

        Raises:
            ValueError: If there is neither.
        """
        length = self.ready_task().episode_length
        if length is None and (spec := self.env_attribute("spec")) is not None:
            length = spec.max_episode_steps
        if length is None:
            with suppress(AttributeError):  # a TimeLimit that was put around it by hand
                length = self.env_attribute("_max_episode_steps")
        if length is None:
            raise ValueError(
                "There is no environment, or no time limit that could be read of it; give the task "
                "an episode_length, the number of steps of an episode."
            )
        return int(length)

    def try_task(self, observations: np.ndarray, action_space: Any) -> None:
        """Call the task's functions at observations ``N x observation_dim`` and a middle action."""
        self.episode_length()
        before, task = RandomState.capture(), self.ready_task()
        seen = torch.from_numpy(observations.astype(np.float64))
        task.observed.check_observations(seen)
        # Of a single state much would look right that is not.
        if task.sensors is None:
            twice = task.dynamics.spec.decode(seen).repeat(2, 1)
        else:
            twice = task.draw_initial_states(2)
        middle = torch.from_numpy((action_space.low + action_space.high) / 2).double()
        task.try_functions(twice, middle.expand(len(twice), -1))
        before.restore()

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add what is done inside to a part of ``wall_time``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.wall_time[part] += time.perf_counter() - start

    def __repr__(self) -> str:
        """Name the agent, its environment and dynamics, what it has done, and its last reward."""
        env = "no environment" if self.env is None else layer_names(self.env)[-1]
        if self.task is None:
            return f"{type(self).__name__}({env}, no task)"
        recorded, last = self.recorded_episodes(), ""
        if recorded.num_transitions:
            newest = recorded.rewards[recorded.episode == recorded.episode.max()]
            last = f", last reward {newest.mean():.3g} a step"
        return (
            f"{type(self).__name__}({env}, {type(self.task.dynamics).__name__}, "
            f"{self.num_episodes} episodes learnt, {self.num_timesteps} steps{last})"
        )

    @abstractmethod
    def recorded_episodes(self, newest: int | None = None) -> RecordedEpisodes:
        """The real steps; or the newest of them only."""

    @abstractmethod
    def env_attribute(self, name: str) -> Any:
        """An attribute of the environment or of one that it wraps."""

    @classmethod
    @abstractmethod
    def wrapped(cls, env: Any) -> Any:
        """The user's environment as the agent holds it."""

    @classmethod
    def described(cls, env: Any) -> dict[str, Any]:
        """The environment in plain values, which are compared before anything is unpickled."""
        return {
            "wrappers": " of ".join(layer_names(env)),
            "observation_space": str(env.observation_space),
            "action_space": str(env.action_space),
        }

    @abstractmethod
    def saved_parts(self) -> dict[str, bytes]:
        """The files of a checkpoint, by name."""

    @classmethod
    @abstractmethod
    def from_parts(cls, parts: dict[str, bytes], env: Any, task: Task) -> Self:
        """The agent of these files."""


class EpisodeCheckpoint:
    """Writes the whole state of a run after each episode; :func:`resume` goes on.

    It is a callback of :class:`Agent` and of ``gpadjust.rl.Dyna``. The file holds all that the
    agent and its dynamics learnt, the real episodes, the state of the environment, and all random
    generators, so that an interrupted run ends with the same numbers, bit for bit, as one that was
    not (on the same machine and versions). It is replaced atomically: whenever the process dies, a
    whole checkpoint is on the disk. While it learns, a run holds a lock beside the file
    (``.lock``): another run that would write there is refused.

    Other callbacks keep their own state: it is not in the file, unless they write it into
    ``agent.notes``.

    The environment must be picklable for this; one that is not (a real robot) is reset when the
    run goes on, which is then another run, and a warning says so.

    Args:
        path: The file.
        every: Number of episodes between two checkpoints (of Dyna: of rollouts).

    Raises:
        ValueError: If ``every`` is not positive.
        RuntimeError: When learning starts, if another run writes to this file.

    Example:
        >>> checkpoint = EpisodeCheckpoint("run.ckpt")  # agent.learn(1250, checkpoint)
        >>> # after an interruption: agent = resume("run.ckpt", env, task)
        >>> # agent.learn(1250 - agent.num_timesteps, checkpoint)
    """

    def __init__(self, path: str | Path, every: int = 1) -> None:
        self.path = Path(path).absolute()
        self.every = checked_whole("every", every, 1)
        self._episodes = 0

    def locked(self) -> AcquireReturnProxy[Any]:
        """Acquire the lock of the file, as a context manager."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.path.with_name(f"{self.path.name}.lock"))
        try:
            return lock.acquire(blocking=False)
        except Timeout as error:
            raise RuntimeError(
                f"Another run writes checkpoints to {self.path}, and holds the lock "
                f"{lock.lock_file}. Wait for it, or give this run a file of its own."
            ) from error

    def __call__(self, agent: TaskAgent, event: str, values: Any = None) -> None:
        """Write the file before an episode begins, and when the run is done."""
        if not isinstance(agent, TaskAgent):
            raise TypeError(
                "EpisodeCheckpoint is for learners with a model, such as MPCAgent and DynaSAC."
            )
        if event == "episode":
            if self._episodes % self.every == 0:
                self._write(agent)
            self._episodes += 1
        elif event == "done":
            self._write(agent)

    def write(self, agent: TaskAgent) -> None:
        """Write the state of a run between two episodes.

        Raises:
            RuntimeError: If a run writes to this file.
        """
        with self.locked():
            self._write(agent)

    def _write(self, agent: TaskAgent) -> None:
        manifest = {
            "format": _FORMAT,
            "algorithm": type(agent).__name__,
            "environment": agent.described(agent.env),
            "task": None if agent.task is None else agent.task.describe(),
        }
        parts = {
            "manifest.json": json.dumps(manifest, default=_plain).encode(),
            "random.pt": packed(tuple(agent._random_state or RandomState.capture())),
            **agent.saved_parts(),
        }
        temporary = self.path.with_name(f".{self.path.name}.part")  # a killed process's goes
        try:
            with open(temporary, "wb") as file:
                with zipfile.ZipFile(file, "w") as archive:
                    for name, content in parts.items():
                        archive.writestr(name, content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, self.path)
            sync_folder(self.path.parent)
        except OSError as error:  # a full disk
            raise OSError(
                error.errno,
                f"{error.strerror}; the checkpoint is not written, and {self.path} is what it was. "
                "Make room and call `learn` or `save` again; the agent has lost nothing",
            ) from error
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def locked(callbacks: Iterable[Any]) -> Iterator[None]:
    """Hold the locks of all checkpoints among some callbacks."""
    with ExitStack() as held:
        for each in callbacks:
            if isinstance(each, EpisodeCheckpoint):
                held.enter_context(each.locked())
        yield


def resume(path: str | Path, env: Any, task: Task, algorithm: type[TaskAgent] | None = None) -> Any:
    """Read the agent of a run that :class:`EpisodeCheckpoint` wrote, ready to go on.

    Go on with ``agent.learn(total - agent.num_timesteps)`` (of Dyna with
    ``reset_num_timesteps=False``).

    Class of the agent, wrappers and spaces of the environment, and the task are compared before
    anything is unpickled. Episodes, generators and what the dynamics learnt are read without
    pickle; the agent's settings and the state of the environment are pickles. So open only files
    that you trust.

    Args:
        path: The checkpoint.
        env: The environment, made and wrapped as for the first part of the run. It is replaced by
            that of the checkpoint, in its state, if that could be saved.
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
    check_kind("task", task, Task, "a Task(dynamics, reward, ...)")
    manifest, parts = _read(path)
    algorithm = _known(manifest["algorithm"]) if algorithm is None else algorithm
    env = algorithm.wrapped(env)
    own = {
        "algorithm": algorithm.__name__,
        "environment": algorithm.described(env),
        "task": json.loads(json.dumps(task.describe(), default=_plain)),
    }
    for part, here in own.items():
        _compare(path, part, manifest[part], here)
    random_state = RandomState(*unpacked(parts["random.pt"]))
    agent = algorithm.from_parts(parts, env, task)
    agent._random_state = random_state
    return agent


def _compare(path: str | Path, part: str, found: Any, here: Any) -> None:
    """Raise a ValueError unless a part of the manifest is what it is here."""
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


def _known(name: str) -> type[TaskAgent]:
    """The class of an agent by its name, of all that are imported; the newest definition of it."""
    known: dict[str, type[TaskAgent]] = {}
    waiting: list[Any] = [TaskAgent]
    while waiting:
        for each in waiting.pop().__subclasses__():
            other = known.get(each.__name__, each)
            if each.__name__ == name and other.__module__ != each.__module__:
                raise ValueError(
                    f"The checkpoint is of the class {name!r}, which is one of "
                    f"{other.__module__} and one of {each.__module__}; pass algorithm, the class "
                    "of the agent."
                )
            known[each.__name__] = each  # a cell of a notebook that ran twice defines it twice
            waiting.append(each)
    if name not in known:
        raise ValueError(
            f"The checkpoint is of the class {name!r}, which is none of {', '.join(known)}; import "
            "it (DynaSAC and DynaTD3 are of gpadjust.rl), or pass algorithm, the class of the "
            "agent."
        )
    return known[name]


class _Parts(dict[str, bytes]):
    """The files of a checkpoint; a missing one is a ValueError, not the KeyError of a user's."""

    def __init__(self, path: str | Path) -> None:
        with zipfile.ZipFile(path) as archive:
            super().__init__({name: archive.read(name) for name in archive.namelist()})
        self.path = path

    def __missing__(self, name: str) -> bytes:
        raise ValueError(f"{self.path} is not a checkpoint of EpisodeCheckpoint: it has no {name}.")


def _read(path: str | Path) -> tuple[dict[str, Any], _Parts]:
    """The manifest of a checkpoint, and all its parts, as they are on the disk."""
    try:
        parts = _Parts(path)
        manifest = json.loads(parts.get("manifest.json", "{}"))
        if manifest.get("format") != _FORMAT:
            raise ValueError(f"its format is {manifest.get('format')!r}, expected {_FORMAT!r}")
    except (zipfile.BadZipFile, AttributeError, ValueError) as error:
        raise ValueError(
            f"{path} is not a checkpoint of EpisodeCheckpoint ({error}). An agent that was saved "
            "by agent.save of DynaSAC is read by DynaSAC.load."
        ) from error
    return manifest, parts


def packed(values: Any) -> bytes:
    """Tensors and plain values in bytes, which :func:`unpacked` reads without pickle.

    Raises:
        TypeError: If there are others, with which a run could not be resumed.
    """
    file = io.BytesIO()
    torch.save(values, file)
    try:
        unpacked(file.getvalue())
    except pickle.UnpicklingError as error:
        raise TypeError(
            "A checkpoint holds tensors and plain values; found others, such as NumPy arrays, in "
            "what an agent or the state_dict() of its dynamics gave. Make tensors of them."
        ) from error
    return file.getvalue()


def unpacked(content: bytes) -> Any:
    """Return the values of :func:`packed`; an error if there are others than these."""
    return torch.load(io.BytesIO(content), weights_only=True)


def pickled_environment(env: Any) -> bytes | None:
    """The pickled state of an environment; None, and a warning, if it cannot be pickled."""
    try:
        return bytes(cloudpickle.dumps(env))
    except Exception as error:  # pickling runs the user's code
        warn_unsaved(f"{type(error).__name__}: {error}")
        return None


def warn_unsaved(problem: str) -> None:
    """Warn that the state of an environment is not in a checkpoint."""
    warnings.warn(
        f"The state of the environment cannot be saved ({problem}), so a resumed run resets it and "
        "will not be bit-identical. Make the environment picklable"
        f"{', in a DummyVecEnv' if 'VecEnv' in problem else ''}.",
        UserWarning,
        stacklevel=5,
    )


def layer_names(env: Any) -> list[str]:
    """The classes of an environment and of what it wraps, from the outside."""
    names = [type(env).__name__]
    held = getattr(env, "envs", None)  # of a vectorised environment, which are alike
    first = held[0] if isinstance(held, list) and held else None
    for inner in (getattr(env, "venv", None), getattr(env, "env", None), first):
        if inner is not None:
            return names + layer_names(inner)
    return names


def _plain(value: Any) -> Any:
    """Numbers of NumPy as JSON has them."""
    return value.tolist()


class RandomState(NamedTuple):
    """The state of the global generators of Python, NumPy and PyTorch, from which a run draws."""

    python: Any
    numpy: Any
    torch: Any
    cuda: list[Any]

    @staticmethod
    def seed(seed: int) -> None:
        """Seed all of them."""
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the generator that SB3 uses
        torch.manual_seed(seed)

    @classmethod
    def capture(cls) -> Self:
        """Return the present state, in tensors and plain values."""
        name, keys, *others = np.random.get_state()  # noqa: NPY002
        return cls(
            random.getstate(),
            (name, np.asarray(keys).tolist(), *others),
            torch.get_rng_state(),
            torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        )

    def restore(self) -> None:
        """Go back to this state."""
        random.setstate(self.python)
        np.random.set_state(self.numpy)  # noqa: NPY002
        torch.set_rng_state(self.torch)
        if self.cuda and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(self.cuda)
