"""Goes when no chapter needs it: use ``axes`` of an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Case, Experiment


@dataclass(frozen=True, kw_only=True)
class Comparison(Experiment):
    """Trials of every learner on every system; subclasses have settings with ``trials``."""

    settings: Any
    systems: tuple[str, ...] = ()
    learners: tuple[str, ...] = ()

    key: ClassVar[tuple[str, ...]] = ("system", "learner", "seed")
    known_systems: ClassVar[Mapping[str, str]]
    known_learners: ClassVar[Mapping[str, str]]

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

    def tasks(self) -> list[Case]:
        """System by system, seed by seed, so that what is done first can be compared."""
        return [
            (system, learner, seed)
            for system in self.systems or self.known_systems
            for seed in self.seeds
            for learner in self.learners or self.known_learners
        ]
