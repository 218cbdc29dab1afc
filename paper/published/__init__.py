"""Tables and records on which others have published numbers, and: never worse than the formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment


@dataclass(frozen=True, kw_only=True)
class MassesSettings:
    """What decides the numbers."""

    split: int = 0
    """seed of the ten folds"""
    num_rows: int = 600
    """random rows for the search for hyper-parameters, and for f_p alone"""
    max_iterations: int = 1
    """iterations of L-BFGS with all rows, from what that search found"""
    stride: int = 1
    """every how many-th element is taken"""


@dataclass(frozen=True, kw_only=True)
class Masses(Experiment):
    """Binding energies of nuclides: a liquid drop and what it lacks."""

    runs: int = 10
    """folds of ten that are left out"""
    out: Path = Path("results/masses")
    settings: MassesSettings = field(default_factory=MassesSettings)

    axes: ClassVar[Axes] = {
        "task": {
            "fold": "ten folds",
            "outer2": "outermost 2",
            "outer4": "outermost 4",
            "unmeasured": "not measured",
        },
        ("physics", "model"): {
            ("drop", "mean"): "liquid drop, physics mean",
            ("drop", "cka"): "liquid drop, CKA",
            ("drop", "trees"): "liquid drop, boosted trees on its residual",
            ("drop", "alone"): "liquid drop alone, calibrated",
            ("shell", "mean"): "with shell term, physics mean",
            ("shell", "cka"): "with shell term, CKA",
            ("shell", "trees"): "with shell term, boosted trees on its residual",
            ("shell", "alone"): "with shell term alone, calibrated",
            ("none", "gp"): "GP without physics",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.ZeroMeanGP"),
        "gpadjust.CalibratedPhysics",
    )

    def seeds_of(self, task: str, *kind: Any) -> Sequence[int]:
        """The folds that are left out; one run of the other tasks; of CKA the ends of chains."""
        if "cka" in kind and not task.startswith("outer"):  # for its time
            return ()
        return self.seeds if task == "fold" else self.seeds[:1]
