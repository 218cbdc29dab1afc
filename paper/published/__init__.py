"""Tables and records on which others have published numbers, and: never worse than the formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment

_DYNAMICS = (
    "gpadjust.fit",
    "gpadjust.dynamics.LearnedDynamics",
    "gpadjust.dynamics.Dynamics.free_run",
    "gpadjust.records.smooth",
)

EMPS_GPS = {"delta": "f_p, smoothed, + delta", "cka": "CKA of f_p, smoothed", "gp": "GP, no f_p"}
"""Learners of the servo that learn from a draw of the smoothed states, one for each seed."""


@dataclass(frozen=True, kw_only=True)
class EmpsSettings:
    """Settings that decide the numbers, fixed before the first run."""

    rows: int = 4968
    """of each record, the first ones"""
    every: int = 5
    """rows of 5 ms in a step"""
    rounds: int = 100
    """of smoothing, at most"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Emps(Experiment):
    """A servo with dry friction: the record with force pulses, simulated by what another taught."""

    runs: int = 5
    """draws of the smoothed states; what does not learn from these has one run"""
    seed: int = 10
    """the first seed; 0 and 1 were for trying"""
    out: Path = Path("results/emps")
    settings: EmpsSettings = field(default_factory=EmpsSettings)

    axes: ClassVar[Axes] = {
        "learner": {
            "authors": "f_p, the authors' least squares",
            "fitted": "f_p, smoothed",
            "held": "f_p, smoothed, little process noise",
            **EMPS_GPS,
        }
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of what does not learn from draws."""
        return self.seeds if kind[0] in EMPS_GPS else self.seeds[:1]


RECORDS = {
    "ballbeam": "ball and beam",
    "furnace": "gas furnace",
    "drive": "drive",
    "tanks": "two tanks",
}
FREE_GPS = {"delta": "f_p + delta", "cka": "CKA", "gp": "GP, no f_p"}
"""Learners of the records that learn from draws of the smoothed states, or from the records."""

AFTER = "after"
"""An f_p of the tanks that was thought of after the hidden level had been seen; never chosen."""


@dataclass(frozen=True, kw_only=True)
class FreerunsSettings:
    """Settings that decide the numbers, fixed before the first run."""

    transitions: int = 300
    """that GPs learn from, spread evenly, or as many as there are"""
    rounds: int = 100
    """of smoothing, at most"""
    starts: int = 2
    """of smoothing"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Freeruns(Experiment):
    """The first part of a record teaches, and a free run follows the rest."""

    runs: int = 3
    """draws of what is learnt from; f_p alone has one run"""
    seed: int = 10
    """the first seed; 0 was for trying"""
    out: Path = Path("results/freeruns")
    settings: FreerunsSettings = field(default_factory=FreerunsSettings)

    axes: ClassVar[Axes] = {
        "record": RECORDS,
        "learner": {"fitted": "f_p, smoothed", **FREE_GPS, AFTER: "f_p of equal holes, afterwards"},
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of f_p alone."""
        if kind[1] == AFTER and kind[0] != "tanks":
            return ()
        return self.seeds if kind[1] in FREE_GPS else self.seeds[:1]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and the candidates among which the training part chooses."""
        from paper.published.freeruns_systems import SYSTEMS

        return {**asdict(self.settings), **SYSTEMS[kind[0]].describe()}
