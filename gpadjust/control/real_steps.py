"""The real steps that an agent has made."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.control.recorded_episodes import RecordedEpisodes
from gpadjust.control.smoothed_episodes import Seen
from gpadjust.control.task import Task


class RealStep(NamedTuple):
    """A real step, as the environment has it; its action in the scale of [-1, 1]."""

    episode: int
    observation: NDArray[Any]
    action: NDArray[Any]
    following: NDArray[Any]
    reward: float
    terminated: bool


class RealSteps:
    """Real steps, and what was found of the states behind them.

    Args:
        action_space: The space of the actions, which has bounds.

    Attributes:
        steps: All that were made.
        paths: With sensors, the states of each episode that was smoothed, ``(T + 1) x state_dim``.
    """

    def __init__(self, action_space: gym.spaces.Box) -> None:
        self.low, self.high = action_space.low, action_space.high
        self.steps: list[RealStep] = []
        self.paths: list[Tensor] = []

    def scaled(self, action: NDArray[Any], noise: Any = 0.0) -> NDArray[Any]:
        """An action in the scale of [-1, 1], in which noise is added and steps are kept.

        This is how Stable-Baselines3 rounds: agents of both are the same, bit for bit.
        """
        scaled = 2.0 * ((action - self.low) / (self.high - self.low)) - 1.0
        return np.clip(scaled + noise, -1.0, 1.0).astype(self.low.dtype)

    def unscaled(self, scaled: NDArray[Any]) -> NDArray[Any]:
        """Actions in their units, of those in the scale of [-1, 1]."""
        return np.asarray(self.low + (0.5 * (scaled + 1.0) * (self.high - self.low)))

    def seen(self) -> list[Seen]:
        """What sensors showed of each episode."""
        episodes = [[*each] for _, each in groupby(self.steps, key=lambda step: step.episode)]
        return [
            Seen(
                torch.from_numpy(np.array([steps[0].observation, *(s.following for s in steps)])),
                torch.from_numpy(self.unscaled(np.array([s.action for s in steps]))),
            )
            for steps in episodes
        ]

    def recorded(self, task: Task, newest: int | None) -> RecordedEpisodes:
        """The steps in the units of the task's spec; or the newest of them only.

        With sensors the states are those of the paths, and other steps are left out.
        """
        spec, steps, hidden = task.observed, self.steps, task.sensors is not None
        if hidden:
            steps = steps[: sum(len(path) - 1 for path in self.paths)]
        shapes = [(), (spec.observation_dim,), (spec.action_dim,), (spec.observation_dim,), (), ()]
        columns = zip(*steps, strict=True) if steps else [()] * len(shapes)
        episode, seen, actions, following, rewards, terminated = (
            torch.from_numpy(np.array(column, dtype=np.float64).reshape(len(steps), *shape))
            for column, shape in zip(columns, shapes, strict=True)
        )
        episode = episode.long()
        found = RecordedEpisodes(
            task.dynamics.spec,
            spec.decode(seen),
            torch.from_numpy(self.unscaled(actions.numpy())),
            spec.decode(following),
            rewards,
            terminated.bool(),
            episode,
            begins=torch.cat([torch.tensor([True]), episode.diff() > 0])[: len(steps)],
            whole=torch.ones(len(steps), dtype=torch.bool),
        )
        if hidden and steps:
            states, next_states = (
                torch.cat([path[part] for path in self.paths])
                for part in (slice(None, -1), slice(1, None))
            )
            found = replace(found, states=states, next_states=next_states)
        return found if newest is None else found.some(slice(max(len(steps) - newest, 0), None))

    def state_dict(self) -> dict[str, Any]:
        """The steps in columns, and the paths."""
        columns = [torch.from_numpy(np.array(part)) for part in zip(*self.steps, strict=True)]
        return {"columns": columns, "states": self.paths}

    @classmethod
    def of(cls, state: dict[str, Any], action_space: gym.spaces.Box) -> Self:
        """The steps that :meth:`state_dict` returned."""
        found = cls(action_space)
        found.steps = [
            RealStep(*(value.numpy() if value.dim() else value.item() for value in row))
            for row in zip(*state["columns"], strict=True)
        ]
        found.paths = state["states"]
        return found
