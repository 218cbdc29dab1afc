"""Many observations: inducing points for all of them, or an exact model of some."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

PROBLEMS = ("hartmann6", "links")
LEARNERS = ("variational", "exact")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    many: int = 100_000
    """observations of the models with inducing points"""
    some: tuple[int, ...] = (1000, 2000)
    """observations of the exact ones"""
    most: int = 5000
    """the most observations of an exact one, of the first problem and the first seed alone"""
    num_inducing: int = 1000
    """inducing points"""
    num_test: int = 3000
    """points at which functions are compared"""


@dataclass(frozen=True, kw_only=True)
class Large(Experiment):
    """Two systems with six inputs: how near and how sure are models of many observations?"""

    runs: int = 3
    """data sets; the number is the seed"""
    seed: int = 1
    """the first seed; that of 0 is what was tuned on"""
    out: Path = Path("results/large")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "large"
    key: ClassVar[tuple[str, ...]] = ("problem", "learner", "observations", "seed")

    def tasks(self) -> list[Task]:
        """The models with inducing points first."""
        variational, exact = LEARNERS
        settings, first = self.settings, self.seeds[0]
        return [
            *((p, variational, settings.many, seed) for seed in self.seeds for p in PROBLEMS),
            *((p, exact, n, seed) for n in settings.some for seed in self.seeds for p in PROBLEMS),
            (PROBLEMS[0], exact, settings.most, first),
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that a run depends on."""
        settings = asdict(self.settings)
        own = {
            "variational": ("num_inducing", "num_test"),
            "exact": ("num_test",),
        }
        return {name: settings[name] for name in own[kind[1]]}
