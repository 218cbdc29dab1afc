"""Controllers for systems that people know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels


@dataclass(frozen=True, kw_only=True)
class KnownSettings:
    """Settings that decide the numbers; found with the true systems and seeds of 20 and more."""

    trials: int = 3
    """real trials of a run, of which the first goes by f_p, or is random where there is none"""
    horizon: int = 10
    """steps that are planned ahead at each step"""
    sequences: int = 64
    """of these, in each round of the cross-entropy method"""
    spread: float = 0.15
    """of these about the earlier plan, in shares of the range of the actions"""
    rounds: int = 1
    """of these after the first"""
    first_rounds: int = 4
    """of these when a trial begins, with all its steps"""
    elites: int = 8
    """of these"""
    networks: int = 5
    """of an ensemble"""
    training: int = 400
    """steps of Adam after each trial, of these"""


SEEDS = {"furuta": 5, "quadrotor": 5, "double_pendulum": 5}
"""The most seeds of systems on which a run takes long."""


@dataclass(frozen=True, kw_only=True)
class Known(Experiment):
    """Systems that people know, with rivals on the same trials."""

    out: Path = Path("results/known")
    settings: KnownSettings = field(default_factory=KnownSettings)

    axes: ClassVar[Axes] = {
        "system": {
            "pendulum": "Pendulum-v1",
            "furuta": "Furuta pendulum",
            "quadrotor": "planar quadrotor",
            "double_pendulum": "pendubot",
            "tanks": "two tanks",
            "reacher": "Reacher-v5",
        },
        "learner": labels("cka", "phymean", "phy", "fitted", "gp")
        | {
            "ensemble": "f_p and an ensemble of networks",
            "networks": "an ensemble of networks",
        }
        | labels("oracle"),
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium", "mujoco")
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.control.Planner",
        "gpadjust.control.CrossEntropy",
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Some systems have few seeds."""
        return self.seeds[: SEEDS.get(kind[0])]
