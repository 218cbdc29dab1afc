"""Experiments that compare learners on several systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task


@dataclass(frozen=True, kw_only=True)
class Comparison(Experiment):
    """Trials of every learner on every system; subclasses have settings with ``trials``."""

    settings: Any
    systems: tuple[str, ...] = ()
    """the systems, by name; all of them, unless some are given"""
    learners: tuple[str, ...] = ()
    """the models, by name; all of them, unless some are given"""

    key: ClassVar[tuple[str, ...]] = ("system", "learner", "seed")
    known_systems: ClassVar[Mapping[str, str]]
    """their labels, by name"""
    known_learners: ClassVar[Mapping[str, str]]
    """their labels, by name"""

    def check(self) -> None:
        """Whether there are the systems and the models."""
        for option, given, known in (
            ("systems", self.systems, self.known_systems),
            ("learners", self.learners, self.known_learners),
        ):
            unknown = [name for name in given if name not in known]
            if unknown:
                raise ValueError(
                    f"--{option}: there is no {unknown[0]!r}, but there are {', '.join(known)}"
                )
        if self.settings.trials < 1:
            raise ValueError(f"--trials: expected at least 1, got {self.settings.trials}")

    def tasks(self) -> list[Task]:
        """System by system, seed by seed, so that what is done first can be compared."""
        return [
            (system, learner, seed)
            for system in self.systems or self.known_systems
            for seed in self.seeds
            for learner in self.learners or self.known_learners
        ]
