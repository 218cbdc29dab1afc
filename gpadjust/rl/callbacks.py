"""Callbacks of Dyna agents."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.control import EpisodeCheckpoint, print_progress


class DynaCallback(BaseCallback):
    """A Stable-Baselines3 callback with two more hooks, for :class:`Dyna` agents.

    Subclasses that override ``_init_callback`` must call that of this class.
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
        """Do something after a fit, with the numbers of the event ``"fit"`` of an ``Agent``."""

    def on_model_episodes(self, returns: np.ndarray) -> None:
        """Do something after model episodes that ran side by side, with the return of each."""


class AgentCallback(DynaCallback):
    """Calls a callback of :class:`gpadjust.control.Agent` at the events that Dyna has, too.

    A trial is a rollout of Stable-Baselines3 in which an episode ends.
    """

    def __init__(self, callback: Any) -> None:
        super().__init__()
        self.callback = callback
        self._begun, self._steps_before = 0.0, 0

    @staticmethod
    def around(callback: Any) -> Any:
        """Return a callback of agents as Stable-Baselines3 takes it; others as they are."""
        is_ours = isinstance(callback, EpisodeCheckpoint) or callback is print_progress
        return AgentCallback(callback) if is_ours else callback

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """Tell that the dynamics have learnt."""
        self.callback(self.model, "fit", metrics)

    def _on_rollout_start(self) -> None:
        # The updates of the last episode are done, and the next has not begun.
        self.callback(self.model, "episode", {})
        self._begun, self._steps_before = (
            time.perf_counter(),
            len(self.model.replay_buffer.episodes),
        )

    def _on_rollout_end(self) -> None:
        new = self.model.replay_buffer.episodes.some(slice(self._steps_before, None))
        # A checkpoint takes its steps before the next one, with the learner's updates.
        if len(new) and not isinstance(self.callback, EpisodeCheckpoint):
            values: dict[str, float] = {"number": self.model.num_episodes + 1, "steps": len(new)}
            values["reward"] = float(new.rewards.mean())
            values["seconds"] = time.perf_counter() - self._begun
            self.callback(self.model, "trial", values)

    def _on_training_end(self) -> None:
        # Unless another callback stopped the run within an episode.
        if self.model.num_timesteps >= self.model._total_timesteps:
            self.callback(self.model, "done", {})
