"""Unknown parameters of a physics: do their intervals cover the true values?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment

TEXTBOOK = ("right", "smooth", "confounded", "ball")
"""Problems of a system that is not always the law's."""


@dataclass(frozen=True, kw_only=True)
class Parameters(Experiment):
    """Intervals of the parameters of laws, with a discrepancy and without."""

    runs: int = 40  # cases of each problem

    axes: ClassVar[Axes] = {
        "problem": {
            "right": "growth: f_p is right but for its parameters",
            "smooth": "line: a smooth discrepancy",
            "confounded": "decay: a discrepancy that looks like a parameter",
            "ball": "ball: air drag is missing",
            "beam": "beam: two stiffnesses in one deflection",
            "reaction": "reaction: Arrhenius in a narrow range",
            "creep": "creep: before it comes to rest",
            "inhibitor": "enzyme: three constants",
            "spectrum": "spectrum: nine parameters",
            "pendulum": "pendulum: two solutions, by sign and phase",
            "focus": "focus: either way",
            "alias": "oscillation: observed too seldom",
            "radar": "oscillation: the same, noisy",
        },
        "model": {"physics": "calibrated physics", "free": "free delta", "cka": "calibrated CKA"},
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CalibratedPhysics", "gpadjust.PhysicsMeanGP"),
        "gpadjust.CKA",
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return all seeds; for right laws, without a discrepancy alone."""
        return self.seeds if kind[0] in TEXTBOOK or kind[1] == "physics" else ()


@dataclass(frozen=True, kw_only=True)
class Nuts(Experiment):
    """The default fit compared with NUTS and the most likely numbers, of the same density."""

    runs: int = 2  # seeds of each fit
    num_draws: int = 640  # of NUTS, in four chains, after half as many that are not kept

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
