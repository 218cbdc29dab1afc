"""The base of all agents."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gpadjust.control.random_state import RandomState
from gpadjust.control.recorded_episodes import RecordedEpisodes
from gpadjust.control.task import Task


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


@contextmanager
def locked(callbacks: Iterable[Any]) -> Iterator[None]:
    """Hold the locks of the callbacks that have one, as checkpoints do."""
    with ExitStack() as held:
        for each in callbacks:
            if (lock := getattr(each, "locked", None)) is not None:
                held.enter_context(lock())
        yield


def layer_names(env: Any) -> list[str]:
    """The classes of an environment and of what it wraps, from the outside."""
    names = [type(env).__name__]
    held = getattr(env, "envs", None)  # of a vectorised environment, which are alike
    first = held[0] if isinstance(held, list) and held else None
    for inner in (getattr(env, "venv", None), getattr(env, "env", None), first):
        if inner is not None:
            return names + layer_names(inner)
    return names
