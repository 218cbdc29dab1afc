"""Tables and records on which others have published numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

TABLES = ("yacht", "energy", "concrete")
OURS = {"formula": "formula, parameters fitted"} | labels("phymean", "cka", "gp")
RIVALS = {
    "single": "BoTorch's SingleTaskGP",
    "feature": "SingleTaskGP, formula as an input",
    "boosting": "boosted trees, formula as an input",
    "ensemble": "formula and a deep ensemble",
    "mfk": "SMT's MFK",
}
_CALLS = (
    *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.ZeroMeanGP"),
    "gpadjust.CalibratedPhysics",
)


@dataclass(frozen=True, kw_only=True)
class Uci(Experiment):
    """Yacht, energy and concrete on their usual splits, with a formula each, and rivals."""

    axes: ClassVar[Axes] = {
        "table": {name: name for name in TABLES},
        "share": {0.1: "10 %", 0.9: "90 %"},
        "method": {**OURS, **RIVALS},
    }
    calls: ClassVar[tuple[str, ...]] = _CALLS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scikit-learn", "smt")

    def check(self) -> None:
        """Raise a ValueError for a split that there is not."""
        if not 0 <= self.seed <= 20 - self.runs:
            raise ValueError(
                f"There are twenty splits, 0 to 19; found --seed {self.seed} --runs {self.runs}."
            )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """All splits, three of the large tables by nine tenths; of what is slow, few rows alone."""
        table, share, method = kind
        if method in ("mfk", "boosting", "phymean") and share > 0.1:
            return ()
        if method == "mfk" and table == "concrete":
            return ()
        return self.seeds[:3] if share > 0.1 and table != "yacht" else self.seeds


@dataclass(frozen=True, kw_only=True)
class Steels(Experiment):
    """Yield strengths of 312 steels by ten lines of metallurgy, in the five folds of Matbench."""

    runs: int = 5
    """folds; there are five"""

    axes: ClassVar[Axes] = {
        "method": {"formula": "formula, parameters fitted"}
        | labels("phymean", "cka", "gp")
        | {"boosting": "boosted trees, formula as an input"},
    }
    calls: ClassVar[tuple[str, ...]] = _CALLS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scikit-learn")

    def check(self) -> None:
        """Raise a ValueError for a fold that there is not."""
        if not 0 <= self.seed <= 5 - self.runs:
            raise ValueError(
                f"There are five folds, 0 to 4; found --seed {self.seed} --runs {self.runs}."
            )


NIST_SETS = (
    *("Misra1a", "Chwirut2", "Chwirut1", "Lanczos3", "Gauss1", "Gauss2", "DanWood", "Misra1b"),
    *("Kirby2", "Hahn1", "Nelson", "MGH17", "Lanczos1", "Lanczos2", "Gauss3", "Misra1c"),
    *("Misra1d", "Roszman1", "ENSO", "MGH09", "Thurber", "BoxBOD", "Rat42", "MGH10"),
    *("Eckerle4", "Rat43", "Bennett5"),
)
"""In NIST's order of difficulty: 8 lower, 11 average, 8 higher."""


@dataclass(frozen=True, kw_only=True)
class Nist(Experiment):
    """NIST's certified nonlinear regressions: values and intervals from both starts."""

    runs: int = 2
    """seeds of each set and start"""

    axes: ClassVar[Axes] = {
        "name": {name: name for name in NIST_SETS},
        "start": {1: "start 1", 2: "start 2"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CalibratedPhysics")


_DYNAMICS = (
    *("gpadjust.dynamics.LearnedDynamics", "gpadjust.dynamics.Dynamics.free_run"),
    "gpadjust.records.smooth",
)


@dataclass(frozen=True, kw_only=True)
class Emps(Experiment):
    """A servo with dry friction: the record with force pulses, simulated by what another taught."""

    runs: int = 5
    """draws of the smoothed states; what does not learn from these has one run"""
    seed: int = 10
    """the first seed; 0 and 1 were for trying"""
    rows: int = 4968
    """of each record, the first ones"""
    every: int = 5
    """rows of 5 ms in a step"""
    rounds: int = 100
    """of smoothing, at most"""
    num_functions: int = 39
    """particles of a free run"""

    axes: ClassVar[Axes] = {
        "learner": {
            "authors": "f_p, the authors' least squares",
            "fitted": "f_p, smoothed",
            "delta": "f_p, smoothed, + delta",
            "cka": "CKA of f_p, smoothed",
            "gp": "GP, no f_p",
        }
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of what does not learn from draws."""
        return self.seeds[:1] if kind[0] in ("authors", "fitted") else self.seeds


@dataclass(frozen=True, kw_only=True)
class Freeruns(Experiment):
    """The first part of a record teaches, and a free run follows the rest."""

    runs: int = 3
    """draws of what is learnt from; f_p alone has one run"""
    seed: int = 10
    """the first seed; 0 was for trying"""
    transitions: int = 300
    """that GPs learn from, spread evenly, or as many as there are"""
    rounds: int = 100
    """of smoothing, at most"""
    starts: int = 2
    """of smoothing"""
    num_functions: int = 39
    """particles of a free run"""

    axes: ClassVar[Axes] = {
        "record": {
            "ballbeam": "ball and beam, m",
            "furnace": "gas furnace, % of CO2",
            "drive": "drive",
            "tanks": "two tanks, V",
        },
        "learner": {
            "fitted": "f_p, smoothed",
            "delta": "f_p + delta",
            "cka": "CKA",
            "gp": "GP, no f_p",
        },
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of f_p alone."""
        return self.seeds[:1] if kind[1] == "fitted" else self.seeds


@dataclass(frozen=True, kw_only=True)
class Masses(Experiment):
    """Binding energies of nuclides: a liquid drop and what it lacks."""

    runs: int = 3
    """folds of ten that are left out"""
    split: int = 0
    """seed of the ten folds"""
    num_rows: int = 600
    """random rows for the search for hyper-parameters, and for f_p alone"""
    stride: int = 1
    """every how many-th element is taken"""

    axes: ClassVar[Axes] = {
        "task": {"fold": "folds of ten", "outer2": "outermost 2", "outer4": "outermost 4"},
        "physics": {"drop": "liquid drop", "shell": "with shell term", "none": "none"},
        "model": {
            "alone": "alone, calibrated",
            "mean": "physics mean",
            "cka": "CKA",
            "trees": "boosted trees on its residual",
            "gp": "GP without physics",
        },
    }
    calls: ClassVar[tuple[str, ...]] = _CALLS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """The folds that are left out; one run of the other tasks."""
        task, physics, model = kind
        if (physics == "none") != (model == "gp"):
            return ()
        return self.seeds if task == "fold" else self.seeds[:1]
