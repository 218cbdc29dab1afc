"""Does the richer model pay? CKA beside what it contains; f_p of no use, and what compare says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from paper.calibration import PUMP, ROWS
from paper.common.experiment import Axes, Experiment
from paper.common.learners import LEARNERS, labels

MODELS = labels("cka") | {"phy": LEARNERS["phymean"].label} | labels("gp", "rra")
ARM = "arm"
SIMULATED = (ARM, "cart-pole")
MEASURED = ("pendulum", "double-pendulum")
# Problem, observations per input or number of transitions, noise that is added.
CELLS: tuple[tuple[str, int, float], ...] = (
    *(*ROWS, PUMP),
    *((name, n, 0.0) for name in SIMULATED for n in (30, 75, 150)),
    *((name, n, 0.0) for name in MEASURED for n in (50, 100, 200)),
)
GROUPS = {
    **dict.fromkeys((name for name, *_ in (*ROWS, PUMP)), "functions"),
    **dict.fromkeys(SIMULATED, "simulated systems"),
    **dict.fromkeys(MEASURED, "real machines"),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    num_test: int = 1000
    """points of a function that all runs are scored at"""
    num_pump: int = 12
    """observations of the pump"""
    num_transitions: int = 300
    """of a simulated system, that all runs are scored at"""


@dataclass(frozen=True, kw_only=True)
class Structures(Experiment):
    """CKA and RRA beside the models that they contain, on functions, transitions and records."""

    runs: int = 5
    """data sets of each cell"""
    out: Path = Path("results/structures")
    settings: Settings = field(default_factory=Settings)

    axes: ClassVar[Axes] = {
        ("problem", "size", "noise"): {cell: "{}, {}".format(*cell) for cell in CELLS},
        "model": MODELS,
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.RRA"),
        "gpadjust.dynamics.LearnedDynamics",
    )
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "opensim")

    def check(self) -> None:
        """Raise an ImportError if OpenSim is missing."""
        if any(case[0] == ARM for case in self.cases()) and find_spec("opensim") is None:
            raise ImportError('The arm needs OpenSim; run `pip install "gpadjust[arm]"`.')

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that a run depends on."""
        needed = {"functions": "num_test", "simulated systems": "num_transitions"}
        name = "num_pump" if kind[:3] == PUMP else needed.get(GROUPS[kind[0]])
        return {k: v for k, v in asdict(self.settings).items() if k == name}


_ONE = ("wave", "bell, noise", "saddle", "front, noise", "bowl, noise")
_MORE = ("rate, noise", "blend", "friedman, noise", "lift", "eight, noise")
OF_NO_USE = _ONE + _MORE
"""Problems whose f_p has nothing to do with the data, of five and ten points each input."""
KINDS = (
    *("addend", "gain, noise", "decay", "phase", "sign", "offset", "moved peak", "beam"),
    *("throttle, noise", "uptake, noise", "lens", "pipe, noise", "exchanger, noise", "kink"),
    *("unrelated, noise", "unrelated"),
)
"""Kinds of data sets of which structures are compared, of five points each input."""


@dataclass(frozen=True, kw_only=True)
class ChoiceSettings:
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
    settings: ChoiceSettings = field(default_factory=ChoiceSettings)

    axes: ClassVar[Axes] = {
        "problem": {name: name for name in OF_NO_USE + KINDS},
        "per_input": {5: "N = 5 d", 10: "N = 10 d"},
        "method": {"zero": "ZeroMeanGP"} | labels("cka", "compare"),
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.compare")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Ten points each input where f_p is of no use alone."""
        return self.seeds if kind[1] == 5 or kind[0] in OF_NO_USE else ()
