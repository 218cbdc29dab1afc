"""Forrester's function: eight models, eight observations, a hundred runs (the paper's sec. 3.1)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

FIRST_LOOK = 3  # data sets


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    observations: int = 8
    """noise-free observations of a data set"""
    noise: float = 0.01
    """the fixed noise variance of the paper's protocol, and its ridge"""
    steps: int = 50
    """of Adam, in the paper's protocol"""
    rate: float = 0.1
    """of Adam, in the paper's protocol"""
    lengthscales: tuple[float, ...] = (0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
    """of the literal closed form of RRA, on a grid"""
    ridges: tuple[float, ...] = (1e-6, 1e-4, 1e-2, 1.0)
    """of the literal closed form of RRA, on a grid"""


@dataclass(frozen=True, kw_only=True)
class Forrester(Experiment):
    """Eight models learn Forrester's function (figure 1), by two protocols of training."""

    runs: int = 100
    """data sets; the number is the seed"""
    out: Path = Path("results/forrester")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "forrester"
    key: ClassVar[tuple[str, ...]] = ("reading", "protocol", "seed")

    def tasks(self) -> list[Task]:
        """Readings of the crude function and protocols, data set by data set."""
        parts = [("B", "gpadjust"), ("B", "paper")]
        early = [(*part, seed) for seed in self.seeds[:FIRST_LOOK] for part in parts]
        parts += [("A", "gpadjust"), ("A", "paper"), ("B", "closed form")]
        return [*dict.fromkeys([*early, *((*part, seed) for seed in self.seeds for part in parts)])]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)
