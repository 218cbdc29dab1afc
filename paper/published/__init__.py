"""Tables and records on which others have published numbers, and: never worse than the formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from paper.calibration import PUMP, ROWS
from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels
from paper.parameters import FOLDS, NINE, RIDGES, Parameters
from paper.structures import KINDS, MEASURED, SIMULATED

TABLES = {"yacht": "yacht", "energy": "energy", "concrete": "concrete"}
OURS = {"formula": "formula, parameters fitted"} | labels("phymean", "cka", "gp")
RIVALS = {
    "single": "BoTorch's SingleTaskGP",
    "feature": "the same, formula as an input",
    "boosting": "boosted trees, formula as an input",
    "ensemble": "formula and a deep ensemble",
    "mfk": "SMT's MFK",
}


@dataclass(frozen=True, kw_only=True)
class Uci(Experiment):
    """Yacht, energy and concrete on their usual splits, with a formula each, and rivals."""

    runs: int = 20
    """splits of each table; there are twenty"""
    out: Path = Path("results/uci")

    axes: ClassVar[Axes] = {
        "table": TABLES,
        "share": {0.1: "10 %", 0.25: "25 %", 0.9: "90 %"},
        "method": {**OURS, **RIVALS},
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.ZeroMeanGP"),
        "gpadjust.CalibratedPhysics",
    )
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scikit-learn", "smt")

    def check(self) -> None:
        """Raise a ValueError for a split that there is not."""
        if not 0 <= self.seed <= 20 - self.runs:
            raise ValueError(
                f"There are twenty splits, 0 to 19; found --seed {self.seed} --runs {self.runs}."
            )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """All splits; of SMT, which is slow, with few rows alone."""
        return () if kind[2] == "mfk" and kind[1] > 0.1 else self.seeds


_TEXTBOOK = tuple(Parameters.axes["problem"])
RIGHT = ("addend", "gain, noise", "throttle, noise", "lens", "exchanger, noise")
"""Problems whose formula is taken as the truth, with noise."""
GROUPS = {
    "right": "the formula is right, with noise",
    "laws": "laws with unknown parameters",
    "kinds": "kinds of functions, right in part",
    "functions": "textbook pairs, and the pump",
    "simulated": "simulated systems",
    "measured": "records of real machines",
}
FORMULA_CELLS: tuple[tuple[str, str, int, float], ...] = (
    *(("right", name, n, 0.1) for name in RIGHT for n in (5, 10)),
    *(("laws", name, 0, 0.0) for name in (*_TEXTBOOK, *RIDGES, NINE, *FOLDS)),
    *(("kinds", name, 5, 0.0) for name in KINDS[:-2]),
    *(("functions", *row) for row in (*ROWS, PUMP)),
    *(("simulated", name, n, 0.0) for name in SIMULATED for n in (30, 75, 150)),
    *(("measured", name, n, 0.0) for name in MEASURED for n in (50, 100, 200)),
)
"""Group, problem, observations (of functions by input) and noise."""


@dataclass(frozen=True, kw_only=True)
class Formula(Experiment):
    """Is the default ever worse than the formula it was given? Over all chapters."""

    runs: int = 10
    """data sets of each cell"""
    out: Path = Path("results/formula")
    num_transitions: int = 300
    """of a simulated system, that all runs are scored at"""

    axes: ClassVar[Axes] = {
        ("group", "problem", "size", "noise"): {
            cell: "{}: {}, {}, {}".format(*cell) for cell in FORMULA_CELLS
        }
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "opensim")

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The setting that a run depends on."""
        is_simulated = kind[0] == "simulated"
        return {"num_transitions": self.num_transitions} if is_simulated else {}
