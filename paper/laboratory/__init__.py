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
class EmulatedSettings:
    """What decides the numbers."""

    per_input: int = 5
    """observations for each input"""
    runs_per_input: int = 20
    """runs of the low level for each input: at the observed inputs, and on a Sobol sequence"""
    num_test: int = 1000
    """points that all models are scored at"""


@dataclass(frozen=True, kw_only=True)
class Emulated(Experiment):
    """A physics known by its runs, on six pairs of functions of low and high fidelity."""

    runs: int = 10
    """data sets of each pair"""
    out: Path = Path("results/emulated")
    settings: EmulatedSettings = field(default_factory=EmulatedSettings)

    axes: ClassVar[Axes] = {
        "pair": {
            name: name
            for name in ("currin", "branin", "bohachevsky", "booth", "park91a", "hartmann6")
        },
        "model": {
            "exact": "CKA, exact f_p",
            "emulated": "CKA, f_p emulated",
            "certain": "CKA, emulator taken as exact",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.EmulatedPhysics"),
    )


@dataclass(frozen=True, kw_only=True)
class BalldropSettings:
    """What decides the numbers."""

    num_runs: int = 80
    """runs of the simulator, the first ones: those that the documentation of SEPIA takes"""
    heights: tuple[int, ...] = (10, 20, 30, 40, 50, 60)
    """heights in m at which the runs are taken"""


@dataclass(frozen=True, kw_only=True)
class Balldrop(Experiment):
    """Drop times of three balls, and runs of a simulator: the fourth ball is predicted."""

    runs: int = 2
    """fits of each case, by other seeds"""
    out: Path = Path("results/balldrop")
    settings: BalldropSettings = field(default_factory=BalldropSettings)

    axes: ClassVar[Axes] = {
        "physics": {"runs": "80 runs", "formula": "its formula"},
        "left": {
            "softball": "softball",
            "basketball": "basketball",
            "baseball": "baseball",
            "bowling ball": "bowling ball",
            "none": "none",
        },
        "model": {
            "physics": "calibrated physics",
            "mean": "physics mean",
            "cka": "CKA",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP"),
        *("gpadjust.CalibratedPhysics", "gpadjust.EmulatedPhysics"),
    )
