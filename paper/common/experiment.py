"""What an experiment is; its fields are its command line."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

Task = tuple[Any, ...]
Record = dict[str, Any]


class Table(NamedTuple):
    """A table in Markdown, and what stands above it."""

    title: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Runs that do not depend on each other, and what is made of them.

    An experiment is a folder. Its ``__init__.py`` has a subclass with the settings as further
    fields, and imports nothing slow: the command line is made of it. Beside it lie

    - ``run.py`` with ``run(experiment, *task, unfinished)``: runs a task with one thread, returns
      what it found, as JSON has it. ``unfinished`` is a path of the task's own; with a suffix it is
      the place for what it needs to go on after an interruption, and removes when it ends.
    - ``tables.py`` with ``tables(records, experiment)``: tables of all runs by name. It may have
      ``first_look(records)``: a short table of the first few runs, None if they are too few.
    - if there are figures, ``figure.py`` with ``draw(records, experiment)``: draws them into
      ``experiment.out`` and returns their files.
    """

    runs: int = 10
    """number of runs, each with a seed of its own"""
    seed: int = 0
    """the first seed"""
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    """parallel processes"""
    out: Path = Path("results")
    """folder of the results"""
    backend: Literal["loky", "ray"] = "loky"
    """processes on this machine, or on a Ray cluster"""
    only_tables: bool = False
    """run nothing; make tables and figures of the runs that are there"""
    other_versions: Literal["refuse", "keep", "replace"] = "refuse"
    """what becomes of runs that other versions of the packages made, if more are to be run: nothing
    is run, they are kept beside the new ones, or they are run again"""

    name: ClassVar[str]
    """on the command line, and in the markers of the READMEs"""
    key: ClassVar[tuple[str, ...]]
    """what the parts of a task are called; the last is its seed"""
    flat: ClassVar[bool] = True
    """whether options of nested settings have the names of these alone"""
    packages: ClassVar[tuple[str, ...]] = ("gpadjust", "torch", "gpytorch", "botorch", "numpy")
    """whose versions decide the numbers"""

    @property
    def seeds(self) -> range:
        """The seeds that are asked for."""
        return range(self.seed, self.seed + self.runs)

    def check(self) -> None:
        """Raise a ValueError for an option, or an ImportError for a package, that will not do."""

    def tasks(self) -> Sequence[Task]:
        """What is asked for, in the order in which it is run; ``key`` names the parts of each."""
        raise NotImplementedError

    def describe(self, *kind: Any) -> dict[str, Any]:
        """All that decides the numbers of a task (given without its seed), but for versions."""
        raise NotImplementedError

    def run(self, *task: Any, unfinished: Path) -> Record:
        """Run a task."""
        found: Record = self._part("run").run(self, *task, unfinished=unfinished)
        return found

    def first_look(self, records: Sequence[Record]) -> str | None:
        """A short table of the first few runs, if the experiment has one and they are enough."""
        look = getattr(self._part("tables"), "first_look", None)
        text: str | None = look(records) if look and records else None
        return text

    def tables(self, records: Sequence[Record]) -> dict[str, Table]:
        """The tables of all runs, by name."""
        found: dict[str, Table] = self._part("tables").tables(records, self)
        return found

    def draw(self, records: Sequence[Record]) -> list[Path]:
        """Draw the figures, if there are any, and return their files."""
        if find_spec(f"{type(self).__module__}.figure") is None:
            return []
        found: list[Path] = self._part("figure").draw(records, self)
        return found

    def _part(self, name: str) -> Any:
        """A module of the experiment's folder, imported when it is needed."""
        return import_module(f"{type(self).__module__}.{name}")
