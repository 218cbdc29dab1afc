"""Data as laboratories have them: each kind beside what ignores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
class Relative(Experiment):
    """Noise that grows with an output over three decades: do intervals hold in each?"""

    runs: int = 12
    """cases of each problem"""
    observations: int = 40
    """training points"""
    out: Path = Path("results/relative")

    axes: ClassVar[Axes] = {
        "problem": {
            "rate": "rate: exponential",
            "power": "power: a wrong exponent",
            "plane": "plane: f_p lacks an input",
        },
        "structure": {"CKA": "CKA", "GP": "GP without physics"},
        "noise": {"default": "one size", "relative": "relative"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.ZeroMeanGP")


@dataclass(frozen=True, kw_only=True)
class Outliers(Experiment):
    """One in twenty observations is far off: errors beside those of clean data."""

    runs: int = 8
    """cases of each problem and size"""
    out: Path = Path("results/outliers")

    axes: ClassVar[Axes] = {
        "problem": {
            "wave": "wave: f_p lacks a slope",
            "decay": "decay: a wrong rate",
            "plane": "plane: two inputs",
            "good": "good: f_p is 2 % off",
            "misleading": "misleading: f_p is of no use",
            "space": "space: three inputs",
        },
        "observations": {20: "20", 60: "60"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")
