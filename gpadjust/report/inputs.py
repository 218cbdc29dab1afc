"""Inputs of the command line of a report: the columns of a CSV file, and the physics."""

from __future__ import annotations

import csv
import hashlib
import math
import os
import re
import sys
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files import LARGEST, CsvColumns
from gpadjust.physics import BlackBoxPhysics, Physics, PhysicsError, as_physics
from gpadjust.physics.array_physics import array_physics
from gpadjust.report.markup import listed, name_and_unit, plural

_HINT = (
    "Name columns as the first line does; a unit in brackets may be left out, so that 'head' is "
    "'head [m]'."
)
_FORM = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
_SHOWN = 5  # rows at which a physics fails
_SAME = 1e-6  # as a model's file asks it when it is loaded


@dataclass(frozen=True)
class Columns:
    """Columns with names, as the models take them: like a DataFrame, as far as they ask.

    Attributes:
        columns: The names, with units in brackets.
        values: ``n x k``.
    """

    columns: tuple[str, ...]
    values: Tensor

    def to_numpy(self) -> Any:
        """The values, as an array."""
        return self.values.numpy()


class CsvData(NamedTuple):
    """The inputs and outputs of a CSV file.

    Attributes:
        X: The inputs, ``n x d``.
        Y: The outputs, ``n x m``, NaN where there is none.
        lines: The line of each row in the file.
        remarks: Rows left out and outputs missing, in sentences.
        digest: The beginning of the file's SHA-256.
        levels: The levels of the categories among the inputs, by name: numbers, or texts, whose
            numbers from 0 the inputs have.
    """

    X: Columns
    Y: Columns
    lines: tuple[int, ...]
    remarks: tuple[str, ...]
    digest: str
    levels: dict[str, tuple[Any, ...]]


class NamedPhysics(NamedTuple):
    """A physics, and the Python code by which a program that loads its model gives it.

    Attributes:
        physics: The physics.
        code: An expression by its name: ``""`` of a single physics.
        modules: The modules that these need.
    """

    physics: Physics
    code: dict[str, str]
    modules: tuple[str, ...]


def read_csv(
    file: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: dict[str, str],
    delimiter: str = ",",
    decimal: str = ".",
    categories: Sequence[str] = (),
) -> CsvData:
    """Read columns of a CSV file; an output may be missing in some rows.

    Args:
        file: The file, whose first line names the columns.
        inputs: The columns of the inputs, in the order in which the physics takes them.
        outputs: Those of the outputs, in the order in which the physics returns them.
        units: Units of columns whose names do not have them.
        delimiter: The mark between two fields.
        decimal: The decimal mark.
        categories: The inputs that are categories, which may be texts.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If a column is missing or asked for twice, a field is no number, an input is
            missing, or there are too few rows.
    """
    path = Path(file)
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or a pipe"
        raise OSError(f"{file!r} is {what}, expected a CSV file.")
    if not path.exists():
        near = (each.name for each in path.absolute().parent.glob("*") if each.is_file())
        raise FileNotFoundError(f"There is no file {file!r}.{_meant(path.name, near)}")
    table = CsvColumns(file, delimiter, decimal=decimal, hint=_HINT, option="--{} {!r}")
    asked = (*inputs, *outputs)
    bare = [name_and_unit(name)[0] for name in table.names]
    headers = [
        table.names[bare.index(name)] if name not in table.names and bare.count(name) == 1 else name
        for name in asked
    ]
    if again := sorted({name for name in headers if headers.count(name) > 1}):
        raise ValueError(
            f"Expected different columns as inputs and outputs, got {again[0]!r} more than once."
        )
    d = len(inputs)
    if unknown := [name for name in categories if name not in inputs]:
        raise ValueError(f"The category {unknown[0]!r} is none of --inputs.")
    names = _with_units(headers, asked, units)
    values, levels = [], {}
    for i, name in enumerate(headers):
        if asked[i] in categories:
            column, levels[names[i]] = table.categories(name)
        else:
            column = _numbers(table, name, may_miss=i >= d)
        values.append(column)
    X, Y = torch.stack(values[:d], -1), torch.stack(values[d:], -1)
    seen = ~Y.isnan().all(-1)
    remarks = []
    lines = torch.tensor(table.lines)
    if left := [str(line) for line in lines[~seen].tolist()]:
        shown = [*left[:10], f"{len(left) - 10} more"] if len(left) > 10 else left
        remarks.append(f"Left out, as they have no output: line {listed(shown)}.")
    X, Y, lines = X[seen], Y[seen], lines[seen]
    for name, y in zip(names[d:], Y.unbind(-1), strict=True):
        if (number := int((~y.isnan()).sum())) < 2:
            raise ValueError(
                f"{file}: expected two rows or more with a number in {name!r}, found {number}; a "
                "comparison wants eight or more to show anything."
            )
    if missing := int(Y.isnan().sum()):
        remarks.append(
            f"{plural(missing, 'output')} missing in rows that have others: each output learns "
            "from its own rows."
        )
    for name, own in levels.items():
        if isinstance(own[0], str):
            told = listed(f"{k} is {level}" for k, level in enumerate(own))
            remarks.append(f"The physics reads {name_and_unit(name)[0]} as a number: {told}.")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    columns = Columns(tuple(names[:d]), X), Columns(tuple(names[d:]), Y)
    return CsvData(*columns, tuple(lines.tolist()), tuple(remarks), digest, levels)


def _numbers(table: CsvColumns, name: str, may_miss: bool) -> Tensor:
    """The numbers of a column; the error says what to do if they are names of an input."""
    try:
        return table.numbers(name, may_miss=may_miss)
    except ValueError as error:
        if may_miss or not _are_names(table, name):
            raise
        bare = name_and_unit(name)[0]
        raise ValueError(
            f"{error} If these are names, say so by --categories {bare}, or by --batches {bare} if "
            "each only shifts the outputs, as a rig does."
        ) from error


def _are_names(table: CsvColumns, name: str) -> bool:
    """Return whether all fields of a column begin with a letter; not if one is empty."""
    try:
        return all(text[0].isalpha() for text in table.texts(name))
    except ValueError:
        return False


def names_of(text: str, option: str) -> list[str]:
    """Names with commas between them, quoted as in a CSV file where they have commas.

    Raises:
        ValueError: If there is none, one is empty, or they are of several lines.
    """
    try:
        (fields,) = csv.reader([text], skipinitialspace=True)
    except csv.Error as error:
        raise ValueError(f"Expected names in one line, found {text!r}: {error}.") from error
    names = [field.strip() for field in fields]
    if not names or "" in names:
        raise ValueError(
            f"Expected names with commas between them, such as a,b, found {option} {text!r}."
        )
    return names


def pairs(text: str, option: str) -> dict[str, str]:
    """``"a=m,b=s"`` as a dictionary."""
    found = {}
    for field in names_of(text, option):
        name, _, value = (part.strip() for part in field.rpartition("="))
        if not (name and value):
            raise ValueError(f"Expected {option} such as a=1,b=2, found {field!r}.")
        found[name] = value
    return found


def noise_variances(text: str | None, outputs: Sequence[str]) -> list[float] | None:
    """The variances of outputs, of the standard deviations that a command line has."""
    if text is None or text == "relative":
        return None
    given = pairs(text, "--noise") if "=" in text else dict.fromkeys(outputs, text)
    if unknown := [name for name in given if name not in outputs]:
        raise ValueError(f"--noise names {unknown[0]!r}, which is none of --outputs.")
    if lacking := [name for name in outputs if name not in given]:
        raise ValueError(f"--noise lacks {lacking[0]!r}: give it for each output, or for none.")
    variances = []
    for name in outputs:
        try:
            sd = float(given[name])
        except ValueError:
            sd = math.nan
        if not 0 <= sd <= LARGEST:
            raise ValueError(
                f"Expected --noise as a standard deviation in the output's unit, such as 0.1, "
                f"found {given[name]!r}."
            )
        variances.append(sd**2)
    return variances


def named_physics(paths: Sequence[str], data: CsvData) -> NamedPhysics:
    """Import functions ``"module:name"``, and evaluate them at the data.

    Raises:
        ValueError: If a name has another form, its module or the function is not there or raises
            an error, it is no physics, or is named twice; or if the physics fails in some row,
            which the error names, or returns other values when it is called again.
    """
    if again := [path for path in dict.fromkeys(paths) if paths.count(path) > 1]:
        raise ValueError(
            f"Expected different --physics, found {again[0]} more than once; give it once."
        )
    parts: dict[str, Physics] = {}
    code: dict[str, str] = {}
    for path in paths:
        thing = _imported(path)
        try:
            physics = array_physics(thing, data.X.to_numpy())
        except (TypeError, PhysicsError) as error:
            row = f" The first row is line {data.lines[0]} of the file."
            where = row * isinstance(error, PhysicsError)
            raise ValueError(f"--physics {path}: {error}{where}") from error
        try:
            _check(physics, data)
        except ValueError as error:
            raise ValueError(f"--physics {path}: {error}") from error
        short = path.rpartition(":")[2].rpartition(".")[2]
        key = path if short in parts else short
        expression = path.replace(":", ".")
        is_numpy = isinstance(physics, BlackBoxPhysics) and physics is not thing
        parts[key] = physics
        code[key] = f"BlackBoxPhysics({expression})" if is_numpy else expression
    modules = tuple(dict.fromkeys(path.partition(":")[0] for path in paths))
    if len(parts) > 1:
        return NamedPhysics(as_physics({**parts}), code, modules)
    ((key, physics),) = parts.items()
    return NamedPhysics(physics, {"": code[key]}, modules)


def _imported(path: str) -> Any:
    """The object that a path names."""
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
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise ValueError(
                f"{module} cannot be imported: it needs {error.name!r}, which is not installed."
            ) from error
        near = _meant(module, (file.stem for file in Path().glob("*.py")))
        raise ValueError(
            f"There is no module {error.name!r} for --physics {path} in this folder, or where "
            f"else Python looks (PYTHONPATH).{near}"
        ) from error
    except (Exception, SystemExit) as error:  # importing runs the user's code
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f" ({Path(last.filename).name}, line {last.lineno})"
        place = "" if isinstance(error, SyntaxError) else where
        raise ValueError(
            f"{module} cannot be imported: {type(error).__name__}: {error}{place}"
        ) from error
    try:
        return attrgetter(name)(found)
    except AttributeError as error:
        own = [
            each
            for each, value in vars(found).items()
            if isinstance(value, Physics) or getattr(value, "__module__", None) == module
        ]
        has = ", ".join(own) or "no functions"
        raise ValueError(f"{module} has no {name!r}; it has {has}.{_meant(name, own)}") from error


def _check(physics: Physics, data: CsvData) -> None:
    """Raise a ValueError that names the lines of the file at which a physics fails."""
    X, n, m = data.X.values, len(data.lines), len(data.Y.columns)
    try:
        with torch.no_grad():
            Y = physics(X)
            physics.forget()
            again = physics(X)
    except PhysicsError as error:
        rows, message = error.rows, str(error.args[0])
        if len(rows) == n > 1:  # a function of all rows does not say which
            each = {i: found for i in range(n) if (found := _error_at(physics, X[i : i + 1]))}
            if 0 < len(each) < n:
                rows, message = tuple(each), next(iter(each.values()))
        raise ValueError(message + _told(rows, data)) from error
    if Y.shape[-1] != m:
        raise ValueError(
            f"expected {plural(m, 'column')}, one for each of --outputs "
            f"{', '.join(data.Y.columns)}, found {Y.shape[-1]}."
        )
    same = torch.isclose(again, Y, rtol=_SAME, atol=_SAME * float(Y.abs().max()))
    small = f"values between {-LARGEST:.0e} and {LARGEST:.0e}"
    exclude = "Correct the physics there, or exclude such inputs:"
    settle = "Take random numbers out of it, or let it set their seed itself:"
    for expected, wrong, way_out in (
        (small, Y.abs() > LARGEST, exclude),
        ("the same values whenever it is called", ~same, settle),
    ):
        if lost := wrong.any(-1).nonzero().flatten().tolist():
            found = f"found others in {len(lost)} of {plural(n, 'row')}"
            raise ValueError(f"expected {expected}, {found}. {way_out}{_told(lost, data)}")


def _error_at(physics: Physics, row: Tensor) -> str:
    try:
        with torch.no_grad():
            physics(row)
    except PhysicsError as error:
        return str(error.args[0])
    return ""


def _told(rows: Sequence[int], data: CsvData) -> str:
    """The first of some rows by their lines in the file and their inputs."""
    shown = []
    for i in rows[:_SHOWN]:
        values = zip(data.X.columns, data.X.values[i].tolist(), strict=True)
        at = ", ".join(f"{name} = {value:.6g}" for name, value in values)
        shown.append(f"\n  line {data.lines[i]}: {at}")
    more = f"\n  and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
    return f"{''.join(shown)}{more}"


def _meant(name: str, known: Iterable[str]) -> str:
    near = get_close_matches(name, [*known], n=1)
    return f" Is it {near[0]!r}?" if near else ""


def _with_units(headers: list[str], asked: Sequence[str], units: dict[str, str]) -> list[str]:
    """The names with their units in brackets."""
    known = {name: i for i, header in enumerate(headers) for name in (header, asked[i])}
    names = [*headers]
    for name, unit in units.items():
        if name not in known:
            raise ValueError(
                f"--units names {name!r}, which is none of {', '.join(map(repr, asked))}."
            )
        names[known[name]] = f"{name_and_unit(headers[known[name]])[0]} [{unit}]"
    return names
