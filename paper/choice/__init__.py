"""Physics of no use, and what `compare` recommends, on small data sets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

OF_NO_USE = (
    "wave",
    "bell, noise",
    "saddle",
    "front, noise",
    "bowl, noise",
    "rate, noise",
    "blend",
    "friedman, noise",
    "lift",
    "eight, noise",
)
"""Problems whose f_p has nothing to do with the data, of five and ten points each input."""
KINDS = (
    "addend",
    "gain, noise",
    "decay",
    "phase",
    "sign",
    "offset",
    "moved peak",
    "beam",
    "throttle, noise",
    "uptake, noise",
    "lens",
    "pipe, noise",
    "exchanger, noise",
    "kink",
    "unrelated, noise",
    "unrelated",
)
"""Kinds of data sets of which structures are compared, of five points each input."""
METHODS = {"zero": "ZeroMeanGP", "cka": "CKA", "compare": "recommended by compare"}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    num_test: int = 500
    """points of a Sobol sequence that all runs are scored at"""


@dataclass(frozen=True, kw_only=True)
class Choice(Experiment):
    """The default CKA, a plain Gaussian process, and `compare`, on small data sets."""

    runs: int = 4
    """data sets of each problem and number of points"""
    seed: int = 800
    """the first seed; 0 to 99 were for trying, 700 and 701 for a first run"""
    out: Path = Path("results/choice")
    problems: tuple[str, ...] = OF_NO_USE + KINDS
    """that are learnt"""
    methods: tuple[str, ...] = tuple(METHODS)
    """that learn them"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "choice"
    key: ClassVar[tuple[str, ...]] = ("problem", "per_input", "method", "seed")

    def check(self) -> None:
        """Refuse problems and methods that there are none of."""
        for found, known in ((self.problems, OF_NO_USE + KINDS), (self.methods, tuple(METHODS))):
            if not {*found} <= {*known}:
                raise ValueError(f"Expected some of {', '.join(known)}, found {', '.join(found)}.")

    def tasks(self) -> list[Task]:
        """All methods on a data set before the next one."""
        return [
            (problem, per_input, method, seed)
            for seed in self.seeds
            for problem in self.problems
            for per_input in ((5, 10) if problem in OF_NO_USE else (5,))
            for method in self.methods
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)
