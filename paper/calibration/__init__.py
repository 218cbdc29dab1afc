"""Do intervals hold what they say? CKA by each method of inference, on many small data sets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from paper.common.experiment import Experiment, Task

Method = Literal["map", "default", "literal", "compare", "long"]
METHODS: tuple[Method, ...] = get_args(Method)
LABELS = {
    "map": "most likely",
    "default": "default",
    "literal": "default, centre 0",
    "compare": "recommended by compare",
    "long": "16 times as many draws",
}
_PAIRS = ("currin", "branin", "bohachevsky", "booth", "park91a", "hartmann6")
# Name of the pair, observations per input, noise in standard deviations of the truth.
ROWS: tuple[tuple[str, int, float], ...] = (
    *((pair, per_input, 0.0) for pair in _PAIRS for per_input in (5, 10)),
    ("forrester", 5, 0.0),
    ("forrester", 8, 0.0),
    ("branin", 10, 0.05),
    ("park91a", 5, 0.05),
)
PUMP = "pump"  # two noisy outputs of very different units


def label(problem: str, n: int, noise: float) -> str:
    """What a row is called."""
    return f"{problem}, N = {n}" + (", noisy" if noise else "")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    num_test: int = 1000
    """points that all runs are scored at"""
    num_pump: int = 12
    """observations of the pump"""


@dataclass(frozen=True, kw_only=True)
class Calibration(Experiment):
    """CKA by each method of inference on 16 kinds of data sets, and on a pump's curves."""

    runs: int = 10
    """data sets of each kind; twice as many of the pump"""
    out: Path = Path("results/calibration")
    methods: tuple[Method, ...] = ("map", "default", "literal", "compare")
    """of inference"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "calibration"
    key: ClassVar[tuple[str, ...]] = ("problem", "per_input", "noise", "method", "seed")

    def tasks(self) -> list[Task]:
        """Each method on each data set."""
        pairs = [(*row, m, s) for row in ROWS for s in self.seeds for m in self.methods]
        pump = range(self.seed, self.seed + 2 * self.runs)
        return [*pairs, *((PUMP, 6, 1.0, m, seed) for seed in pump for m in self.methods)]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that a run depends on."""
        settings = asdict(self.settings)
        del settings["num_test" if kind[0] == PUMP else "num_pump"]
        return settings
