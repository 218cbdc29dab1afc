"""Do learnt dynamics know what they do not know? Coverage of trials that they have not seen."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from paper.arm import Arm
from paper.cartpole import CartPole
from paper.common.experiment import Experiment, Task
from paper.control import Control

LEARNER = "cka"
SYSTEMS = {"cartpole": "cart-pole", "arm": "arm"}
NOISES = {"none": "none", "sensors": "sensors'"}
METHODS = {"default": "default", "map": "most likely, centre 0"}
# Standard deviations of the sensors of the states that models predict.
SENSORS = {
    "x": 0.01,
    "theta": 0.01,
    "x_dot": 0.05,
    "theta_dot": 0.05,
    "theta_s": 0.01,
    "theta_e": 0.01,
    "theta_s_dot": 0.05,
    "theta_e_dot": 0.05,
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    trials: int = 7
    """real trials of an agent; dynamics learn from all but the last"""
    model_episodes: int = 10
    """episodes in the model after each of them, half as many as in the control experiments"""
    updates_per_model_step: float = 1.0
    """gradient steps for each step in the model, half as many as there"""
    horizons: tuple[int, ...] = (5, 15)
    """steps of the trajectories"""
    max_windows: int = 6
    """the most of these of a trial, evenly spread"""
    num_functions: int = 39
    """that follow them"""


@dataclass(frozen=True, kw_only=True)
class Foresight(Experiment):
    """Dynamics of the cart-pole and the arm, learnt trial by trial, foresee the next trial."""

    runs: int = 5
    """agents of each system, each with a seed of its own"""
    out: Path = Path("results/foresight")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "foresight"
    key: ClassVar[tuple[str, ...]] = ("system", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "stable_baselines3", "opensim")

    def check(self) -> None:
        """Whether there is OpenSim, and trials enough."""
        if self.settings.trials < 3:
            raise ValueError(f"--trials: expected at least 3, got {self.settings.trials}")
        self.control("arm").check()

    def tasks(self) -> list[Task]:
        """Both systems, seed by seed."""
        return [(system, seed) for seed in self.seeds for system in SYSTEMS]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and those of the control experiment that the agent is of."""
        agent = asdict(self.control(kind[0]).settings)
        own = asdict(self.settings)
        return {**own, "sensors": SENSORS, "agent": {k: agent[k] for k in agent if k not in own}}

    def control(self, system: str) -> Control:
        """The experiment whose system, physics and agent these are."""
        control: Control = {"cartpole": CartPole, "arm": Arm}[system]()
        own = self.settings
        return replace(
            control,
            settings=replace(
                control.settings,
                episodes=own.trials,
                model_episodes=own.model_episodes,
                updates_per_model_step=own.updates_per_model_step,
                last_model_episode=own.trials - 1,
            ),
        )
