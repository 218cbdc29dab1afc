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
