"""What an experiment is; its fields are its command line."""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from itertools import product
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, ClassVar, NamedTuple

Case = tuple[Any, ...]
"""What is run once: a value of each axis, and a seed."""
Run = dict[str, Any]
"""A case that was run: its values by name, what identifies the run, and what it found."""
Axes = Mapping[str | tuple[str, ...], Mapping[Any, str]]


class Table(NamedTuple):
    """A table in Markdown, and what stands above it."""

    title: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Runs that do not depend on each other, and what is made of them.

    A chapter is a folder of `paper/`. Its ``__init__.py`` declares its experiments: subclasses with
    ``axes``, and with settings as further fields; it imports nothing slow, because the command line
    is made of it. Beside it lies a module with the ``name`` of each experiment, which has

    - ``run(experiment, *case)``: runs a case with one thread; returns what it found, for JSON.
    - ``tables(runs, experiment)``: tables of all runs, by name.
    - ``first_look(runs)``, if wanted: a short table of the first runs, None if they are too few.
    - ``draw(runs, experiment)``, if there are figures: draws them into ``experiment.out`` and
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
    """folder of the results"""
    only_tables: bool = False
    """run nothing; make tables and figures of the runs that are there"""

    name: ClassVar[str]
    """on the command line, and in the markers of the pages: that of the class in lower case"""
    axes: ClassVar[Axes]
    """by the name of each axis, its values and their labels; if values have several parts, the
    name is a tuple of theirs and each value a tuple"""
    key: ClassVar[tuple[str, ...]]
    """the names of the parts of a case: those of the axes, and ``"seed"``"""
    calls: ClassVar[tuple[str, ...]] = ()
    """the calls of the library that decide the numbers, such as ``"gpadjust.fit"``: the defaults
    of their arguments are part of what identifies a run"""
    flat: ClassVar[bool] = True
    """whether options of nested settings have the names of these alone"""
    packages: ClassVar[tuple[str, ...]] = ("torch", "gpytorch", "botorch", "numpy")
    """whose versions decide the numbers; of the library itself the commit is said"""

    def __init_subclass__(cls) -> None:
        cls.name = cls.__name__.lower()
        if "axes" in cls.__dict__:
            cls.key = (*_flat(cls.axes), "seed")

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
        known = [{str(kind[i]) for kind in kinds} for i in range(len(self.key) - 1)]
        unknown = [name for name in self.only if not any(name in names for names in known)]
        if unknown:
            there = "; ".join(
                f"{name}: {', '.join(dict.fromkeys(str(kind[i]) for kind in kinds))}"
                for i, name in enumerate(self.key[:-1])
            )
            raise ValueError(f"--only: there is no {unknown[0]!r}, but there are, by axis, {there}")
        wanted = [names & {*self.only} or names for names in known]
        found = []
        outer = len(kinds[0]) - len(parts[-1][0])
        for first in dict.fromkeys(kind[:outer] for kind in kinds):
            seeds = {
                kind: self.seeds_of(*kind)
                for kind in kinds
                if kind[:outer] == first
                and all(str(value) in names for value, names in zip(kind, wanted, strict=True))
            }
            every = dict.fromkeys(seed for own in seeds.values() for seed in own)
            found += [(*k, seed) for seed in every for k, own in seeds.items() if seed in own]
        return found

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that decide the numbers of a kind of cases; all of them, by default."""
        settings = getattr(self, "settings", None)
        return {} if settings is None else asdict(settings)

    def defaults(self) -> dict[str, dict[str, Any]]:
        """The defaults of the arguments of ``calls``, as JSON has them."""
        return {name: defaults_of(resolve_name(name)) for name in self.calls}

    def run(self, *case: Any) -> Run:
        """Run a case."""
        found: Run = self._module().run(self, *case)
        return found

    def first_look(self, runs: Sequence[Run]) -> str | None:
        """A short table of the first few runs, if the experiment has one and they are enough."""
        look = getattr(self._module(), "first_look", None)
        text: str | None = look(runs) if look and runs else None
        return text

    def tables(self, runs: Sequence[Run]) -> dict[str, Table]:
        """The tables of all runs, by name."""
        found: dict[str, Table] = self._module().tables(runs, self)
        return found

    def draw(self, runs: Sequence[Run]) -> list[Path]:
        """Draw the figures, if there are any, and return their files."""
        draw = getattr(self._module(), "draw", None)
        return draw(runs, self) if draw else []

    def _module(self) -> Any:
        """The experiment's module, imported when it is needed."""
        return import_module(f"{type(self).__module__}.{self.name}")


def defaults_of(call: Any) -> dict[str, Any]:
    """The arguments of a call that have a default, as JSON has them; others by their names."""
    found = {
        parameter.name: parameter.default
        for parameter in inspect.signature(call).parameters.values()
        if parameter.default is not inspect.Parameter.empty
    }
    plain: dict[str, Any] = json.loads(
        json.dumps(found, default=lambda value: getattr(value, "__qualname__", None) or repr(value))
    )
    return plain


def _flat(axes: Axes) -> list[str]:
    return [part for name in axes for part in (name if isinstance(name, tuple) else (name,))]
