"""Checkpoints from which a run goes on exactly as if it had not been interrupted."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import reduce
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, Self

import cloudpickle
import numpy as np
import torch
from filelock import AcquireReturnProxy, FileLock, Timeout

from gpadjust.checks import check_kind, checked_whole
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics
from gpadjust.files.sync_folder import sync_folder

_FORMAT = "gpadjust episode checkpoint, version 6"


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
        has_cuda = torch.cuda.is_available()
        return cls(
            random.getstate(),
            (name, np.asarray(keys).tolist(), *others),
            torch.get_rng_state(),
            torch.cuda.get_rng_state_all() if has_cuda else [],
        )

    def restore(self) -> None:
        """Go back to this state."""
        random.setstate(self.python)
        np.random.set_state(self.numpy)  # noqa: NPY002
        torch.set_rng_state(self.torch)
        if self.cuda and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(self.cuda)


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

    def __call__(self, agent: Any, event: str, values: Any = None) -> None:
        """Write the file before an episode begins, and when the run is done."""
        if not hasattr(agent, "saved_parts"):
            raise TypeError(
                "EpisodeCheckpoint is for learners with a model, such as MPCAgent and DynaSAC."
            )
        if event == "episode":
            if self._episodes % self.every == 0:
                self._write(agent)
            self._episodes += 1
        elif event == "done":
            self._write(agent)

    def write(self, agent: Any) -> None:
        """Write the state of a run between two episodes.

        Raises:
            RuntimeError: If a run writes to this file.
        """
        with self.locked():
            self._write(agent)

    def _write(self, agent: Any) -> None:
        manifest = {
            "format": _FORMAT,
            "algorithm": _path_of(type(agent)),
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


def resume(path: str | Path, env: Any, task: Task, algorithm: Any = None) -> Any:
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
        algorithm: The class of the agent. Default: the one that the checkpoint names, if its module
            is imported.

    Returns:
        The agent. ``learn`` restores the random generators; until then you may use them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is no checkpoint, or is of another algorithm, environment or task.
        RuntimeError: If the run had other dynamics, or another physics.
    """
    check_kind("task", task, Task, "a Task(dynamics, reward, ...)")
    manifest, parts = _read(path)
    algorithm = _class_of(manifest["algorithm"]) if algorithm is None else algorithm
    env = algorithm.wrapped(env)
    own = {
        "algorithm": _path_of(algorithm),
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


def _path_of(algorithm: type) -> str:
    return f"{algorithm.__module__}:{algorithm.__qualname__}"


def _class_of(path: str) -> Any:
    """Return the class of an agent in a module that is imported; the newest definition of it."""
    module, _, names = path.partition(":")
    found: Any = sys.modules.get(module)
    found = reduce(lambda each, name: getattr(each, name, None), names.split("."), found)
    if not hasattr(found, "from_parts"):
        raise ValueError(
            f"The checkpoint is of the class {path}, which is not imported; import it (DynaSAC and "
            "DynaTD3 are of gpadjust.rl), or pass algorithm, the class of the agent."
        )
    return found


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


def _plain(value: Any) -> Any:
    """Numbers of NumPy as JSON has them."""
    return value.tolist()


@contextmanager
def locked(callbacks: Iterable[Any]) -> Iterator[None]:
    """Hold the locks of those callbacks that are checkpoints."""
    with ExitStack() as held:
        for each in callbacks:
            if isinstance(each, EpisodeCheckpoint):
                held.enter_context(each.locked())
        yield


# The attributes of an agent, in which names stand for task, model and dynamics.


class _Pickler(cloudpickle.Pickler):
    def __init__(self, file: io.BytesIO, agent: Any) -> None:
        super().__init__(file)
        task, model = agent.task, agent.model or agent.task
        self.names = {id(model): "model", id(model.dynamics): "model.dynamics"}
        self.names |= {id(task): "task", id(task.dynamics): "task.dynamics"}

    def persistent_id(self, value: Any) -> str | None:
        """Return the name of an object that is not pickled, wherever the agent keeps it."""
        name = self.names.get(id(value))
        if name is None and isinstance(value, Dynamics):
            raise TypeError(
                "it has dynamics of its own, which no checkpoint holds; make them where they are "
                "needed"
            )
        return name


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, agent: Any) -> None:
        super().__init__(file)
        self.agent = agent

    def persistent_load(self, name: str) -> Any:
        """Return the agent's part of a name; its model is made when it is first asked for."""
        if name.startswith("model") and self.agent.model is None:
            self.agent.model = self.agent.known_task()
        return attrgetter(name)(self.agent)


def pickled(state: dict[str, Any], agent: Any) -> bytes:
    """Return the attributes of an agent in bytes, without task, model and dynamics.

    Raises:
        TypeError: If one cannot be pickled, whose name it has.
    """

    def dump(value: Any) -> bytes:
        file = io.BytesIO()
        _Pickler(file, agent).dump(value)
        return file.getvalue()

    try:
        return dump(state)
    except Exception as error:  # pickling runs the user's code
        name = next(name for name, value in state.items() if not _works(dump, value))
        raise TypeError(
            f"{type(agent).__name__}.{name} cannot be pickled, as a checkpoint does "
            f"({type(error).__name__}: {error}). Make it a property, or name it in not_saved."
        ) from error


def _works(dump: Callable[[Any], bytes], value: Any) -> bool:
    try:
        dump(value)
    except Exception:  # of the user's code
        return False
    return True


def unpickled(content: bytes, agent: Any) -> Any:
    """Return the attributes, which refer to the task of this agent, its model and its dynamics."""
    return _Unpickler(io.BytesIO(content), agent).load()
