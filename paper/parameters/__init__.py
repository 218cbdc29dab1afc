"""Unknown parameters of a physics: do their intervals hold what they are about?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment


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
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CalibratedPhysics", "gpadjust.PhysicsMeanGP"),
        "gpadjust.CKA",
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """The last model is of the ball only, whose drag vanishes at the start."""
        return () if kind[1] == "vanishing" and kind[0] != "ball" else self.seeds

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The size of the problem."""
        from paper.parameters.laws import textbook_case

        known = textbook_case(kind[0], 0)
        return {"observations": len(known.X), "noise": known.noise}


@dataclass(frozen=True, kw_only=True)
class NutsSettings:
    """Settings that decide the numbers."""

    num_draws: int = 1000
    """of NUTS, in four chains, after half as many that are not kept"""


@dataclass(frozen=True, kw_only=True)
class Nuts(Experiment):
    """The default fit beside NUTS and the most likely numbers, of the same density."""

    runs: int = 2
    """seeds of each fit"""
    out: Path = Path("results/nuts")
    settings: NutsSettings = field(default_factory=NutsSettings)

    axes: ClassVar[Axes] = {
        "problem": {
            "wave": "CKA, 18 points, noise",
            "forrester": "CKA, 8 points, no noise",
            "ball": "physics mean, 20 points, two unknowns",
            "enzyme": "calibrated physics, 14 points, three unknowns",
            "Thurber": "calibrated physics, 37 points, seven unknowns",
        },
        "method": {"bayes": "default", "nuts": "NUTS", "map": '"map"'},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "pyro-ppl")


LAWS = (
    *("beam", "reaction", "creep", "inhibitor", "spectrum"),
    *("pendulum", "focus", "alias", "radar"),
)
"""Right laws with unknown parameters, which observations tell apart badly, or which fold."""
