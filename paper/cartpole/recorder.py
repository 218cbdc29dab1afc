"""What is written down of each trial."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor

from gpadjust.dynamics import LearnedDynamics
from gpadjust.envs import cart_pole_reward
from gpadjust.envs.cart_pole import START_MEAN, START_STD
from gpadjust.rl import DynaSAC, ModelVecEnv
from gpadjust.validation import rmse
from paper.cartpole.scenarios import Scenario, Settings, true_dynamics, updates_on_trial

NUM_STARTS = 20
_LOG = "trial_log"


def trial_log(agent: DynaSAC) -> list[dict[str, Any]]:
    """The records of an agent's trials; an attribute, so that checkpoints hold them."""
    log: list[dict[str, Any]] = vars(agent).setdefault(_LOG, [])
    return log


def fixed_starts(n: int) -> Tensor:
    """The first ``n`` start states of the evaluation, from a generator of their own."""
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(NUM_STARTS, 4, generator=generator, dtype=torch.float64)
    return (torch.tensor(START_MEAN, dtype=torch.float64) + START_STD * noise)[:n]


def evaluate(agent: DynaSAC, encode_angle: bool, trial_length: int) -> float:
    """The mean cost of the deterministic policy over the fixed starts; draws no random number."""
    env = ModelVecEnv(
        true_dynamics(encode_angle),
        cart_pole_reward,
        fixed_starts,
        NUM_STARTS,
        trial_length,
        agent.observation_space,
        agent.action_space,
    )
    observations: Any = env.reset()
    costs = []
    for _ in range(trial_length):
        actions, _ = agent.predict(observations, deterministic=True)
        observations, rewards, _, _ = env.step(actions)
        costs.append(-rewards.mean())
    return float(np.mean(costs))


class Recorder(BaseCallback):
    """Records each trial, and sets the number of updates that follows it.

    A record is begun when the trial ends, and finished after the updates, before the next trial. A
    checkpoint belongs after this callback in the list.

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

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._finish()
        trial = len(trial_log(self.model)) + 1
        self.model.gradient_steps = updates_on_trial(self.scenario, self.settings, trial)

    def _on_rollout_end(self) -> None:
        trial = self.model.recorded_trials(newest=self.settings.trial_length)
        transitions = (trial.states, trial.actions, trial.next_states)
        rewards = cart_pole_reward(*transitions)
        self._record = {"cost": -rewards.mean().item(), **self._scores(transitions)}

    def _on_training_end(self) -> None:
        self._finish()

    def _runs_model(self) -> bool:
        done = len(trial_log(self.model))
        return self.scenario.dynamics is not None and done < self.settings.model_until

    def _scores(self, transitions: tuple[Tensor, ...]) -> dict[str, Any]:
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
        mean, _ = dynamics.predict(states, actions)
        found = mean + dynamics.spec.change(mean, following)
        return {"nlpd": None, "coverage": None, "rmse": rmse(mean, found).tolist()}

    def _finish(self) -> None:
        """Complete the record of the trial whose updates are done, if there is one."""
        if self._record is None:
            return
        agent, log = self.model, trial_log(self.model)
        left = agent.logger.name_to_value.get("model/left_bounds", 0) if self._runs_model() else 0
        record = {
            **self._record,
            "evaluation": evaluate(agent, self.scenario.encode_angle, self.settings.trial_length),
            "left_bounds": int(left),
            "updates": agent._n_updates - sum(past["updates"] for past in log),
        }
        for part, seconds in agent.wall_time.items():
            record[f"{part}_seconds"] = seconds - sum(past[f"{part}_seconds"] for past in log)
        log.append(record)
        self._record = None
