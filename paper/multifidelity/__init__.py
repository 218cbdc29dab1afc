"""Functions of low and high fidelity: eight methods, few observations, several data sets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from paper.common.experiment import Experiment, Task

Method = Literal["GP", "Phy", "AR1", "SMT MFK", "CKA", "CKA Bayes", "RRA"]
METHODS: tuple[Method, ...] = get_args(Method)
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
    """Seven methods learn textbook functions of high fidelity; f_p is that of low fidelity."""

    runs: int = 10
    """data sets; the number is the seed"""
    out: Path = Path("results/multifidelity")
    pairs: tuple[str, ...] = PAIRS
    """of ``paper.multifidelity.functions``"""
    methods: tuple[Method, ...] = METHODS
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "multifidelity"
    key: ClassVar[tuple[str, ...]] = ("pair", "per_input", "method", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "smt")

    def check(self) -> None:
        """Raise a ValueError for a pair that is not there."""
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
