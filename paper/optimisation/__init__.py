"""Trials of Bayesian optimisation in Ax, by its default and with a physics, on five problems."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from paper.common.experiment import Experiment, Task

ProblemName = Literal["forrester", "branin", "six_hump_camelback", "hartmann6", "reactor"]
PROBLEMS: tuple[ProblemName, ...] = get_args(ProblemName)
LearnerName = Literal["ax", "cka", "cka-few", "map"]
LABELS: dict[str, str] = {
    "ax": "Ax's default",
    "cka": "CKA",
    "cka-few": "CKA, two initial trials",
    "map": 'CKA, `"map"`',
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    trials: int = 30
    """at most, those of the initial design included"""
    initial: int = 5
    """trials of the initial design, Ax's default: the centre and Sobol points"""
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
    problems: tuple[ProblemName, ...] = PROBLEMS
    learners: tuple[LearnerName, ...] = ("ax", "cka", "cka-few")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "optimisation"
    key: ClassVar[tuple[str, ...]] = ("problem", "learner", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "ax-platform")

    def check(self) -> None:
        """Raise an ImportError if Ax is not there."""
        import gpadjust.ax as _  # noqa: F401

    def tasks(self) -> list[Task]:
        """All combinations, seed by seed, so that what is done first can be compared."""
        return [
            (problem, learner, seed)
            for seed in self.seeds
            for problem in self.problems
            for learner in self.learners
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)
