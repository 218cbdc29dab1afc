"""What to try next: what a physics costs that misleads a search, and what one that helps saves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from paper.common.experiment import Axes, Experiment

PROBLEMS = ("moved peak", "moved ridge", "unrelated", "reactor", "column", "mixture")
"""Three whose physics misleads, and three whose physics helps."""


@dataclass(frozen=True, kw_only=True)
class Misled(Experiment):
    """Bayesian optimisation with a physics that misleads, and with one that helps."""

    seed: int = 500  # the first seed; 0 to 99 were for trying
    initial: int = 5  # trials of a scrambled Sobol sequence, before a model is asked
    trials: int = 15  # that follow, each at the optimum of qLogEI
    restarts: int = 4  # of the optimisation of qLogEI
    raw_samples: int = 128  # of the same
    mc_samples: int = 64  # of qLogEI

    axes: ClassVar[Axes] = {
        "problem": {name: name for name in PROBLEMS},
        "method": {
            "stgp": "SingleTaskGP",
            "zero": "ZeroMeanGP",
            "physics-mean": "physics mean",
            "cka": "CKA",
        },
    }
