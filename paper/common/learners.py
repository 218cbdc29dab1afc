"""Every learner of the chapters: its label, its color, and how its model is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial, wraps
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True)
class Learner:
    """A learner."""

    label: str  # its name in tables and figures
    color: str  # its color in figures
    # A class of `gpadjust`, or `"module:class"`; None of a learner whose model a chapter
    # makes.
    model: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)  # of that class
    adjusts: bool = True  # whether the model is given f_p

    @property
    def make(self) -> Callable[..., Any]:
        """Its model factory, of inputs, targets and ``physics``; imports the library."""
        if self.model is None:
            raise ValueError(f"{self.label}: the chapter makes its model")
        kind = resolve_name(self.model if ":" in self.model else f"gpadjust:{self.model}")
        if self.adjusts:
            return partial(kind, **self.options) if self.options else kind

        @wraps(kind)
        def without_physics(X: Any, Y: Any, physics: Any = None, **options: Any) -> Any:
            return kind(X, Y, **{**self.options, **options})

        return without_physics


LITERAL: Mapping[str, Any] = {"center": 0.0, "constants": False}
"""Of the model as it is printed in the paper: its kernels contain no constants."""

LEARNERS = {
    # With f_p and data.
    "cka": Learner("CKA", "navy", "CKA"),
    "literal": Learner("CKA, center 0", "tab:blue", "CKA", LITERAL),
    "rra": Learner("RRA", "tab:green", "RRA"),
    "rra-paper": Learner("RRA", "tab:green", "paper.forrester.paper_rra:PaperRRA"),
    "phymean": Learner("physics mean", "tab:purple", "PhysicsMeanGP"),
    "delta": Learner("f_p + delta", "tab:purple", "PhysicsMeanGP"),
    "free": Learner("free delta", "tab:purple", "PhysicsMeanGP"),
    "bias": Learner("GP-bias", "tab:pink", "PhysicsMeanGP"),
    "scale": Learner("GP-scale", "tab:olive", "ScaleGP"),
    "ar1": Learner("AR1", "tab:brown", "AR1"),
    "fitted": Learner("f_p, parameters fitted", "tab:brown"),
    "calibrated": Learner("calibrated f_p", "tab:brown", "CalibratedPhysics"),
    "formula": Learner("formula, parameters fitted", "tab:brown", "CalibratedPhysics"),
    "physics": Learner("calibrated physics", "tab:brown", "CalibratedPhysics"),
    # Without data, or without f_p.
    "phy": Learner("f_p alone", "tab:orange"),
    "gp": Learner("GP", "tab:red", "ZeroMeanGP", adjusts=False),
    "mf": Learner("model-free", "0.55"),
    "oracle": Learner("the true system", "black"),
}
"""By the names that runs give them; where the runs of a chapter name one otherwise, its axis says
which is meant."""


def labels(*names: str, **more: str) -> dict[str, str]:
    """Return the values of an axis: names of ``LEARNERS`` with their labels, then others."""
    return {name: LEARNERS[name].label for name in names} | more
