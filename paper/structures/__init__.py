"""Does the richer model pay? CKA and RRA beside what they contain."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import LEARNERS, labels

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


KINDS = (
    *("addend", "gain, noise", "decay", "phase", "sign", "offset", "moved peak", "beam"),
    *("throttle, noise", "uptake, noise", "lens", "pipe, noise", "exchanger, noise", "kink"),
)
"""Functions of the unit cube whose physics is right in part."""


def label(problem: str, n: int, noise: float) -> str:
    """What a row is called."""
    return f"{problem}, N = {n}" + (", noisy" if noise else "")
