"""Learners of real machines: measured records, many steps ahead, by the number of transitions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

SYSTEMS = {
    "double-pendulum": "double pendulum",
    "double-pendulum-harder": "double pendulum, harder split",
    "pendulum": "torque-limited pendulum",
    "pendulum-measured": "torque-limited pendulum, measured torques",
}
"""The machines with what is learnt from and tested at (``systems.py``), by name."""

LARGEST = {"pendulum": 300, "pendulum-measured": 300}
"""The most transitions of systems whose records have fewer than the largest size, 322."""

LEARNERS = {
    "phy": "f_p, crude",
    "phy-identified": "f_p, identified",
    "fitted": "f_p, least squares",
    "gp": "GP",
    "phymean": "physics mean",
    "phymean-identified": "physics mean, identified",
    "phymean-fitted": "physics mean, least squares",
    "cka": "CKA",
    "cka-identified": "CKA, identified",
    "rra": "RRA",
    "rra-identified": "RRA, identified",
    "calibrated": "calibrated f_p",
    "calibrated-delta": "calibrated f_p + delta",
    "calibrated-orthogonal": "calibrated f_p + orthogonal delta",
    "calibrated-cka": "calibrated CKA",
    "stretches-delta": "calibrated f_p + delta, of stretches",
    "smoothed": "calibrated f_p, smoothed",
    "smoothed-delta": "calibrated f_p + delta, smoothed",
    "smoothed-cka": "calibrated CKA, smoothed",
    "network": "network",
    "residual": "f_p and a network",
}
"""What is learnt (``learners.py``), by name; f_p is the crude one where nothing else is said."""

HORIZONS = (10, 20, 40)
"""Steps of 0.05 s after which free runs are scored, beside the single steps of all rows."""

SMOOTHED = ("smoothed", "smoothed-delta", "smoothed-cka")
"""Learners of states that are estimated along stretches of ten transitions."""

OF_STRETCHES = ("stretches-delta", *SMOOTHED)
"""Learners whose transitions come in stretches, not one by one."""

UNTAUGHT = ("phy", "phy-identified")
"""Learners that learn nothing: one run each, of 0 transitions."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers, fixed before the first run."""

    sizes: tuple[int, ...] = (25, 50, 100, 200, 400)
    """transitions that are learnt from, spread over the records"""
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
    systems: tuple[str, ...] = tuple(SYSTEMS)
    """that are learnt"""
    learners: tuple[str, ...] = tuple(LEARNERS)
    """that learn them"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "real"
    key: ClassVar[tuple[str, ...]] = ("system", "learner", "n", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scipy")

    def check(self) -> None:
        """Raise a ValueError for an unknown name, or a number out of range."""
        given: dict[str, tuple[tuple[str, ...], Mapping[str, str]]] = {
            "systems": (self.systems, SYSTEMS),
            "learners": (self.learners, LEARNERS),
        }
        for option, (names, known) in given.items():
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(
                    f"--{option}: there is no {unknown[0]!r}, but there are {', '.join(known)}"
                )
        for option, numbers, least in (
            ("sizes", self.settings.sizes, 10),
            ("windows", (self.settings.windows,), 2),
        ):
            if min(numbers, default=0) < least:
                found = min(numbers, default="none")
                raise ValueError(f"--{option}: expected at least {least}, got {found}")

    def sizes(self, system: str) -> list[int]:
        """The numbers of transitions that a system is learnt from."""
        return sorted({min(n, LARGEST.get(system, n)) for n in self.settings.sizes})

    def tasks(self) -> list[Task]:
        """Seed by seed, the smaller sizes first, so that what is done first can be compared."""
        untaught = [name for name in self.learners if name in UNTAUGHT]
        taught = [name for name in self.learners if name not in UNTAUGHT]
        return [
            *((system, learner, 0, 0) for system in self.systems for learner in untaught),
            *(
                (system, learner, n, seed)
                for seed in self.seeds
                for system in self.systems
                for n in self.sizes(system)
                for learner in taught
            ),
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings of a run, and the records and parameters of its system."""
        from paper.real.systems import system

        settings = {k: v for k, v in asdict(self.settings).items() if k != "sizes"}
        scored = {"horizons": list(HORIZONS), "start_noise": "learnt"}
        return {**settings, **scored, **system(kind[0]).describe()}
