"""The runs of this experiment."""

from __future__ import annotations

from functools import partial
from typing import Any

from torch import Tensor

from gpadjust.envs import arm_reward
from gpadjust.envs.opensim_model import load_opensim
from gpadjust.rl import DynaSAC
from paper.arm.evaluation import evaluate, evaluation_log
from paper.arm.scenarios import (
    SCENARIOS,
    SETTINGS,
    ArmScenario,
    ArmSettings,
    functions,
    make_dynamics,
    make_env,
)
from paper.control import runs
from paper.control.experiment import Experiment
from paper.control.recorder import Recorder


class ArmRecorder(Recorder):
    """Records the cost of each trial, and evaluates the policy before the first and after some."""

    scenario: ArmScenario
    settings: ArmSettings

    def of_trial(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """The mean cost of the sampled actions, in rad."""
        return {"cost": -arm_reward(states, actions, next_states).mean().item()}

    def of_policy(self, trial: int) -> dict[str, Any]:
        """Nothing: evaluations have a log of their own, as there are fewer than trials."""
        if trial % self.settings.evaluate_every == 0:
            evaluate(self.model, self.scenario, self.settings, trial)
        return {}

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if not evaluation_log(self.model)["evaluations"]:
            evaluate(self.model, self.scenario, self.settings, 0)


def details(agent: DynaSAC, seed: int) -> dict[str, Any]:
    """The evaluations, and the errors at each target after some of them."""
    return evaluation_log(agent)


ARM = Experiment(
    name="arm",
    scenarios=SCENARIOS,
    settings=SETTINGS,
    make_env=make_env,
    make_dynamics=make_dynamics,
    functions=functions,
    make_recorder=ArmRecorder,
    details=details,
    check=load_opensim,
)
run_one = partial(runs.run_one, ARM)
