"""Bayesian optimisation with a physics that misleads, and with one that helps."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

MISLEADS = ("moved peak", "moved ridge", "unrelated")
HELPS = ("reactor", "column", "mixture")
METHODS = {
    "stgp": "SingleTaskGP",
    "zero": "ZeroMeanGP",
    "physics-mean": "physics mean",
    "cka": "CKA",
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    initial: int = 5
    """trials of a scrambled Sobol sequence, before a model is asked"""
    trials: int = 15
    """that follow, each at the optimum of qLogEI"""
    restarts: int = 4
    """of the optimisation of qLogEI"""
    raw_samples: int = 128
    """of the same"""
    mc_samples: int = 64
    """of qLogEI"""


@dataclass(frozen=True, kw_only=True)
class Misled(Experiment):
    """Regret after each trial, by models with and without the physics."""

    runs: int = 20
    """initial designs of each problem"""
    seed: int = 500
    """the first seed; 0 to 99 were for trying"""
    out: Path = Path("results/misled")
    problems: tuple[str, ...] = MISLEADS + HELPS
    """whose optimum is sought"""
    methods: tuple[str, ...] = tuple(METHODS)
    """models that seek it"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "misled"
    key: ClassVar[tuple[str, ...]] = ("problem", "method", "seed")

    def check(self) -> None:
        """Refuse problems and methods that there are none of."""
        for found, known in ((self.problems, MISLEADS + HELPS), (self.methods, tuple(METHODS))):
            if not {*found} <= {*known}:
                raise ValueError(f"Expected some of {', '.join(known)}, found {', '.join(found)}.")

    def tasks(self) -> list[Task]:
        """All methods on a design before the next one."""
        return [
            (problem, method, seed)
            for seed in self.seeds
            for problem in self.problems
            for method in self.methods
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)
