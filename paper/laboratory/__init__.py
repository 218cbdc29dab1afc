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
class Links(Experiment):
    """Positive and bounded outputs: a link, with the physics through it, beside none."""

    runs: int = 24
    """cases of each problem"""
    out: Path = Path("results/links")

    axes: ClassVar[Axes] = {
        "problem": {
            "rate": "reaction rate, 4 decades",
            "diode": "current of a diode, 6 decades",
            "pump": "efficiency of a pump, 0 to 1",
            "reactor": "conversion in a reactor, 0 to 1",
        },
        "model": {"default": "CKA", "gp": "GP with the link", "linked": "CKA with the link"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.ZeroMeanGP")


@dataclass(frozen=True, kw_only=True)
class Categories(Experiment):
    """Pumps of three materials on five rigs, of which each has an offset."""

    runs: int = 24
    """sets of pumps"""
    out: Path = Path("results/categories")

    axes: ClassVar[Axes] = {
        "model": {
            "ignored": "material and rig ignored",
            "each": "a model of each material",
            "numbers": "codes as numbers",
            "onehot": "one-hot columns as numbers",
            "ours": "categorical, batch",
        },
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")
