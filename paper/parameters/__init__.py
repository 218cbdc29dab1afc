"""Unknown parameters of a physics: do their intervals hold what they are about?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment

_CALLS = ("gpadjust.fit", "gpadjust.CalibratedPhysics", "gpadjust.PhysicsMeanGP", "gpadjust.CKA")


@dataclass(frozen=True, kw_only=True)
class Parameters(Experiment):
    """Intervals of the parameters of textbook physics, by several discrepancies."""

    runs: int = 100
    """cases of each problem"""
    out: Path = Path("results/parameters")

    axes: ClassVar[Axes] = {
        "problem": {
            "right": "growth: f_p is right but for its parameters",
            "smooth": "line: a smooth discrepancy",
            "confounded": "decay: a discrepancy that looks like a parameter",
            "ball": "ball: air drag is missing",
        },
        "model": {
            "physics": "calibrated physics",
            "free": "free delta (Kennedy and O'Hagan)",
            "orthogonal": "orthogonal delta (Plumlee)",
            "cka": "calibrated CKA",
            "vanishing": "delta that grows as the time cubed",
        },
    }
    calls: ClassVar[tuple[str, ...]] = _CALLS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """The last model is of the ball only, whose drag vanishes at the start."""
        return () if kind[1] == "vanishing" and kind[0] != "ball" else self.seeds

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The size of the problem."""
        from paper.parameters.laws import textbook_case

        known = textbook_case(kind[0], 0)
        return {"observations": len(known.X), "noise": known.noise}


RIDGES = ("beam", "reaction", "creep", "inhibitor")
FOLDS = ("pendulum", "focus", "alias", "radar")
NINE = "spectrum"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    compared: int = 2
    """first cases of a ridge that are set beside a reference with each model"""
    long: int = 3
    """cases of nine parameters"""


@dataclass(frozen=True, kw_only=True)
class Ridges(Experiment):
    """Intervals of the parameters of a right law: do they hold the true ones, how wide are they?"""

    runs: int = 50
    """cases of each problem"""
    seed: int = 3400
    """the first seed; 1000 to 1999 were for trying, and runs of 3000 to 3313 were broken off"""
    out: Path = Path("results/ridges")
    settings: Settings = field(default_factory=Settings)

    axes: ClassVar[Axes] = {
        "problem": {name: name for name in (*RIDGES, NINE, *FOLDS)},
        "model": {
            "physics": "calibrated physics",
            "free": "free delta",
            "orthogonal": "orthogonal delta",
            "cka": "CKA",
        },
    }
    calls: ClassVar[tuple[str, ...]] = _CALLS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Laws that fold are fitted by calibrated physics alone, nine parameters less often."""
        if kind[0] in FOLDS and kind[1] != "physics":
            return ()
        return self.seeds[: self.settings.long] if kind[0] == NINE else self.seeds
