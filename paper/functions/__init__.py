"""Functions of one to three inputs, few observations, and formulas from right to useless."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

GROUPS = {
    "right": "right, up to noise",
    "scaled": "right, scaled and shifted",
    "law": "right law, parameters unknown",
    "wrong": "right in part",
    "pairs": "textbook pairs of two fidelities",
    "useless": "of no use",
}
"""Of formulas."""
PROBLEMS = {
    "right": ("wave", "growth", "throttle", "lens", "pipe"),
    "scaled": ("scaled wave", "scaled growth", "scaled throttle", "scaled lens", "scaled pipe"),
    "law": ("creep", "beam", "inhibitor"),
    "wrong": (
        *("gain", "decay", "phase", "offset", "shear", "uptake"),
        *("kink", "thick lens", "rough pipe"),
    ),
    "pairs": ("forrester", "currin", "branin", "bohachevsky", "booth"),
    "useless": ("line for a wave", "peak for a plane", "pipe for a lens"),
}
"""Problems of each group; ``problems.py`` has their functions."""


@dataclass(frozen=True, kw_only=True)
class Functions(Experiment):
    """Is CKA worse than its formula, or than simpler models, and do its intervals cover 95 %?"""

    runs: int = 10  # data sets of each cell
    seed: int = 300
    """the first seed; 0 to 3, 100 to 109, 200 to 209 and from 1000 on were for trying"""
    num_test: int = 500  # points that all learners are scored at

    axes: ClassVar[Axes] = {
        "problem": {name: name for names in PROBLEMS.values() for name in names},
        "n": {n: f"n = {n}" for n in (5, 8, 12, 20)},
        "learner": {"formula": "formula, fitted"} | labels("phymean", "cka", "gp"),
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP", "gpadjust.ZeroMeanGP"),
        "gpadjust.CalibratedPhysics",
    )
