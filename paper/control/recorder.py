"""What is written down of each trial."""

from __future__ import annotations

import time
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor

from gpadjust.dynamics import LearnedDynamics
from gpadjust.rl import DynaSAC
from gpadjust.validation import rmse
from paper.control.scenario import Scenario, Settings, updates_on_trial

_LOG = "trial_log"


def trial_log(agent: DynaSAC) -> list[dict[str, Any]]:
    """The records of an agent's trials; an attribute, so that checkpoints hold them."""
    log: list[dict[str, Any]] = vars(agent).setdefault(_LOG, [])
    return log


class Recorder(BaseCallback):
    """Records each trial, and sets the number of updates that follows it.

    A record is begun when the trial ends, and finished after the updates, before the next trial. A
    checkpoint belongs after this callback in the list. Seconds of the parts are of wall time,
    ``"cpu_seconds"`` what this process took for all of it, on its one core. An experiment says in a
    subclass what it writes down of a trial, and of the policy that has learnt from it.

    Args:
        scenario: The learner.
        settings: The shared settings.
    """

    model: DynaSAC

    def __init__(self, scenario: Scenario, settings: Settings) -> None:
        super().__init__()
        self.scenario = scenario
        self.settings = settings
        self._record: dict[str, Any] | None = None
        self._begun = 0.0  # of this process's time

    def of_trial(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """What is recorded of a trial's transitions."""
        return {}

    def of_policy(self, trial: int) -> dict[str, Any]:
        """What is recorded of the policy after the updates that follow a trial (from 1)."""
        return {}

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._finish()
        self._begun = time.process_time()
        trial = len(trial_log(self.model)) + 1
        self.model.gradient_steps = updates_on_trial(self.scenario, self.settings, trial)

    def _on_rollout_end(self) -> None:
        steps = self.num_timesteps - sum(past["steps"] for past in trial_log(self.model))
        trial = self.model.recorded_trials(newest=steps)
        transitions = (trial.states, trial.actions, trial.next_states)
        scores = self._scores(transitions)
        self._record = {"steps": steps, **self.of_trial(*transitions), **scores}

    def _on_training_end(self) -> None:
        self._finish()

    def _runs_model(self) -> bool:
        done = len(trial_log(self.model))
        return self.scenario.dynamics is not None and done < self.settings.model_until

    def _scores(self, transitions: tuple[Tensor, Tensor, Tensor]) -> dict[str, Any]:
        """How well the model foresaw the trial, averaged over the states; rmse for each.

        A simulator says nothing of its own errors, and so has no NLPD and coverage.
        """
        dynamics = self.model.dynamics
        if not self._runs_model() or dynamics is None or not dynamics.is_fitted:
            return {"nlpd": None, "coverage": None, "rmse": None}
        if isinstance(dynamics, LearnedDynamics):
            score = dynamics.score(*transitions)
            return {
                "nlpd": score.nlpd.mean().item(),
                "coverage": score.coverage.mean().item(),
                "rmse": score.rmse.tolist(),
            }
        states, actions, following = transitions
        moving = dynamics.spec.moving
        mean, _ = dynamics.predict(states, actions)
        found = mean + dynamics.spec.change(mean, following)
        error = rmse(mean[:, moving], found[:, moving])
        return {"nlpd": None, "coverage": None, "rmse": error.tolist()}

    def _finish(self) -> None:
        """Complete the record of the trial whose updates are done, if there is one."""
        if self._record is None:
            return
        agent, log = self.model, trial_log(self.model)
        left = agent.logger.name_to_value.get("model/left_bounds", 0) if self._runs_model() else 0
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
