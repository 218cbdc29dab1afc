"""How far the seed of a fit moves its answer, and how far that is from one of long sampling."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from paper.common.experiment import Experiment, Task

LONG = "long"
SHORT = "default"
MANY = "other data"


class Data(NamedTuple):
    """A data set: its inputs, measurements for each of them, and the noise's standard deviation."""

    num_inputs: int
    each: int
    noise: float

    def __str__(self) -> str:
        """As tables say it."""
        return f"d = {self.num_inputs}, n = {self.each * self.num_inputs}, noise {self.noise:g}"


SETS = (
    *(Data(1, 5, 0.0), Data(1, 10, 0.1), Data(2, 5, 0.1), Data(2, 10, 0.0)),
    *(Data(3, 5, 0.0), Data(3, 10, 0.1), Data(4, 5, 0.1), Data(5, 10, 0.0)),
    *(Data(6, 5, 0.1), Data(6, 10, 0.0), Data(7, 5, 0.1), Data(8, 5, 0.0)),
)
SMOOTH = (Data(7, 5, 0.0), Data(8, 5, 0.0))
"""Twelve data sets for the seeds, and two kinds for the coverage."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    points: int = 200
    """new inputs, at which answers are compared"""
    effort: int = 16
    """of long sampling, in multiples of the default"""
    samples: int = 256
    """that a model holds after long sampling"""


@dataclass(frozen=True, kw_only=True)
class Seeds(Experiment):
    """Fits of the same data by several seeds; and fits of data sets of their own."""

    seed: int = 700
    """the first seed of a fit; others were for trying"""
    out: Path = Path("results/seeds")
    long_runs: int = 2
    """fits of long sampling of each data set"""
    smooth_sets: int = 20
    """data sets of each smooth function without noise"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "seeds"
    key: ClassVar[tuple[str, ...]] = ("data", "fit", "seed")

    def tasks(self) -> list[Task]:
        """Fits by seed, long ones, and fits of other data."""
        seeds = [(str(data), SHORT, seed) for data in SETS for seed in self.seeds]
        longer = [(str(data), LONG, self.seed + i) for data in SETS for i in range(self.long_runs)]
        other = [
            (str(data), MANY, self.seed + i) for data in SMOOTH for i in range(self.smooth_sets)
        ]
        return seeds + longer + other

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)
