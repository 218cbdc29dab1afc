"""Attributes of an agent in bytes, in which names stand for task, model and dynamics."""

from __future__ import annotations

import io
import pickle
from operator import attrgetter
from typing import Any

import cloudpickle

from gpadjust.control.task import Task


def pickled(state: dict[str, Any], agent: Any) -> bytes:
    """The attributes of an agent, without task, model and dynamics.

    Raises:
        TypeError: If one cannot be pickled; it says which.
    """
    try:
        return _pickled(state, agent)
    except Exception as error:  # pickling runs the user's code
        name = next(name for name, part in state.items() if not _can_be_pickled(part, agent))
        raise TypeError(
            f"{type(agent).__name__}.{name} cannot be pickled, as a checkpoint does "
            f"({type(error).__name__}: {error}). Make it a property, or name it in not_saved."
        ) from error


def unpickled(content: bytes, agent: Any) -> Any:
    """Return the attributes, which refer to the task of this agent, its model and its dynamics."""
    return _Unpickler(io.BytesIO(content), agent).load()


class _Pickler(cloudpickle.Pickler):
    def __init__(self, file: io.BytesIO, agent: Any) -> None:
        super().__init__(file)
        self.agent = agent

    def persistent_id(self, value: Any) -> str | None:
        """The name of what is not pickled, wherever it is kept."""
        task, model = self.agent.task, self.agent.model or self.agent.task
        names = {id(model.dynamics): "model.dynamics", id(task.dynamics): "task.dynamics"}
        names[id(task)] = "task"
        if id(value) in names or not isinstance(value, Task):
            return names.get(id(value))
        if value is model:
            return "model"
        if value.dynamics in (task.dynamics, model.dynamics):
            return None  # pickled, but for its dynamics
        raise TypeError(
            f"{type(self.agent).__name__} keeps a Task with dynamics of its own, which no "
            "checkpoint holds; keep its reward and so on, and make it where it is needed"
        )


def _pickled(value: Any, agent: Any) -> bytes:
    file = io.BytesIO()
    _Pickler(file, agent).dump(value)
    return file.getvalue()


def _can_be_pickled(value: Any, agent: Any) -> bool:
    try:
        _pickled(value, agent)
    except Exception:  # as above
        return False
    return True


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, agent: Any) -> None:
        super().__init__(file)
        self.agent = agent

    def persistent_load(self, name: str) -> Any:
        """The part of the agent that has this name; the model when it is first asked for."""
        if name.startswith("model") and self.agent.model is None:
            self.agent.model = self.agent.known_task()
        return attrgetter(name)(self.agent)
