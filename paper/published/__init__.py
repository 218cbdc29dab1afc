"""Tables and records on which others have published numbers, and: never worse than the formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels
from paper.parameters import LAWS, Parameters
from paper.structures import KINDS, MEASURED, PUMP, ROWS, SIMULATED

TABLES = {"yacht": "yacht", "energy": "energy", "concrete": "concrete"}
OURS = {"formula": "formula, parameters fitted"} | labels("phymean", "cka", "gp")
RIVALS = {
    "single": "BoTorch's SingleTaskGP",
    "feature": "SingleTaskGP, formula as an input",
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
NIST_SETS = (
    *("Misra1a", "Chwirut2", "Chwirut1", "Lanczos3", "Gauss1", "Gauss2", "DanWood", "Misra1b"),
    *("Kirby2", "Hahn1", "Nelson", "MGH17", "Lanczos1", "Lanczos2", "Gauss3", "Misra1c"),
    *("Misra1d", "Roszman1", "ENSO", "MGH09", "Thurber", "BoxBOD", "Rat42", "MGH10"),
    *("Eckerle4", "Rat43", "Bennett5"),
)
"""In NIST's order of difficulty: 8 lower, 11 average, 8 higher."""
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
    *(("laws", name, 0, 0.0) for name in (*_TEXTBOOK, *LAWS)),
    *(("kinds", name, 5, 0.0) for name in KINDS),
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
    seed: int = 200
    """the first seed; 0 to 3, 100 to 109 and from 1000 on were for trying"""
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


_DYNAMICS = (
    "gpadjust.fit",
    "gpadjust.dynamics.LearnedDynamics",
    "gpadjust.dynamics.Dynamics.free_run",
    "gpadjust.records.smooth",
)

EMPS_GPS = {"delta": "f_p, smoothed, + delta", "cka": "CKA of f_p, smoothed", "gp": "GP, no f_p"}
"""Learners of the servo that learn from a draw of the smoothed states, one for each seed."""


@dataclass(frozen=True, kw_only=True)
class EmpsSettings:
    """Settings that decide the numbers, fixed before the first run."""

    rows: int = 4968
    """of each record, the first ones"""
    every: int = 5
    """rows of 5 ms in a step"""
    rounds: int = 100
    """of smoothing, at most"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Emps(Experiment):
    """A servo with dry friction: the record with force pulses, simulated by what another taught."""

    runs: int = 5
    """draws of the smoothed states; what does not learn from these has one run"""
    seed: int = 10
    """the first seed; 0 and 1 were for trying"""
    out: Path = Path("results/emps")
    settings: EmpsSettings = field(default_factory=EmpsSettings)

    axes: ClassVar[Axes] = {
        "learner": {
            "authors": "f_p, the authors' least squares",
            "fitted": "f_p, smoothed",
            "held": "f_p, smoothed, little process noise",
            **EMPS_GPS,
        }
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of what does not learn from draws."""
        return self.seeds if kind[0] in EMPS_GPS else self.seeds[:1]


RECORDS = {
    "ballbeam": "ball and beam",
    "furnace": "gas furnace",
    "drive": "drive",
    "tanks": "two tanks",
}
FREE_GPS = {"delta": "f_p + delta", "cka": "CKA", "gp": "GP, no f_p"}
"""Learners of the records that learn from draws of the smoothed states, or from the records."""

AFTER = "after"
"""An f_p of the tanks that was thought of after the hidden level had been seen; never chosen."""


@dataclass(frozen=True, kw_only=True)
class FreerunsSettings:
    """Settings that decide the numbers, fixed before the first run."""

    transitions: int = 300
    """that GPs learn from, spread evenly, or as many as there are"""
    rounds: int = 100
    """of smoothing, at most"""
    starts: int = 2
    """of smoothing"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Freeruns(Experiment):
    """The first part of a record teaches, and a free run follows the rest."""

    runs: int = 3
    """draws of what is learnt from; f_p alone has one run"""
    seed: int = 10
    """the first seed; 0 was for trying"""
    out: Path = Path("results/freeruns")
    settings: FreerunsSettings = field(default_factory=FreerunsSettings)

    axes: ClassVar[Axes] = {
        "record": RECORDS,
        "learner": {"fitted": "f_p, smoothed", **FREE_GPS, AFTER: "f_p of equal holes, afterwards"},
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of f_p alone."""
        if kind[1] == AFTER and kind[0] != "tanks":
            return ()
        return self.seeds if kind[1] in FREE_GPS else self.seeds[:1]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and the candidates among which the training part chooses."""
        from paper.published.freeruns_systems import SYSTEMS

        return {**asdict(self.settings), **SYSTEMS[kind[0]].describe()}


@dataclass(frozen=True, kw_only=True)
class MassesSettings:
    """What decides the numbers."""

    split: int = 0
    """seed of the ten folds"""
    num_rows: int = 600
    """random rows for the search for hyper-parameters, and for f_p alone"""
    stride: int = 1
    """every how many-th element is taken"""


@dataclass(frozen=True, kw_only=True)
class Masses(Experiment):
    """Binding energies of nuclides: a liquid drop and what it lacks."""

    runs: int = 10
    """folds of ten that are left out"""
    out: Path = Path("results/masses")
    settings: MassesSettings = field(default_factory=MassesSettings)

    axes: ClassVar[Axes] = {
        "task": {
            "fold": "ten folds",
            "outer2": "outermost 2",
            "outer4": "outermost 4",
            "unmeasured": "not measured",
        },
        ("physics", "model"): {
            ("drop", "mean"): "liquid drop, physics mean",
            ("drop", "cka"): "liquid drop, CKA",
            ("drop", "trees"): "liquid drop, boosted trees on its residual",
            ("drop", "alone"): "liquid drop alone, calibrated",
            ("shell", "mean"): "with shell term, physics mean",
            ("shell", "cka"): "with shell term, CKA",
            ("shell", "trees"): "with shell term, boosted trees on its residual",
            ("shell", "alone"): "with shell term alone, calibrated",
            ("none", "gp"): "GP without physics",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.ZeroMeanGP"),
        "gpadjust.CalibratedPhysics",
    )

    def seeds_of(self, task: str, *kind: Any) -> Sequence[int]:
        """The folds that are left out; one run of the other tasks."""
        return self.seeds if task == "fold" else self.seeds[:1]


@dataclass(frozen=True, kw_only=True)
class Nist(Experiment):
    """NIST's certified nonlinear regressions: values and intervals from both starts."""

    runs: int = 2
    """seeds of each set and start"""
    out: Path = Path("results/nist")

    axes: ClassVar[Axes] = {
        "name": {name: name for name in NIST_SETS},
        "start": {1: "start 1", 2: "start 2"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CalibratedPhysics")
