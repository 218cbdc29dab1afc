"""Functions of low and high fidelity: eight methods, few observations, several data sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from paper.common.experiment import Experiment, Record, Table, Task

Method = Literal["GP", "Phy", "AR1", "SMT MFK", "CKA", "CKA Bayes", "chosen", "RRA"]
METHODS: tuple[Method, ...] = ("GP", "Phy", "AR1", "SMT MFK", "CKA", "CKA Bayes", "chosen", "RRA")
PAIRS = ("currin", "branin", "bohachevsky", "booth", "park91a", "hartmann6")
FIRST_LOOK = 8  # runs


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    sizes: tuple[int, ...] = (5, 10)
    """observations per input"""
    num_test: int = 1000
    """points that all runs are scored at"""
    num_low: int = 20
    """samples of the low level per input, for the methods that need them"""


@dataclass(frozen=True, kw_only=True)
class Multifidelity(Experiment):
    """Eight methods learn textbook functions of high fidelity; f_p is that of low fidelity."""

    runs: int = 10
    """data sets; the number is the seed"""
    out: Path = Path("results/multifidelity")
    pairs: tuple[str, ...] = PAIRS
    """problems of mf2"""
    methods: tuple[Method, ...] = METHODS
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "multifidelity"
    key: ClassVar[tuple[str, ...]] = ("pair", "per_input", "method", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "smt", "mf2")

    def check(self) -> None:
        """Whether mf2 has the pairs."""
        from paper.multifidelity.problem import pair

        for name in self.pairs:
            pair(name)

    def tasks(self) -> list[Task]:
        """Each method on each data set."""
        return [
            (name, per_input, method, seed)
            for name in self.pairs
            for per_input in self.settings.sizes
            for seed in self.seeds
            for method in self.methods
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that a run depends on, which are all but the sizes of others."""
        settings = asdict(self.settings)
        del settings["sizes"]
        return settings

    def run(self, *task: Any, unfinished: Path) -> Record:
        """Train and score a method on a data set."""
        from paper.multifidelity.models import scores

        return scores(*task, self.settings)

    def first_look(self, records: Sequence[Record]) -> str | None:
        """The errors of the first runs."""
        from paper.multifidelity.tables import first_rows

        return first_rows(records[:FIRST_LOOK]) if len(records) >= FIRST_LOOK else None

    def tables(self, records: Sequence[Record]) -> dict[str, Table]:
        """Scores, comparisons and the verdict on the intervals."""
        from paper.multifidelity.tables import load, tables

        return tables(load(records))

    def draw(self, records: Sequence[Record]) -> list[Path]:
        """All runs, a figure for each of three scores."""
        from paper.multifidelity.figure import COLUMNS, draw
        from paper.multifidelity.tables import load

        runs = load(records)
        return [draw(runs, column, self.out / f"{column}.png") for column in COLUMNS]
