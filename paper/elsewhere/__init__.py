"""Free runs beyond what was learnt from: other torques, loads, days and machines."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

TRAININGS = {
    "pendulum": "pendulum, 0.68 kg, up to 1.3 N m",
    "design-a": "double pendulum A.0",
    "design-c0": "double pendulum C.0",
    "design-c1": "double pendulum C.1, small motions",
}
"""What is learnt from (``systems.py``), by name."""

LEARNERS = {
    "fitted": "f_p, least squares, constant sd",
    "gp": "GP",
    "smoothed": "calibrated CKA, smoothed",
}
"""What is learnt."""

ANOTHER = 0.2
"""Standard deviations of priors, by which parameters of another machine are taken to differ."""

HORIZONS = (10, 20, 40)
"""Steps of 0.05 s after which free runs are scored."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    n: int = 100
    """transitions that are learnt from, in stretches of ten"""
    windows: int = 40
    """free runs of a test, from evenly spread states, the same for all learners"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Elsewhere(Experiment):
    """Coverage and widths of free runs where the training records have not been."""

    runs: int = 2
    """draws of the stretches that are learnt from"""
    seed: int = 10
    """the first seed; 0 to 9 were for trying"""
    out: Path = Path("results/elsewhere")
    trainings: tuple[str, ...] = tuple(TRAININGS)
    """that are learnt from"""
    learners: tuple[str, ...] = tuple(LEARNERS)
    """that learn"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "elsewhere"
    key: ClassVar[tuple[str, ...]] = ("training", "learner", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scipy")

    def check(self) -> None:
        """Refuse trainings and learners that there are none of, and numbers out of range."""
        for found, known in ((self.trainings, TRAININGS), (self.learners, LEARNERS)):
            if not {*found} <= {*known}:
                raise ValueError(f"Expected some of {', '.join(known)}, found {', '.join(found)}.")
        if self.settings.n < 20 or self.settings.n % 10:
            raise ValueError(f"--n: expected 20, 30, ..., got {self.settings.n}")

    def tasks(self) -> list[Task]:
        """All learners of a seed before the next one."""
        return [
            (training, learner, seed)
            for seed in self.seeds
            for training in self.trainings
            for learner in self.learners
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and the files."""
        from paper.elsewhere.systems import SYSTEMS

        return {**asdict(self.settings), "another": ANOTHER, **SYSTEMS[kind[0]].describe()}
