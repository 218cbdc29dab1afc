"""A physics by the name that a command line has, and whether it works at the data."""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files import LARGEST
from gpadjust.physics import BlackBoxPhysics, Physics, PhysicsError, as_physics
from gpadjust.physics.array_physics import array_physics
from gpadjust.report.csv_data import CsvData
from gpadjust.report.numbers import plural

_FORM = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
_SHOWN = 5
_SAME = 1e-6  # as far as a model's file asks it when it is loaded
_MOST = 12


class NamedPhysics(NamedTuple):
    """A physics, and how Python code that loads a model of it says so.

    Attributes:
        physics: The physics.
        code: An expression by its name: ``""`` of a single physics.
        modules: The modules that these need.
    """

    physics: Physics
    code: dict[str, str]
    modules: tuple[str, ...]


def named_physics(paths: Sequence[str], data: CsvData) -> NamedPhysics:
    """Import functions ``"module:name"``, and evaluate them at the data.

    Raises:
        ValueError: If a name has another form, its module or what it names is not there or raises
            an error, is no physics, or is named twice; or if the physics fails in some row, which
            the error names, or returns other values when it is called again.
    """
    if again := [path for path in dict.fromkeys(paths) if paths.count(path) > 1]:
        raise ValueError(
            f"Expected different --physics, found {again[0]} more than once; give it once."
        )
    parts: dict[str, Physics] = {}
    code: dict[str, str] = {}
    for path in paths:
        thing = _imported(path)
        module, _, name = path.partition(":")
        try:
            physics = array_physics(thing, data.X.to_numpy())
        except (TypeError, PhysicsError) as error:
            row = f" The first row is line {data.lines[0]} of the file."
            where = row * isinstance(error, PhysicsError)
            raise ValueError(f"--physics {path}: {error}{where}") from error
        _check(physics, path, data)
        short = name.rpartition(".")[2]
        key = path if short in parts else short
        expression = f"{module}.{name}"
        is_numpy = isinstance(physics, BlackBoxPhysics) and physics is not thing
        parts[key] = physics
        code[key] = f"BlackBoxPhysics({expression})" if is_numpy else expression
    modules = tuple(dict.fromkeys(path.partition(":")[0] for path in paths))
    if len(parts) == 1:
        return NamedPhysics(next(iter(parts.values())), {"": next(iter(code.values()))}, modules)
    return NamedPhysics(as_physics({**parts}), code, modules)


def _imported(path: str) -> Any:
    """What a path names."""
    module, _, name = path.partition(":")
    if not _FORM.fullmatch(path):
        file = module.endswith(".py") or "/" in module or "\\" in module
        hint = " Give the module without folder and .py, and run this in its folder." * file
        raise ValueError(
            f"Expected --physics as module:function, such as pump:head for the function head of "
            f"pump.py, found {path!r}.{hint}"
        )
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            near = get_close_matches(module, [file.stem for file in Path().glob("*.py")], n=1)
            meant = f" Is it {near[0]!r}?" if near else ""
            raise ValueError(
                f"There is no module {error.name!r} for --physics {path} in this folder, or where "
                f"else Python looks (PYTHONPATH).{meant}"
            ) from error
        raise ValueError(
            f"{module} cannot be imported: it needs {error.name!r}, which is not installed."
        ) from error
    except (Exception, SystemExit) as error:  # importing runs the user's code
        raise ValueError(
            f"{module} cannot be imported: {type(error).__name__}: {error}{_place(error)}"
        ) from error
    try:
        return attrgetter(name)(found)
    except AttributeError as error:
        own = [each for each, value in vars(found).items() if _is_physics_of(value, module)]
        names = ", ".join([*own[:_MOST], "..."] if len(own) > _MOST else own)
        near = get_close_matches(name, own, n=1)
        meant = f" Is it {near[0]!r}?" if near else ""
        raise ValueError(
            f"{module} has no {name!r}; it has {names or 'no functions'}.{meant}"
        ) from error


def _is_physics_of(value: Any, module: str) -> bool:
    """Whether it may be meant as a physics, and was not imported from elsewhere."""
    own = getattr(value, "__module__", None) == module
    return isinstance(value, Physics) or (own and callable(value))


def _place(error: BaseException) -> str:
    """Where in the user's code an error was raised."""
    if isinstance(error, SyntaxError):
        return ""  # its text has the line
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "importlib" not in frame.filename]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own[1:] else ""


def _check(physics: Physics, path: str, data: CsvData) -> None:
    """Raise an error that names the lines of the file at which a physics fails."""
    X, m = data.X.values, data.Y.values.shape[-1]
    try:
        with torch.no_grad():
            Y = physics(X)
            physics.forget()
            again = physics(X)
    except PhysicsError as error:
        raise ValueError(f"--physics {path}: {_failure(error, physics, data)}") from error
    except ValueError as error:
        raise ValueError(f"--physics {path}: {error}") from error
    if Y.shape[-1] != m:
        raise ValueError(
            f"--physics {path}: expected {plural(m, 'column')}, one for each of --outputs "
            f"{', '.join(data.Y.columns)}, found {Y.shape[-1]}."
        )
    if huge := _where(Y.abs() > LARGEST):
        raise ValueError(
            f"--physics {path}: expected values between {-LARGEST:.0e} and {LARGEST:.0e}, found "
            f"others in {len(huge)} of {plural(len(X), 'row')}. Mend the physics there, or keep "
            f"such inputs out:{_told(huge, data)}"
        )
    if other := _where(~torch.isclose(again, Y, rtol=_SAME, atol=_SAME * float(Y.abs().max()))):
        raise ValueError(
            f"--physics {path}: expected the same values whenever it is called, found others at "
            f"the second call in {len(other)} of {plural(len(X), 'row')}. Take random numbers "
            f"out of it, or let it set their seed itself:{_told(other, data)}"
        )


def _where(rows: Tensor) -> tuple[int, ...]:
    """The rows with a True."""
    return tuple(rows.any(-1).nonzero().flatten().tolist())


def _failure(error: PhysicsError, physics: Physics, data: CsvData) -> str:
    rows, message = error.rows, str(error.args[0])
    X = data.X.values
    if len(rows) == len(X) > 1:  # a function of all rows does not say which
        failing = [(i, found) for i, row in enumerate(X) if (found := _fails(physics, row))]
        if 0 < len(failing) < len(X):
            rows, message = tuple(i for i, _ in failing), failing[0][1]
    return f"{message}{_told(rows, data)}" if rows else message


def _told(rows: Sequence[int], data: CsvData) -> str:
    """The first of some rows by their lines in the file and their inputs."""
    shown = []
    for i in rows[:_SHOWN]:
        values = zip(data.X.columns, data.X.values[i].tolist(), strict=True)
        at = ", ".join(f"{name} = {value:.6g}" for name, value in values)
        shown.append(f"\n  line {data.lines[i]}: {at}")
    more = f"\n  and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
    return f"{''.join(shown)}{more}"


def _fails(physics: Physics, row: Tensor) -> str:
    try:
        with torch.no_grad():
            physics(row.unsqueeze(0))
    except PhysicsError as error:
        return str(error.args[0])
    return ""
