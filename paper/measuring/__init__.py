"""Where to measure, and what to try next: what a physics saves, or costs if it misleads."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers of a problem, shared by all its learners."""

    initial: int = 4
    """measurements of the initial design, the same for all learners of a seed"""
    budget: int = 20
    """measurements in all"""
    every: int = 1
    """measurements between two scores"""
    num_test: int = 500
    """points that the model is scored at"""
    integration_points: int = 64
    """of the integrated variance"""
    raw_samples: int = 32
    """points among which the optimisation of an acquisition function starts"""
    num_restarts: int = 2
    """of that optimisation"""
    maxiter: int = 20
    """of that optimisation"""

    def counts(self) -> range:
        """The numbers of measurements that there is a score of."""
        return range(self.initial, self.budget + 1, self.every)


_FOUR_OUTPUTS = Settings(  # more to compute at every step
    initial=8,
    budget=48,
    every=4,
    integration_points=32,
    raw_samples=16,
    num_restarts=1,
    maxiter=8,
)


@dataclass(frozen=True, kw_only=True)
class Active(Experiment):
    """How many measurements physics and the choice of points save, on four problems."""

    runs: int = 20
    """number of runs, each with an initial design of its own"""
    out: Path = Path("results/active")
    forrester: Settings = field(default_factory=Settings)
    currin: Settings = field(default_factory=lambda: Settings(initial=6, budget=30))
    park91a: Settings = field(default_factory=lambda: Settings(initial=10, budget=40, every=2))
    cartpole: Settings = field(default_factory=lambda: replace(_FOUR_OUTPUTS))

    axes: ClassVar[Axes] = {
        "problem": {
            "forrester": "Forrester, reading B",
            "currin": "currin",
            "park91a": "park91a",
            "cartpole": "cart-pole transitions",
        },
        "learner": {
            "f_p": "f_p alone",
            "phy": "physics mean, Sobol points",
            "random": "CKA, random points",
            "sobol": "CKA, Sobol points",
            "gp": "GP, integrated variance",
            "cka": "CKA, integrated variance",
            "both": "CKA, information on both",
            "rho": "CKA, information on rho",
        },
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.active.collect")
    flat: ClassVar[bool] = False

    def settings_of(self, problem: str) -> Settings:
        """The settings of a problem."""
        settings: Settings = getattr(self, problem)
        return settings

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings of the problem."""
        return asdict(self.settings_of(kind[0]))


MISLEADS = ("moved peak", "moved ridge", "unrelated")
HELPS = ("reactor", "column", "mixture")


@dataclass(frozen=True, kw_only=True)
class MisledSettings:
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
    """Bayesian optimisation with a physics that misleads, and with one that helps."""

    runs: int = 20
    """initial designs of each problem"""
    seed: int = 500
    """the first seed; 0 to 99 were for trying"""
    out: Path = Path("results/misled")
    settings: MisledSettings = field(default_factory=MisledSettings)

    axes: ClassVar[Axes] = {
        "problem": {name: name for name in MISLEADS + HELPS},
        "method": {
            "stgp": "SingleTaskGP",
            "zero": "ZeroMeanGP",
            "physics-mean": "physics mean",
            "cka": "CKA",
        },
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")
