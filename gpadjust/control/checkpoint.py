"""Checkpoints: a resumed run ends exactly as one that was not interrupted."""

from __future__ import annotations

import io
import json
import os
import pickle
import sys
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cloudpickle
from filelock import FileLock, Timeout

from gpadjust.checks import check_kind
from gpadjust.control.episodes import generators
from gpadjust.control.summary import layer_names
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics
from gpadjust.files.sync_folder import sync_folder


class EpisodeCheckpoint:
    """Writes the complete state of a run before and after each episode; :func:`resume` reads it.

    It is a callback of :class:`Agent` and of ``gpadjust.rl.Dyna``. A resumed run ends with the same
    numbers, bit for bit, on the same machine and versions; but an environment without a pickle (a
    real robot) is reset, with a warning. The file is replaced atomically: whenever the process
    dies, a complete checkpoint is on the disk. A run holds a lock beside the file (``.lock``).
    Other callbacks may keep their state in ``agent.notes``.

    Args:
        path: The file.

    Raises:
        RuntimeError: When learning starts, if another run writes to this file.

    Example:
        >>> checkpoint = EpisodeCheckpoint("run.ckpt")  # agent.learn(1250, checkpoint)
        >>> # after an interruption: agent = resume("run.ckpt", env, task)
        >>> # agent.learn(1250 - agent.num_timesteps, checkpoint)
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()

    def __call__(self, agent: Any, event: str, values: Any = None) -> None:
        """Write the file before and after an episode, and at the end of the run."""
        if not hasattr(agent, "environment_state"):
            raise TypeError(
                "EpisodeCheckpoint is for learners with a model, such as MPCAgent and DynaSAC."
            )
        if event in ("episode", "trial", "done"):
            self._write(agent)

    def write(self, agent: Any) -> None:
        """Write the state of a run; an error if another run writes, or a pickle is impossible."""
        with self.locked():
            self._write(agent)

    def _write(self, agent: Any) -> None:
        about = json.dumps(_about(type(agent), agent.env, agent.task))
        run = _pickled(agent)
        part = self.path.with_name(f".{self.path.name}.part")
        part.unlink(missing_ok=True)  # of a process that was killed, as the lock is ours; or a link
        try:
            with open(part, "xb") as file:
                with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                    archive.writestr("about.json", about)
                    archive.writestr("run.pkl", run)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, self.path)
            sync_folder(self.path.parent)
        except OSError as error:  # a full disk
            error.add_note(f"{self.path} stays as it was, and the agent has lost nothing.")
            raise
        finally:
            part.unlink(missing_ok=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock of the file; a RuntimeError if another run does."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.path.with_name(f"{self.path.name}.lock"))
        try:
            acquired = lock.acquire(blocking=False)
        except Timeout as error:
            raise RuntimeError(
                f"Another run writes checkpoints to {self.path}, and holds the lock "
                f"{lock.lock_file}. Wait for it, or give this run its own file."
            ) from error
        with acquired:
            yield


def resume(path: str | Path, env: Any, task: Task, algorithm: Any = None) -> Any:
    """Read the agent of a run that :class:`EpisodeCheckpoint` wrote.

    Continue with ``agent.learn(total - agent.num_timesteps)`` (of Dyna with
    ``reset_num_timesteps=False``), which restores the random generators. Class of the agent,
    environment and task are compared before anything is unpickled; the rest is a pickle, so open
    only files that you trust.

    Args:
        path: The checkpoint.
        env: The environment, made and wrapped as for the first part of the run. The environment of
            the checkpoint, in its state, replaces it if it could be saved.
        task: The task of the run, its dynamics fitted or not.
        algorithm: The class of the agent. Default: the name in the checkpoint, if its module is
            imported.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not a checkpoint, or of another agent, environment or task.
        RuntimeError: If the run had other dynamics, or another physics.
    """
    check_kind("task", task, Task, "a Task(dynamics, reward, ...)")
    try:
        with zipfile.ZipFile(path) as archive:
            about = json.loads(archive.read("about.json"))
            content = archive.read("run.pkl")
    except (zipfile.BadZipFile, zlib.error, KeyError, ValueError) as error:
        raise ValueError(f"{path} is not a checkpoint of EpisodeCheckpoint ({error}).") from error
    if algorithm is None:
        module, _, names = about["agent"].partition(":")
        algorithm = sys.modules.get(module)
        for name in names.split("."):
            algorithm = getattr(algorithm, name, None)
    if algorithm is None:
        raise ValueError(
            f"The checkpoint is of the class {about['agent']}, which is not imported; import it "
            "(DynaSAC and DynaTD3 are of gpadjust.rl), or pass algorithm, the class of the agent."
        )
    env = algorithm.wrapped(env)
    here = _about(algorithm, env, task)
    different = [
        f"{name} is {about.get(name)} in the checkpoint, {here.get(name)} here"
        for name in {**here, **about}
        if about.get(name) != here.get(name)
    ]
    if different:
        raise ValueError(
            f"{path} is of another run: {'; '.join(different)}. Pass agent, environment and task "
            "as in the first part of the run."
        )
    run, state, random_state, environment = pickle.loads(content)
    task.dynamics.load_state_dict(state)
    agent = algorithm.__new__(algorithm)
    vars(agent).update(run)
    agent.go_on(env, task, environment)
    agent._random_state = random_state
    return agent


def _about(algorithm: type, env: Any, task: Task) -> dict[str, Any]:
    """Return agent, environment and task in plain values."""
    about = {
        "format": "gpadjust checkpoint, version 7",
        "agent": f"{algorithm.__module__}:{algorithm.__qualname__}",
        "environment": " of ".join(layer_names(env)),
        "num_envs": getattr(env, "num_envs", 1),
        "observation_space": str(env.observation_space),
        "action_space": str(env.action_space),
        **task.describe(),
    }
    return dict(json.loads(json.dumps(about, default=lambda value: value.tolist())))


class _Pickler(cloudpickle.Pickler):
    def persistent_id(self, value: Any) -> None:
        """Refuse code of the user."""
        if isinstance(value, Task | Dynamics):
            raise TypeError("a checkpoint holds neither tasks nor dynamics; make them again")


def _pickled(agent: Any) -> bytes:
    """Return attributes, dynamics, generators and environment of a run, without its task."""
    left_out = {name for kind in type(agent).__mro__ for name in vars(kind).get("not_saved", ())}
    run = {name: value for name, value in vars(agent).items() if name not in left_out}
    random_state = agent._random_state or generators()
    others = agent.task.dynamics.state_dict(), random_state, agent.environment_state()
    file = io.BytesIO()
    try:
        _Pickler(file).dump((run, *others))
    except Exception as error:  # pickling runs the user's code
        for name, value in run.items():
            try:
                _Pickler(io.BytesIO()).dump(value)
            except Exception:
                raise TypeError(
                    f"{type(agent).__name__}.{name} cannot be pickled, as a checkpoint does "
                    f"({type(error).__name__}: {error}). Make it a property, or name it in "
                    "not_saved."
                ) from error
        raise
    return file.getvalue()


def pickled_environment(env: Any) -> bytes | None:
    """Return an environment in bytes; None, with a warning, if it cannot be pickled."""
    try:
        return bytes(cloudpickle.dumps(env))
    except Exception as error:  # pickling runs the user's code
        warnings.warn(
            f"The environment cannot be pickled ({type(error).__name__}: {error}), so a resumed "
            "run resets it and will not be bit-identical. Make it picklable, and if it is "
            "vectorised, put it in a DummyVecEnv.",
            UserWarning,
            stacklevel=6,
        )
        return None
