"""Where to measure, and what to try next: how many measurements and trials a physics saves."""

from __future__ import annotations

from collections.abc import Sequence
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
    num_screened: int = 64
    """starts of a fit, beside the hyper-parameters of the last one"""
    num_starts: int = 4
    """of these, how many are optimised"""
    max_iterations: int = 100
    """of a fit"""

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
    num_screened=16,
    num_starts=2,
    max_iterations=30,
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


@dataclass(frozen=True, kw_only=True)
class OptimisationSettings:
    """What decides the numbers."""

    trials: int = 30
    """at most, those of the initial design included"""
    initial: int = 5
    """trials of the initial design, Ax's default: the center and Sobol points"""
    few: int = 2
    """trials of the initial design of `cka-few`"""
    regret: float = 0.01
    """a run ends with the trial that is so near to the best value there is, in units of what the
    median of random points is away from it"""
    num_random: int = 4096
    """Sobol points that tell this median, and from which the best value is searched"""


@dataclass(frozen=True, kw_only=True)
class Optimisation(Experiment):
    """How many trials a physics saves in Ax, on five problems."""

    runs: int = 20
    """number of runs, each with an initial design of its own"""
    out: Path = Path("results/optimisation")
    settings: OptimisationSettings = field(default_factory=OptimisationSettings)

    axes: ClassVar[Axes] = {
        "problem": {
            "forrester": "forrester",
            "branin": "branin",
            "six_hump_camelback": "six-hump camelback",
            "hartmann6": "hartmann6",
            "reactor": "reactor, by-product limited",
        },
        "learner": {
            "ax": "Ax's default",
            "cka": "CKA",
            "cka-few": "CKA, two initial trials",
            "map": 'CKA, `"map"`',
        },
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.ax.generation_strategy")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "ax-platform")

    def check(self) -> None:
        """Raise an ImportError if Ax is not there."""
        import gpadjust.ax as _  # noqa: F401

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """The most likely fit only where it is named."""
        return self.seeds if kind[1] != "map" or "map" in self.only else ()


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
