"""Dynamics learnt from records of real machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment

HORIZONS = (10, 20, 40)
"""Steps of 0.05 s after which ``real`` scores free runs, in addition to single steps."""

_DYNAMICS = ("gpadjust.dynamics.LearnedDynamics", "gpadjust.dynamics.Dynamics.free_run")


@dataclass(frozen=True, kw_only=True)
class Real(Experiment):
    """Dynamics learnt from some transitions of a real pendulum, scored at other records."""

    runs: int = 3  # draws of the transitions
    windows: int = 80  # free runs of a test, from evenly spread states, the same for all learners
    num_functions: int = 39  # particles of a free run

    axes: ClassVar[Axes] = {
        "system": {"double-pendulum": "double pendulum", "pendulum": "torque-limited pendulum"},
        "n": {n: f"n = {n}" for n in (25, 100, 400)},
        "learner": {
            "phy": "f_p, crude",
            "fitted": "f_p, least squares",
            "smoothed": "f_p, smoothed",
            "gp": "GP",
            "phymean": "physics mean",
            "cka": "CKA",
            "phymean-fitted": "physics mean, least squares",
            "calibrated": "f_p, calibrated",
            "calibrated-delta": "physics mean, calibrated",
            "calibrated-cka": "CKA, calibrated",
            "smoothed-delta": "physics mean, calibrated, smoothed",
            "smoothed-cka": "CKA, calibrated, smoothed",
            "residual": "f_p and networks",
        },
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scipy")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return the seeds: one of what learns nothing, none for more rows than a record has.

        Unknown parameters, whose fits take minutes, are learnt of 100 transitions alone.
        """
        system, n, learner = kind
        if learner == "phy":
            return self.seeds[:1] if n == 100 else ()
        if learner.startswith(("calibrated", "smoothed")) and n != 100:
            return ()
        return () if n == 400 and system == "pendulum" else self.seeds

    def describe(self, *kind: Any) -> dict[str, Any]:
        """Return the settings of a run, and the records and parameters of its system."""
        from paper.machines.records import REAL

        scored = {"horizons": list(HORIZONS), "start_noise": "learnt"}
        return {**self.settings, **scored, **REAL[kind[0]].describe()}


CHOSEN = {"kink": (0.003, 0.001), "overflow": (0.01, 0.005)}
"""Structures of the tanks' f_p with the process noise of a step of 4 s in both levels, in V.

They were chosen by cross-validation of the estimation record, in an earlier experiment: of all, and
of those with a linear sensor.
"""


@dataclass(frozen=True, kw_only=True)
class Tanks(Experiment):
    """Dynamics of two tanks, learnt from one record, by a free run along another one."""

    runs: int = 3  # draws of the smoothed states; f_p alone has one run
    samples: int = 1024  # of each record, the first ones
    transitions: int = 400  # that GPs learn from
    noise: float = 0.15  # standard deviation of the measured level in V
    starts: int = 2  # of each fit of f_p
    rounds: int = 100  # of each start, at most
    num_functions: int = 39  # particles of a free run

    axes: ClassVar[Axes] = {
        "sensor": {"kink": "kinked sensor", "overflow": "linear sensor", "none": "no f_p"},
        "learner": {
            "fitted": "f_p, smoothed",
            "delta": "physics mean",
            "cka": "CKA",
            "gp": "GP of two levels and actions",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (*_DYNAMICS, "gpadjust.records.smooth")
    single: ClassVar[tuple[str, ...]] = ("fitted",)

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return the seeds; without f_p, of the GP alone."""
        sensor, learner = kind
        return () if (sensor == "none") != (learner == "gp") else super().seeds_of(*kind)
