"""Tables and records on which others have published numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

TABLES = ("yacht", "energy", "concrete")
OURS = labels("formula", "phymean", "cka", "gp")
BOOSTING = "boosted trees, formula as an input"


def published(experiment: str) -> dict[str, list[str]]:
    """Return published numbers that stand below those of an experiment, by the method."""
    with open(Path(__file__).parent / "data" / "published.csv", newline="") as file:
        return {row[1]: row[2:] for row in csv.reader(file) if row[0] == experiment}


_CALLS = (
    *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.ZeroMeanGP"),
    "gpadjust.CalibratedPhysics",
)


@dataclass(frozen=True, kw_only=True)
class Splits(Experiment):
    """An experiment whose seeds are the numbers of splits that others made."""

    splits: ClassVar[int]
    calls: ClassVar[tuple[str, ...]] = _CALLS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scikit-learn")

    def check(self) -> None:
        """Raise a ValueError for a split that there is not."""
        if not 0 <= self.seed <= self.splits - self.runs:
            raise ValueError(
                f"There are {self.splits} splits, 0 to {self.splits - 1}; found --seed {self.seed} "
                f"--runs {self.runs}."
            )


@dataclass(frozen=True, kw_only=True)
class Uci(Splits):
    """Yacht, energy and concrete on their usual splits, with a formula each, and rivals."""

    splits: ClassVar[int] = 20
    axes: ClassVar[Axes] = {
        "table": {name: name for name in TABLES},
        "share": {0.1: "10 %", 0.9: "90 %"},
        "method": OURS
        | {
            "single": "BoTorch's SingleTaskGP",
            "feature": "SingleTaskGP, formula as an input",
            "boosting": BOOSTING,
            "ensemble": "formula and a deep ensemble",
            "mfk": "SMT's MFK",
        },
    }
    packages: ClassVar[tuple[str, ...]] = (*Splits.packages, "smt")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return all splits; three of large tables by nine tenths; few rows for slow methods."""
        table, share, method = kind
        if method in ("mfk", "boosting", "phymean") and share > 0.1:
            return ()
        if method == "mfk" and table == "concrete":
            return ()
        return self.seeds[:3] if share > 0.1 and table != "yacht" else self.seeds


@dataclass(frozen=True, kw_only=True)
class Steels(Splits):
    """Yield strengths of 312 steels by ten lines of metallurgy, in the five folds of Matbench."""

    runs: int = 5  # folds; there are five

    splits: ClassVar[int] = 5
    axes: ClassVar[Axes] = {"method": OURS | {"boosting": BOOSTING}}


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

    runs: int = 2  # seeds of each set and start

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

    runs: int = 5  # draws of the smoothed states; what does not learn from these has one run
    seed: int = 10  # the first seed; 0 and 1 were for trying
    rows: int = 4968  # of each record, the first ones
    every: int = 5  # rows of 5 ms in a step
    rounds: int = 100  # of smoothing, at most
    num_functions: int = 39  # particles of a free run

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
    single: ClassVar[tuple[str, ...]] = ("authors", "fitted")


@dataclass(frozen=True, kw_only=True)
class Freeruns(Experiment):
    """The first part of a record teaches, and a free run follows the rest."""

    runs: int = 3  # draws of what is learnt from; f_p alone has one run
    seed: int = 10  # the first seed; 0 was for trying
    transitions: int = 300  # that GPs learn from, spread evenly, or as many as there are
    rounds: int = 100  # of smoothing, at most
    starts: int = 2  # of smoothing
    num_functions: int = 39  # particles of a free run

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
    single: ClassVar[tuple[str, ...]] = ("fitted",)


@dataclass(frozen=True, kw_only=True)
class Masses(Experiment):
    """Binding energies of nuclides: a liquid drop and its residual."""

    runs: int = 3  # folds of ten that are left out
    split: int = 0  # seed of the ten folds
    num_rows: int = 600  # random rows for the search for hyper-parameters, and for f_p alone
    stride: int = 1  # every how many-th element is taken

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
        """Return the folds that are left out; one run of the other tasks."""
        task, physics, model = kind
        if (physics == "none") != (model == "gp"):
            return ()
        return self.seeds if task == "fold" else self.seeds[:1]
