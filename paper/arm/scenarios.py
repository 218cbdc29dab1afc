"""The learners that are compared, and the settings that they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from gpadjust.dynamics import (
    CKADynamics,
    Dynamics,
    GPDynamics,
    PhysicsDynamics,
    RRADynamics,
    StateSpec,
)
from gpadjust.envs import (
    ARM_MEMORY_SPEC,
    ARM_SPEC,
    MuscleArmEnv,
    RememberAction,
    arm_reward,
    arm_start,
    opensim_arm_physics,
    torque_arm_physics,
)
from gpadjust.physics import Physics
from paper.control.experiment import Env
from paper.control.scenario import Scenario, Settings


@dataclass(frozen=True, kw_only=True)
class ArmSettings(Settings):
    """What is the same in every scenario, unless it says otherwise."""

    evaluate_every: int  # trials; also before the first
    strength: float  # of the muscles; a healthy arm's is 1


SETTINGS = ArmSettings(
    num_trials=30,
    trial_length=15,
    model_until=30,
    later_updates=15,
    evaluate_every=3,
    strength=0.5,
)
MODEL_FREE_UPDATES = 100  # per trial; the best of 30, 100, 300
MAP_TRIAL = 9  # after which, and at the end, the errors at each target are kept
SUBSET = 3  # seeds of some scenarios


@dataclass(frozen=True)
class ArmScenario(Scenario):
    """A learner.

    Its ``dynamics`` are made of a spec and f_p.

    Args:
        memory: Whether policy and model see the previous action.
        black_box: Whether OpenSim computes f_p, row by row, in place of the equation of motion.
    """

    memory: bool = False
    black_box: bool = False

    @property
    def spec(self) -> StateSpec:
        """What its states are."""
        return ARM_MEMORY_SPEC if self.memory else ARM_SPEC


def _gp(spec: StateSpec, physics: Physics) -> Dynamics:
    return GPDynamics(spec)


SCENARIOS = {
    "mf": ArmScenario("model-free", None),
    "mf-best": ArmScenario("model-free, fewer updates", None, updates=MODEL_FREE_UPDATES),
    "phy": ArmScenario("Dyna-Phy", PhysicsDynamics),
    "gp": ArmScenario("Dyna-GP", _gp),
    "cka": ArmScenario("Dyna-CKA", CKADynamics),
    "rra": ArmScenario("Dyna-RRA", RRADynamics),
    "mf-memory": ArmScenario("model-free, memory", None, memory=True, max_runs=SUBSET),
    "gp-memory": ArmScenario("Dyna-GP, memory", _gp, memory=True, max_runs=SUBSET),
    "cka-memory": ArmScenario("Dyna-CKA, memory", CKADynamics, memory=True),
    "cka-opensim": ArmScenario(
        "Dyna-CKA, f_p a simulator", CKADynamics, black_box=True, max_runs=1
    ),
}
PAPER = ("mf", "phy", "gp", "cka", "rra")  # those that the paper compares


def make_env(scenario: ArmScenario, settings: ArmSettings) -> Env:
    """The real system; an environment that can be pickled."""
    env: Env = MuscleArmEnv(strength=settings.strength)
    if scenario.memory:
        env = RememberAction(env)
    return gym.wrappers.TimeLimit(env, settings.trial_length)


def make_dynamics(scenario: ArmScenario, seed: int, settings: ArmSettings = SETTINGS) -> Dynamics:
    """The model; nothing in it is random. A model-free learner does not use it."""
    physics: Physics = opensim_arm_physics() if scenario.black_box else torque_arm_physics()
    make = scenario.dynamics or PhysicsDynamics
    return make(scenario.spec, physics)


def memory_start(n: int) -> Tensor:
    """Draw ``n x 10`` start states, with no action before them, from PyTorch's generator."""
    return torch.cat([arm_start(n), torch.zeros(n, 4, dtype=torch.float64)], dim=-1)


def functions(scenario: ArmScenario) -> dict[str, Any]:
    """The known functions, which checkpoints do not hold."""
    return {
        "reward": arm_reward,
        "initial_states": memory_start if scenario.memory else arm_start,
    }
