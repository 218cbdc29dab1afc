"""What is written down of each episode."""

from __future__ import annotations

import time
from typing import Any

from torch import Tensor

from gpadjust.rl import DynaCallback, DynaSAC
from paper.control import Settings


class Recorder(DynaCallback):
    """Records each episode, and sets the number of updates that follows it.

    A record is begun when the episode ends, and finished after the updates, before the next one.
    Records are notes of the agent, so that checkpoints hold them: one belongs after this callback
    in the list. Seconds of the parts are of wall time, ``"cpu_seconds"`` what this process took for
    all of it, on its one core. An experiment says in a subclass what it writes down of an episode,
    and of the policy that has learnt from it.

    Args:
        settings: Of the learner.
        model_free: Whether it has no model.
    """

    model: DynaSAC

    def __init__(self, settings: Settings, model_free: bool) -> None:
        super().__init__()
        self.settings: Any = settings
        self.model_free = model_free
        self._record: dict[str, Any] | None = None
        self._begun = 0.0  # of this process's time

    def of_episode(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """What is recorded of an episode's transitions."""
        return {}

    def of_policy(self, episode: int) -> dict[str, Any]:
        """What is recorded of the policy after the updates that follow an episode (from 1)."""
        return {}

    def found(self) -> dict[str, Any]:
        """What a run has found: the records, a list for each column."""
        return {"episodes": {name: [r[name] for r in self.records] for name in self.records[0]}}

    @property
    def records(self) -> list[dict[str, Any]]:
        """Those of the finished episodes."""
        records: list[dict[str, Any]] = self.model.notes.setdefault("episodes", [])
        return records

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """How well the model foresaw the episode; rmse for each state, once it can predict."""
        if self._record is not None and "nlpd" in metrics:
            errors = [value for name, value in metrics.items() if name.startswith("rmse/")]
            self._record |= {name: metrics[name] for name in ("nlpd", "coverage")}
            self._record["rmse"] = errors

    def _on_rollout_start(self) -> None:
        self._finish()
        self._begun = time.process_time()
        episode = len(self.records) + 1
        self.model.gradient_steps = self.settings.updates_after(episode, self.model_free)

    def _on_rollout_end(self) -> None:
        steps = self.num_timesteps - sum(past["steps"] for past in self.records)
        episode = self.model.recorded_episodes(newest=steps)
        transitions = (episode.states, episode.actions, episode.next_states)
        unforeseen = dict.fromkeys(("nlpd", "coverage", "rmse"))
        self._record = {"steps": steps, **self.of_episode(*transitions), **unforeseen}

    def _on_training_end(self) -> None:
        self._finish()

    def _finish(self) -> None:
        """Complete the record of the episode whose updates are done, if there is one."""
        if self._record is None:
            return
        agent, log = self.model, self.records
        has_model = not self.model_free and len(log) < self.settings.last_model_episode
        left = agent.logger.name_to_value.get("model/left_bounds", 0) if has_model else 0
        record = {
            **self._record,
            **self.of_policy(len(log) + 1),
            "left_bounds": int(left),
            "updates": agent._n_updates - sum(past["updates"] for past in log),
        }
        for part, seconds in agent.wall_time.items():
            record[f"{part}_seconds"] = seconds - sum(past[f"{part}_seconds"] for past in log)
        record["cpu_seconds"] = time.process_time() - self._begun
        log.append(record)
        self._record = None
