"""What the control tasks cost at best: by open loops in the known cart-pole, by long learning."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.cartpole import NUM_STARTS
from paper.common.experiment import Experiment, Task

SYSTEMS = ("mean-start", "fixed-starts", "arm")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    sequences: int = 1000
    """of actions, that each round of the cross-entropy method looks at"""
    rounds: int = 40
    """of the cross-entropy method"""
    elites: int = 200
    """of the cross-entropy method"""
    restarts: int = 3
    """of the cross-entropy method, which ends in local optima"""
    arm_runs: int = 1
    """of SAC on the true arm"""
    arm_episodes: int = 1000
    """of these, far more than the experiment's"""
    arm_updates: int = 60
    """gradient steps after each of these episodes"""


@dataclass(frozen=True, kw_only=True)
class Floor(Experiment):
    """The best open loops found for the known cart-pole, and SAC for long on the true arm."""

    runs: int = 20
    """fixed starts of the cart-pole, each with an open loop of its own"""
    out: Path = Path("results/floor")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "floor"
    key: ClassVar[tuple[str, ...]] = ("system", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "stable_baselines3", "opensim")

    def check(self) -> None:
        """Refuse more fixed starts than there are."""
        if self.seeds.start < 0 or self.seeds.stop > NUM_STARTS:
            raise ValueError(
                f"There are {NUM_STARTS} fixed starts, of the seeds 0 to {NUM_STARTS - 1}; found "
                f"the seeds {self.seeds.start} to {self.seeds.stop - 1}."
            )

    def tasks(self) -> list[Task]:
        """The cheap ones first."""
        mean, fixed, arm = SYSTEMS
        return [
            *((mean, seed) for seed in self.seeds[:3]),
            *((fixed, seed) for seed in self.seeds),
            *((arm, seed) for seed in self.seeds[: self.settings.arm_runs]),
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings of the system."""
        arm = kind[0] == "arm"
        return {k: v for k, v in asdict(self.settings).items() if k.startswith("arm_") == arm}
