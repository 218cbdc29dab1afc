"""What an experiment is; its fields are its command line, and those of its own its settings."""

from __future__ import annotations

import inspect
import json
import os
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from itertools import product
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, ClassVar, NamedTuple, TypeVar

Case = tuple[Any, ...]
"""What is run once: a value of each axis, and a seed."""
Run = dict[str, Any]
"""A case that was run: its values by name, what identifies the run, and its results."""
Axes = Mapping[str, Mapping[Any, str]]
_Self = TypeVar("_Self", bound="Experiment")


class Table(NamedTuple):
    """A table in Markdown, and what stands above it."""

    title: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Runs that do not depend on each other, and what is made of them.

    A chapter is a folder of `paper/`. Its ``__init__.py`` declares its experiments: subclasses with
    ``axes``, whose further fields are their settings; it imports nothing slow, because the command
    line is made of it. Beside it lies a module with the ``name`` of each experiment, which has

    - ``run(experiment, *case)``: runs a case with one thread; returns its results, for JSON.
    - ``tables(runs, experiment)``: tables of all runs, by name.
    - ``draw(runs, experiment)``, if there are figures: draws them into ``experiment.folder`` and
      returns their files.
    """

    runs: int = 10
    """number of runs of each kind, each with a seed of its own"""
    seed: int = 0
    """the first seed"""
    only: tuple[str, ...] = ()
    """values of axes (learners, systems, sizes, ...) that are run; all values of an axis of which
    none is named"""
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    """parallel processes"""
    out: Path = Path("results")
    """folder of the results, with a folder for each experiment"""
    only_tables: bool = False
    """run nothing; make tables and figures of the runs that are there"""

    name: ClassVar[str]
    """on the command line, and in the markers of the pages: the class's in lower case"""
    axes: ClassVar[Axes]
    """by the name of each axis, its values and their labels; the last axis has the learners"""
    key: ClassVar[tuple[str, ...]]
    """the names of the parts of a case: the axes, and ``"seed"``"""
    single: ClassVar[tuple[str, ...]] = ()
    """learners on which a seed has no influence, which have one run"""
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")
    """the calls of the library that decide the numbers: the defaults of their arguments are part of
    what identifies a run"""
    packages: ClassVar[tuple[str, ...]] = ("torch", "gpytorch", "botorch", "numpy")
    """whose versions decide the numbers; of the library itself the commit is recorded"""
    cheap: ClassVar[Mapping[str, Any]] = {}
    """settings with which `python -m paper check` makes the beginning of a long run again"""
    digits: ClassVar[int] = 6
    """significant digits of the numbers that are kept"""

    def __init_subclass__(cls) -> None:
        cls.name = cls.__name__.lower()
        if "axes" in cls.__dict__:
            cls.key = (*cls.axes, "seed")

    @property
    def folder(self) -> Path:
        """Where its results are."""
        return self.out / self.name

    @property
    def seeds(self) -> range:
        """The seeds that are asked for."""
        return range(self.seed, self.seed + self.runs)

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return the seeds of a kind of cases (values of all axes), possibly none."""
        return self.seeds[:1] if kind[-1] in self.single else self.seeds

    def check(self) -> None:
        """Raise a ValueError for an option, or an ImportError for a package, that will not do."""

    def cases(self) -> list[Case]:
        """Return the cases, in the order in which they are run.

        Seed by seed with all values of the last axis, so that what is done first can be compared.

        Raises:
            ValueError: If ``only`` has a name that no axis has.
        """
        names = {axis: [*map(str, values)] for axis, values in self.axes.items()}
        for unknown in {*self.only}.difference(*names.values()):
            there = "; ".join(f"{axis}: {', '.join(values)}" for axis, values in names.items())
            raise ValueError(f"--only: there is no {unknown!r}, but there are, by axis, {there}")
        wanted = [
            [value for value in self.axes[axis] if str(value) in self.only] or [*self.axes[axis]]
            for axis in names
        ]
        cases = []
        for outer in product(*wanted[:-1]):
            seeds = {(*outer, last): self.seeds_of(*outer, last) for last in wanted[-1]}
            every = dict.fromkeys(seed for of_kind in seeds.values() for seed in of_kind)
            cases += [(*k, seed) for seed in every for k, those in seeds.items() if seed in those]
        return cases

    @property
    def settings(self) -> dict[str, Any]:
        """The fields of its own."""
        common = {entry.name for entry in fields(Experiment)}
        return {e.name: getattr(self, e.name) for e in fields(self) if e.name not in common}

    def changed(self: _Self, changes: Mapping[str, Any]) -> _Self:
        """Return the experiment with other settings."""
        return replace(self, **changes)

    def describe(self, *kind: Any) -> dict[str, Any]:
        """Return the settings that decide the numbers of a kind of cases; by default, all."""
        return self.settings

    def defaults(self) -> dict[str, dict[str, Any]]:
        """Return the defaults of the arguments of ``calls``, as JSON has them; others by names."""
        found = {}
        for name in self.calls:
            parameters = inspect.signature(resolve_name(name)).parameters.values()
            found[name] = {p.name: p.default for p in parameters if p.default is not p.empty}
        text = json.dumps(found, default=lambda v: getattr(v, "__qualname__", None) or repr(v))
        plain: dict[str, dict[str, Any]] = json.loads(text)
        return plain

    def run(self, *case: Any) -> Run:
        """Run a case; warnings of single fits are not shown."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results: Run = self._call("run", self, *case)
        return results

    def tables(self, runs: Sequence[Run]) -> dict[str, Table]:
        """Return the tables of all runs, by name."""
        tables: dict[str, Table] = self._call("tables", runs, self)
        return tables

    def draw(self, runs: Sequence[Run]) -> list[Path]:
        """Draw the figures, if there are any, and return their files."""
        return self._call("draw", runs, self) or []

    def _call(self, function: str, *arguments: Any) -> Any:
        """Call a function of the experiment's module; return None if there is no such function."""
        module = import_module(f"{type(self).__module__}.{self.name}")
        return getattr(module, function, lambda *_: None)(*arguments)


def fitted(model: Any, *arguments: Any, **options: Any) -> float:
    """Fit a model; return the seconds."""
    from gpadjust import fit

    begin = time.perf_counter()
    fit(model, *arguments, **options)
    return time.perf_counter() - begin
