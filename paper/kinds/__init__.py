"""Data as laboratories have them: a small problem of each kind, with its option and without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment


@dataclass(frozen=True, kw_only=True)
class Kinds(Experiment):
    """Each kind of data: its option compared with plain CKA."""

    axes: ClassVar[Axes] = {
        "kind": {
            "relative": "noise of 5 % of an output over three decades",
            "outliers": "one observation of twenty is far off",
            "noisy_inputs": "inputs measured with an sd of 5 %",
            "links": "a positive output over six decades",
            "categories": "three materials on five rigs",
            "drift": "a pump that wears, a step ahead",
            "vanishing": "gravity, of a ball in air without its drag",
            "emulated": "f_p known by 40 runs",
            "balldrop": "drops of a ball that was left out",
        },
        "learner": {"plain": "plain", "option": "option"},
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.EmulatedPhysics"),
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return all seeds; of the balls, whose data are given, two of the fit."""
        return self.seeds[:2] if kind[0] == "balldrop" else self.seeds
