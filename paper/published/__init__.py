"""Tables and records on which others have published numbers, and: never worse than the formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

TABLES = {"yacht": "yacht", "energy": "energy", "concrete": "concrete"}
OURS = {"formula": "formula, parameters fitted"} | labels("phymean", "cka", "gp")
RIVALS = {
    "single": "BoTorch's SingleTaskGP",
    "feature": "the same, formula as an input",
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
