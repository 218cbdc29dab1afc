"""Cascaded tanks: what structure, parameters and a GP do for the free runs of a benchmark."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

STRUCTURES = {
    "overflow": "overflow, linear sensor",
    "sensor": "overflow, root sensor",
    "kink": "overflow, kinked sensor",
}
"""What f_p knows, by name (``systems.py``)."""

PROCESS_NOISE = {
    "small": (0.003, 0.001),
    "middle": (0.01, 0.005),
    "large": (0.03, 0.015),
    "learnt": None,
}
"""What a step of 4 s adds to the levels of the upper and the lower tank, in V, as of the fits."""

CANDIDATES = tuple(f"{structure}-{noise}" for structure in STRUCTURES for noise in PROCESS_NOISE)
"""f_p with parameters from all samples, between which cross-validation chooses."""

LAGS = (1, 2, 3, 5)
"""Levels, and actions, that a GP without f_p reads; cross-validation chooses between them, too."""

NARX = {f"narx-{lags}": lags for lags in LAGS}

TENTH = "tenth"
"""The chosen f_p, with parameters from every tenth sample."""

GPS = {
    "delta": "chosen f_p + delta",
    "cka": "CKA of the chosen f_p",
    "overflow-delta": "f_p of a linear sensor + delta",
    "overflow-cka": "CKA of f_p of a linear sensor",
}
"""What GPs learn beside an f_p whose parameters are those of its fit, by name."""

LEARNERS = (TENTH, *GPS, *NARX)
"""What may be left out; the candidates cannot."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers, fixed before the first run."""

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
    tenths: int = 100
    """samples of what learns from every tenth"""
    sizes: tuple[int, ...] = (100, 400)
    """transitions of smoothed states that GPs beside f_p learn from"""
    narx: int = 400
    """transitions that GPs without f_p learn from"""
    draws: int = 3
    """of the transitions that GPs learn from"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Tanks(Experiment):
    """Dynamics of two tanks, learnt from one record, by a free run along another one."""

    out: Path = Path("results/tanks")
    learners: tuple[str, ...] = LEARNERS
    """beside the candidates"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "tanks"
    key: ClassVar[tuple[str, ...]] = ("learner", "n", "seed")

    def check(self) -> None:
        """Raise a ValueError for an unknown name, or a number out of range."""
        unknown = [name for name in self.learners if name not in LEARNERS]
        if unknown:
            raise ValueError(
                f"--learners: there is no {unknown[0]!r}, but there are {', '.join(LEARNERS)}"
            )
        settings = self.settings
        if not settings.head + 2 * settings.blocks <= settings.samples <= 1024:
            raise ValueError(
                f"--samples: expected at most 1024, and two for each of {settings.blocks} blocks "
                f"after the first {settings.head}, got {settings.samples}"
            )

    def tasks(self) -> list[Task]:
        """The candidates first, as most others need what is chosen of them."""
        settings = self.settings
        draws = self.seeds[: settings.draws]
        return [
            *((name, settings.samples, 0) for name in CANDIDATES),
            *((name, settings.tenths, s) for s in self.seeds for name in self._of((TENTH,))),
            *(
                task
                for s in draws
                for task in (
                    *((name, n, s) for n in settings.sizes for name in self._of(GPS)),
                    *((name, settings.narx, s) for name in self._of(NARX)),
                )
            ),
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what a structure knows beforehand."""
        from paper.tanks.systems import describe

        left_out = ("sizes", "draws", "tenths", "narx")
        settings = {k: v for k, v in asdict(self.settings).items() if k not in left_out}
        return {**settings, **describe(), "process_noise": dict(PROCESS_NOISE)}

    def _of(self, names: Any) -> list[str]:
        return [name for name in names if name in self.learners]
