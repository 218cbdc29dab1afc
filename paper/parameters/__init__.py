"""Unknown parameters of a physics: do their intervals hold what they are about?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

PROBLEMS = {
    "right": "growth: f_p is right but for its parameters",
    "smooth": "line: a smooth discrepancy",
    "confounded": "decay: a discrepancy that looks like a parameter",
    "ball": "ball: air drag is missing",
}
"""The problems, by name; each seed draws a case of each."""

MODELS = {
    "physics": "calibrated physics",
    "free": "free delta (Kennedy and O'Hagan)",
    "orthogonal": "orthogonal delta (Plumlee)",
    "cka": "calibrated CKA",
    "vanishing": "delta that grows as the time cubed",
}
"""What is fitted, by name; the last of the ball only, whose drag vanishes at the start."""


@dataclass(frozen=True, kw_only=True)
class Parameters(Experiment):
    """Intervals of the parameters of textbook physics, by several discrepancies."""

    runs: int = 100
    """cases of each problem"""
    out: Path = Path("results/parameters")

    name: ClassVar[str] = "parameters"
    key: ClassVar[tuple[str, ...]] = ("problem", "model", "seed")
    models: ClassVar[Mapping[str, str]] = MODELS

    def tasks(self) -> list[Task]:
        """Case by case, so that what is done first can be compared."""
        return [
            (problem, model, seed)
            for seed in self.seeds
            for problem in PROBLEMS
            for model in MODELS
            if model != "vanishing" or problem == "ball"
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The size of the problem."""
        from paper.parameters.problems import case

        known = case(kind[0], 0)
        return {"observations": len(known.X), "noise": known.noise}
