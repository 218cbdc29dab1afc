"""Forrester's function: eight models, eight observations, a hundred runs (the paper's sec. 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Record, Table, Task

FIGURE_SEED = 3  # the data set of the six fits
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

    def run(self, *task: Any, unfinished: Path) -> Record:
        """Train and score all models on a data set."""
        from paper.forrester.models import scores

        return scores(*task, self.settings)

    def first_look(self, records: Sequence[Record]) -> str | None:
        """The errors on the first data sets."""
        from paper.forrester.tables import errors, load

        runs = load(records)
        runs = runs[(runs["reading"] == "B") & (runs["protocol"] != "closed form")]
        sets = runs.groupby("protocol")["seed"].nunique()
        if len(sets) < 2 or sets.min() < FIRST_LOOK:
            return None
        return f"The first {sets.min()} data sets, reading B, mean / median RMSE\n\n" + errors(runs)

    def tables(self, records: Sequence[Record]) -> dict[str, Table]:
        """Errors, scores, verdicts and the grid."""
        from paper.forrester.tables import load, tables

        return tables(load(records))

    def draw(self, records: Sequence[Record]) -> list[Path]:
        """The paper's figure 1, for each protocol."""
        from paper.forrester.figure import draw
        from paper.forrester.tables import PROTOCOLS, load

        runs = load(records)
        return [
            draw(
                runs,
                protocol,
                "B",
                FIGURE_SEED,
                self.settings,
                self.out / f"forrester_{protocol}.png",
            )
            for protocol in PROTOCOLS
        ]
