"""Callbacks of Dyna agents."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.control import EpisodeCheckpoint, print_progress


class DynaCallback(BaseCallback):
    """A Stable-Baselines3 callback with two more hooks, for :class:`Dyna` agents.

    A subclass with ``_init_callback`` must call that of this class.
    """

    model: Any

    def _init_callback(self) -> None:
        if not hasattr(self.model, "model_hooks"):
            raise TypeError(
                f"{type(self).__name__} is for Dyna agents, such as DynaSAC; found "
                f"{type(self.model).__name__}."
            )
        self.model.model_hooks.append(self)

    def _on_step(self) -> bool:
        return True

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """React to a fit, with the numbers of the event ``"fit"`` of an ``Agent``."""

    def on_model_episodes(self, returns: np.ndarray) -> None:
        """React to parallel model episodes, with their returns."""


class AgentCallback(DynaCallback):
    """Calls a callback of :class:`gpadjust.control.Agent` at the corresponding events of Dyna.

    A trial is a rollout of Stable-Baselines3 in which an episode ends.
    """

    def __init__(self, callback: Any) -> None:
        super().__init__()
        self.callback = callback
        self._start_time = 0.0
        self._steps_before = 0

    @staticmethod
    def around(callback: Any) -> Any:
        """Return a callback of agents as one of Stable-Baselines3; any other unchanged."""
        if isinstance(callback, EpisodeCheckpoint) or callback is print_progress:
            return AgentCallback(callback)
        return callback

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """Report a fit of the dynamics."""
        self.callback(self.model, "fit", metrics)

    def _on_rollout_start(self) -> None:
        # The updates of the last episode are done, and the next has not begun.
        self.callback(self.model, "episode", {})
        self._start_time = time.perf_counter()
        self._steps_before = len(self.model.replay_buffer.episodes)

    def _on_rollout_end(self) -> None:
        new = self.model.replay_buffer.episodes.some(slice(self._steps_before, None))
        # A checkpoint saves at the start of the next rollout, after the updates of the learner.
        if len(new) and not isinstance(self.callback, EpisodeCheckpoint):
            values: dict[str, float] = {"number": self.model.num_episodes + 1, "steps": len(new)}
            values["reward"] = float(new.rewards.mean())
            values["seconds"] = time.perf_counter() - self._start_time
            self.callback(self.model, "trial", values)

    def _on_training_end(self) -> None:
        # Another callback may have stopped the run within an episode.
        if self.model.num_timesteps >= self.model._total_timesteps:
            self.callback(self.model, "done", {})
