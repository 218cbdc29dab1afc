"""Do intervals hold what they say? CKA by each method of inference, and by several seeds of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from paper.common.experiment import Axes, Experiment

METHODS = {
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
PUMP = ("pump", 6, 1.0)  # two noisy outputs of very different units


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
    settings: Settings = field(default_factory=Settings)

    axes: ClassVar[Axes] = {
        ("problem", "per_input", "noise"): {row: label(*row) for row in (*ROWS, PUMP)},
        "method": METHODS,
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.compare")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Twice as many of the pump; long sampling only where it is named."""
        if kind[-1] == "long" and "long" not in self.only:
            return ()
        return range(self.seed, self.seed + (1 + (kind[:3] == PUMP)) * self.runs)

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that a run depends on."""
        settings = asdict(self.settings)
        del settings["num_test" if kind[:3] == PUMP else "num_pump"]
        return settings


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
"""Twelve data sets that are fitted by several seeds."""
SMOOTH = (Data(7, 5, 0.0), Data(8, 5, 0.0))
"""Two kinds of data sets, for the coverage."""
SHORT, LONG, MANY = "default", "long", "other data"


@dataclass(frozen=True, kw_only=True)
class SeedsSettings:
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
    settings: SeedsSettings = field(default_factory=SeedsSettings)

    axes: ClassVar[Axes] = {
        "data": {str(data): str(data) for data in dict.fromkeys(SETS + SMOOTH)},
        "fit": {kind: kind for kind in (SHORT, LONG, MANY)},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Fits by seed, long ones, and fits of other data."""
        data, fit = kind
        if data not in map(str, SMOOTH if fit == MANY else SETS):
            return ()
        number = {SHORT: self.runs, LONG: self.long_runs, MANY: self.smooth_sets}[fit]
        return range(self.seed, self.seed + number)
