"""What an experiment is; its fields are its command line, and those of its own its settings."""

from __future__ import annotations

import inspect
import json
import os
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
Axes = Mapping[str | tuple[str, ...], Mapping[Any, str]]
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
    - ``first_look(runs)``, if wanted: a short table of the first runs, None if they are too few.
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
    """by the name of each axis, its values and their labels; the last axis has the learners. If
    values have several parts, the name is a tuple of theirs and each value a tuple"""
    key: ClassVar[tuple[str, ...]]
    """the names of the parts of a case: those of the axes, and ``"seed"``"""
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")
    """the calls of the library that decide the numbers: the defaults of their arguments are part of
    what identifies a run"""
    packages: ClassVar[tuple[str, ...]] = ("torch", "gpytorch", "botorch", "numpy")
    """whose versions decide the numbers; of the library itself the commit is recorded"""
    cheap: ClassVar[Mapping[str, Any]] = {}
    """settings with which `python -m paper check` makes the beginning of a long run again"""

    def __init_subclass__(cls) -> None:
        cls.name = cls.__name__.lower()
        if "axes" in cls.__dict__:
            parts = [name if isinstance(name, tuple) else (name,) for name in cls.axes]
            cls.key = (*sum(parts, ()), "seed")

    @property
    def folder(self) -> Path:
        """Where its results are."""
        return self.out / self.name

    @property
    def seeds(self) -> range:
        """The seeds that are asked for."""
        return range(self.seed, self.seed + self.runs)

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """The seeds of a kind of cases (values of all axes); none if it is not to be run."""
        return self.seeds

    def check(self) -> None:
        """Raise a ValueError for an option, or an ImportError for a package, that will not do."""

    def cases(self) -> list[Case]:
        """What is asked for, in the order in which it is run.

        Seed by seed with all values of the last axis, so that what is done first can be compared.

        Raises:
            ValueError: If ``only`` has a name that no axis has.
        """
        parts = [
            [value if isinstance(name, tuple) else (value,) for value in values]
            for name, values in self.axes.items()
        ]
        kinds = [tuple(sum(kind, ())) for kind in product(*parts)]
        names = [dict.fromkeys(str(kind[i]) for kind in kinds) for i in range(len(self.key) - 1)]
        for unknown in {*self.only}.difference(*names):
            there = "; ".join(
                f"{axis}: {', '.join(of)}" for axis, of in zip(self.key, names, strict=False)
            )
            raise ValueError(f"--only: there is no {unknown!r}, but there are, by axis, {there}")
        wanted = [{*of} & {*self.only} or {*of} for of in names]
        kinds = [k for k in kinds if all(str(v) in w for v, w in zip(k, wanted, strict=True))]
        outer = len(self.key) - 1 - len(parts[-1][0])
        cases = []
        for first in dict.fromkeys(kind[:outer] for kind in kinds):
            seeds = {kind: self.seeds_of(*kind) for kind in kinds if kind[:outer] == first}
            every = dict.fromkeys(seed for of_kind in seeds.values() for seed in of_kind)
            cases += [(*k, seed) for seed in every for k, those in seeds.items() if seed in those]
        return cases

    @property
    def settings(self) -> dict[str, Any]:
        """The fields of its own."""
        common = {entry.name for entry in fields(Experiment)}
        return {e.name: getattr(self, e.name) for e in fields(self) if e.name not in common}

    def changed(self: _Self, changes: Mapping[str, Any]) -> _Self:
        """The experiment with other settings."""
        return replace(self, **changes)

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that decide the numbers of a kind of cases; all of them, by default."""
        return self.settings

    def defaults(self) -> dict[str, dict[str, Any]]:
        """The defaults of the arguments of ``calls``, as JSON has them."""
        return {name: defaults_of(resolve_name(name)) for name in self.calls}

    def run(self, *case: Any) -> Run:
        """Run a case."""
        results: Run = self._module().run(self, *case)
        return results

    def first_look(self, runs: Sequence[Run]) -> str | None:
        """A short table of the first few runs, if the experiment has one and they are enough."""
        look = getattr(self._module(), "first_look", None)
        text: str | None = look(runs) if look and runs else None
        return text

    def tables(self, runs: Sequence[Run]) -> dict[str, Table]:
        """The tables of all runs, by name."""
        tables: dict[str, Table] = self._module().tables(runs, self)
        return tables

    def draw(self, runs: Sequence[Run]) -> list[Path]:
        """Draw the figures, if there are any, and return their files."""
        draw = getattr(self._module(), "draw", None)
        return draw(runs, self) if draw else []

    def _module(self) -> Any:
        """The experiment's module, imported when it is needed."""
        return import_module(f"{type(self).__module__}.{self.name}")


def defaults_of(call: Any) -> dict[str, Any]:
    """The arguments of a call that have a default, as JSON has them; others by their names."""
    parameters = inspect.signature(call).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}
    text = json.dumps(defaults, default=lambda v: getattr(v, "__qualname__", None) or repr(v))
    plain: dict[str, Any] = json.loads(text)
    return plain
