"""Data as laboratories have them: each kind beside what ignores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment


@dataclass(frozen=True, kw_only=True)
class Vanishing(Experiment):
    """A delta that is zero where the formula is known to be right: is the true parameter held?"""

    runs: int = 100
    """cases of each problem"""
    out: Path = Path("results/vanishing")

    axes: ClassVar[Axes] = {
        "problem": {
            "ball": "ball: drag is missing, small at first",
            "valve": "valve: its loss is missing, none when open",
            "misplaced": "valve, taken as open at 0.8",
        },
        "model": {
            "physics": "calibrated physics",
            "free": "free delta",
            "orthogonal": "orthogonal delta",
            "vanishing": "vanishing delta",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CalibratedPhysics", "gpadjust.PhysicsMeanGP"),
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """A wrong place is of the vanishing delta alone."""
        return () if kind[0] == "misplaced" and kind[1] != "vanishing" else self.seeds


@dataclass(frozen=True, kw_only=True)
class SistersSettings:
    """Settings that decide the numbers, fixed before the first run."""

    points: int = 5
    """measured points of pump B"""
    known: int = 40
    """measured points of each other machine"""
    tests: int = 300
    """points at which pump B is predicted"""


@dataclass(frozen=True, kw_only=True)
class Sisters(Experiment):
    """A pump of which five points are measured, with what other machines taught."""

    runs: int = 30
    """three times ten pumps, each once pump B"""
    out: Path = Path("results/sisters")
    settings: SistersSettings = field(default_factory=SistersSettings)

    axes: ClassVar[Axes] = {
        "prior": {
            "one": "one other pump",
            "three": "three other pumps",
            "rough": "a machine that has nothing to do with it, rough",
            "smooth": "a machine that has nothing to do with it, smooth",
        }
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")


@dataclass(frozen=True, kw_only=True)
class DriftSettings:
    """Settings that decide the numbers, fixed before the first run."""

    steps: int = 2190
    """observations, one each two hours: half a year"""
    first: int = 84
    """of these before the first fit: a week"""
    refit_every: int = 12
    """observations between refits of what is fitted again: a day"""
    window: int = 84
    """observations that are fitted again, and that an exact model keeps: a week"""
    forget: int = 42
    """observations in which an RRA forgets"""
    method: str = "map"
    """of all fits"""
    num_features: int = 64
    """features of each term of an RRA"""
    check_every: int = 6
    """observations between checks of the monitor"""


@dataclass(frozen=True, kw_only=True)
class Drift(Experiment):
    """Half a year of a pump that wears, predicted a step ahead by models that are updated."""

    runs: int = 4
    """pumps"""
    out: Path = Path("results/drift")
    settings: DriftSettings = field(default_factory=DriftSettings)

    axes: ClassVar[Axes] = {
        "model": {
            "never": "CKA, fitted once",
            "rra": "RRA, updated",
            "cka": "CKA, updated",
            "refit": "CKA, updated, and fitted again each day",
            "steady": "RRA, updated, of a pump that does not wear",
        }
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.RRA")
