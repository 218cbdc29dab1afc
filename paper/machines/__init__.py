"""Dynamics learnt from records of real machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment
from paper.common.learners import LEARNERS, Learner

HORIZONS = (10, 20, 40)
"""Steps of 0.05 s after which free runs are scored, of ``real`` beside the single steps."""

_DYNAMICS = ("gpadjust.dynamics.LearnedDynamics", "gpadjust.dynamics.Dynamics.free_run")


@dataclass(frozen=True)
class RealLearner(Learner):
    """A learner of a machine.

    Args:
        physics: The f_p that it has: ``"crude"``, ``"identified"``, ``"unknown"`` (its parameters
            are learnt), ``"fitted"`` (they are fitted by least squares first), or none.
        states: What it learns from: ``"transitions"``, ``"stretches"`` of ten of them, or
            ``"smoothed"`` states along such stretches.
    """

    physics: str = "crude"
    states: str = "transitions"


def _of(name: str, label: str, color: str, physics: str, states: str = "transitions") -> Any:
    """The learner of a name of the registry with another f_p, or of other states."""
    known = LEARNERS[name]
    options = known.options
    return RealLearner(label, color, known.model, options, known.adjusts, physics, states)


REAL_LEARNERS = {
    "phy": _of("phy", "f_p, crude", "tab:orange", "crude"),
    "phy-identified": _of("phy", "f_p, identified", "gold", "identified"),
    "fitted": _of("fitted", "f_p, least squares", "tab:brown", "fitted"),
    "gp": _of("gp", "GP", "tab:red", "none"),
    "phymean": _of("phymean", "physics mean", "tab:purple", "crude"),
    "phymean-identified": _of("phymean", "physics mean, identified", "plum", "identified"),
    "phymean-fitted": _of("phymean", "physics mean, least squares", "black", "fitted"),
    "cka": _of("cka", "CKA", "navy", "crude"),
    "cka-identified": _of("cka", "CKA, identified", "tab:cyan", "identified"),
    "rra": _of("rra", "RRA", "tab:green", "crude"),
    "rra-identified": _of("rra", "RRA, identified", "yellowgreen", "identified"),
    "calibrated": _of("calibrated", "calibrated f_p", "tab:olive", "unknown"),
    "calibrated-delta": _of("phymean", "calibrated f_p + delta", "deepskyblue", "unknown"),
    "calibrated-cka": _of("cka", "calibrated CKA", "blue", "unknown"),
    "stretches-delta": _of(
        "phymean", "calibrated f_p + delta, of stretches", "slategray", "unknown", "stretches"
    ),
    "smoothed": _of("calibrated", "calibrated f_p, smoothed", "darkkhaki", "unknown", "smoothed"),
    "smoothed-delta": _of(
        "phymean", "calibrated f_p + delta, smoothed", "limegreen", "unknown", "smoothed"
    ),
    "smoothed-cka": _of("cka", "calibrated CKA, smoothed", "darkviolet", "unknown", "smoothed"),
    "network": RealLearner("network", "0.55", "network", physics="none"),
    "residual": RealLearner("f_p and a network", "tab:pink", "network"),
}
UNTRAINED = ("phy", "phy-identified")
"""Learners that learn nothing: one run each, of 0 transitions."""


@dataclass(frozen=True, kw_only=True)
class RealSettings:
    """Settings that decide the numbers, fixed before the first run."""

    windows: int = 80
    """free runs of a test, from evenly spread states, the same for all learners"""
    num_functions: int = 39
    """particles of a free run"""
    drawn: int = 100
    """transitions of the runs of seed 0 that keep a few free runs, for the figures"""


@dataclass(frozen=True, kw_only=True)
class Real(Experiment):
    """Dynamics learnt from some transitions of a real machine, scored at other records."""

    out: Path = Path("results/real")
    settings: RealSettings = field(default_factory=RealSettings)

    axes: ClassVar[Axes] = {
        "system": {
            "double-pendulum": "double pendulum",
            "double-pendulum-harder": "double pendulum, harder split",
            "pendulum": "torque-limited pendulum",
            "pendulum-measured": "torque-limited pendulum, measured torques",
        },
        "n": {n: f"n = {n}" for n in (0, 25, 50, 100, 200, 300, 400)},
        "learner": {name: learner.label for name, learner in REAL_LEARNERS.items()},
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scipy")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of what learns nothing; the pendulums' records have 300 transitions at most."""
        system, n, learner = kind
        if learner in UNTRAINED or n == 0:
            return self.seeds[:1] if learner in UNTRAINED and n == 0 else ()
        return () if n == (400 if system.startswith("pendulum") else 300) else self.seeds

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings of a run, and the records and parameters of its system."""
        from paper.machines.records import REAL

        scored: dict[str, Any] = {"horizons": list(HORIZONS), "start_noise": "learnt"}
        scored |= {"fitted_by": "PhysicsDynamics"} if "fitted" in kind[2] else {}
        return {**asdict(self.settings), **scored, **REAL[kind[0]].describe()}


STRUCTURES = {
    "overflow": "overflow, linear sensor",
    "sensor": "overflow, root sensor",
    "kink": "overflow, kinked sensor",
}
"""Structures of the tanks' f_p, by name (``tanks_systems.py``)."""

PROCESS_NOISE = {
    "small": (0.003, 0.001),
    "middle": (0.01, 0.005),
    "large": (0.03, 0.015),
    "learnt": None,
}
"""Process noise of a step of 4 s in the levels of the upper and the lower tank, in V."""

CANDIDATES = {
    f"{structure}-{noise}": f"f_p: {label}; process noise "
    + ("learnt" if sd is None else f"{sd[0]:g}, {sd[1]:g}")
    for structure, label in STRUCTURES.items()
    for noise, sd in PROCESS_NOISE.items()
}
"""f_p with parameters from all samples, between which cross-validation chooses."""

NARX = {
    f"narx-{lags}": f"GP of {lags} level{'s' * (lags > 1)} and action{'s' * (lags > 1)}, no f_p"
    for lags in (1, 2, 3, 5)
}
"""GPs without f_p, by the levels and actions that they read; cross-validation chooses, too."""

TENTH = "tenth"
GPS = {
    "delta": "chosen f_p + delta",
    "cka": "CKA of the chosen f_p",
    "overflow-delta": "f_p of a linear sensor + delta",
    "overflow-cka": "CKA of f_p of a linear sensor",
}
"""GPs beside an f_p whose parameters are those of its fit, by name."""

CHOSEN = {"": "kink-small", "overflow": "overflow-middle"}
"""The candidates, of all and of those with a linear sensor, that the cross-validated errors of the
committed runs choose: f_p of the learners that have one. The tables say so if other runs differ."""


@dataclass(frozen=True, kw_only=True)
class TanksSettings:
    """Settings that decide the numbers, fixed before the first run."""

    samples: int = 1024
    """of each record, the first ones"""
    head: int = 60
    """samples before the first block of the cross-validation"""
    blocks: int = 4
    """of the cross-validation"""
    noise: float = 0.15
    """standard deviation of the measured level in V, unless it is learnt with the process noise"""
    starts: int = 2
    """of each fit of f_p"""
    rounds: int = 100
    """of each start, at most"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Tanks(Experiment):
    """Dynamics of two tanks, learnt from one record, by a free run along another one."""

    out: Path = Path("results/tanks")
    settings: TanksSettings = field(default_factory=TanksSettings)

    axes: ClassVar[Axes] = {
        "n": {1024: "all samples", 100: "100", 400: "400"},
        "learner": {**CANDIDATES, TENTH: "chosen f_p, every tenth sample", **GPS, **NARX},
    }
    calls: ClassVar[tuple[str, ...]] = (*_DYNAMICS, "gpadjust.records.smooth")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """A candidate has all samples and one run, every tenth sample 100; GPs have three draws."""
        n, learner = kind
        if learner in CANDIDATES:
            return (0,) if n == 1024 else ()
        if learner == TENTH:
            return self.seeds if n == 100 else ()
        return self.seeds[:3] if n == 400 or (n == 100 and learner in GPS) else ()

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what a structure knows beforehand."""
        from paper.machines.tanks_systems import describe

        return {**asdict(self.settings), **describe(), "process_noise": dict(PROCESS_NOISE)}
