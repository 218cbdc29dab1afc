"""The physics of a command line: functions of modules, or formulas with unknown parameters."""

from __future__ import annotations

import math
import os
import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files.table_columns import LARGEST
from gpadjust.physics import (
    BlackBoxPhysics,
    FormulaPhysics,
    Physics,
    PhysicsError,
    Unknown,
)
from gpadjust.physics.formula import names_in, symbol
from gpadjust.physics.function import array_physics
from gpadjust.report.inputs import TableData, meant
from gpadjust.report.markup import plural

_PATH = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
_PRIOR = re.compile(
    r"\s*([^=\[]+?)\s*(?:\[(.*)\])?\s*=\s*(.+?)\s*(\+/?-|±|\*/|\.\.)\s*(.+?)\s*(%?)\s*"
)
_HOW = "A Python function is given as module:function, such as pump:head."
_SHOWN = 5  # rows at which a physics fails
_SAME = 1e-6  # as a model's file asks it when it is loaded


class GivenPhysics(NamedTuple):
    """A physics, and the Python code by which a program that loads its model gives it.

    Attributes:
        physics: The physics; several by their names.
        code: An expression by its name: ``""`` of a single physics. None if the model's file holds
            all, as formulas.
        modules: The modules that these need.
    """

    physics: Physics | dict[str, Physics]
    code: dict[str, str] | None
    modules: tuple[str, ...]


def unknown_of(text: str) -> tuple[str, Unknown]:
    """The name and the prior of an unknown parameter.

    Args:
        text: ``"E [Pa]=210e9 +- 20 %"``, a standard deviation, of a percentage one that keeps the
            sign; or ``"c=0.1 */ 2"``, a factor; or ``"e=0.1 .. 0.3"``, bounds.

    Raises:
        ValueError: If it is none of these.
    """
    found = _PRIOR.fullmatch(text)
    try:
        if found is None:
            raise ValueError("it has another form")
        name, unit, one, how, other, is_share = found.groups()
        first, second = float(one), float(other)
        given: dict[str, Any] = {"unit": unit or ""}
        if is_share and how in ("*/", ".."):
            raise ValueError("a percentage goes with +-")
        if how == "..":
            first, given["bounds"] = 0.5 * (first + second), (first, second)
        elif how == "*/":
            given["factor"] = second
        elif is_share:
            given["sd"] = 0.01 * second * abs(first)
            given["bounds"] = (0.0, math.inf) if first > 0 else (-math.inf, 0.0)
        else:
            given["sd"] = second
        return name, Unknown(first, **given)
    except ValueError as error:
        raise ValueError(
            "Expected --unknown such as 'E [Pa]=210e9 +- 20 %', 'c=0.1 */ 2' (a factor), or "
            f"'e=0.1 .. 0.3' (bounds), with decimal points, found {text!r}: {error}"
        ) from error


def unknowns_of(texts: Sequence[str]) -> dict[str, Unknown]:
    """The unknown parameters of a command line by their names; the errors of :func:`unknown_of`."""
    pairs = [unknown_of(text) for text in texts]
    names = [name for name, _ in pairs]
    if again := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"Expected different --unknown, found {again[0]!r} more than once.")
    return dict(pairs)


def needs_inf(code: str) -> bool:
    """Return whether the code of a physics has bounds at infinity, and has to import it."""
    return re.search(r"\binf\b", code) is not None


def is_path(text: str) -> bool:
    """Return whether a physics is given as ``module:function``, and not as a formula."""
    return ":" in text


def columns_of(formulas: Sequence[str], names: Sequence[str], unknowns: Sequence[str]) -> list[str]:
    """The columns among some of a table that formulas name, in the order of the table.

    Raises:
        ValueError: If one is no formula, they name no column, or what is none and no unknown
            parameter; or if two columns have the same name but for their units.
    """
    named = {name for formula in formulas for name in names_in(formula)}
    known = [symbol(name) for name in names]
    found = [name for name in names if symbol(name) in named]
    if again := [symbol(name) for name in found if known.count(symbol(name)) > 1]:
        raise ValueError(
            f"Several columns are {again[0]!r} in a formula, which has no units; rename one."
        )
    absent = sorted(named - {*known, *unknowns})
    if absent or not found:
        wrong = absent[0] if absent else "none of them"
        hint = meant(wrong, [*known, *unknowns]) if absent else ""
        raise ValueError(
            f"Expected a formula of columns of the table, {', '.join(known)}, and of --unknown; "
            f"found {wrong!r} in --physics {formulas[0]!r}.{hint} {_HOW}"
        )
    return found


def given_physics(
    texts: Sequence[str], data: TableData, unknowns: Mapping[str, Unknown]
) -> GivenPhysics:
    """Import functions ``"module:name"``, read formulas, and evaluate them at the data.

    Args:
        texts: The functions and formulas.
        data: The data, whose columns formulas have.
        unknowns: The unknown parameters of the formulas.

    Raises:
        ValueError: If one has another form, its module or the function is not there or raises
            an error, it is no physics, or is given twice; if no formula has an unknown parameter;
            or if the physics fails in some row, which the error names, or returns other values
            when it is called again.
    """
    if again := [text for text in dict.fromkeys(texts) if texts.count(text) > 1]:
        raise ValueError(
            f"Expected different --physics, found {again[0]} more than once; give it once."
        )
    formulas, paths = ([t for t in texts if is_path(t) == each] for each in (False, True))
    parts: dict[str, Physics] = {}
    code: dict[str, str] = {}
    for text in texts:
        try:
            if is_path(text):
                physics, expression = _function(text, data)
            else:
                physics = _formula(text, data, unknowns)
                expression = _code(physics)
            _check(physics, data)
        except ValueError as error:
            raise ValueError(f"--physics {text}: {error}") from error
        short = text.rpartition(":")[2].rpartition(".")[2]
        if not is_path(text):  # a name that figures have room for
            short = f"formula {formulas.index(text) + 1}" if len(formulas) > 1 else "formula"
        key = text if short in parts else short
        parts[key], code[key] = physics, expression
    used = {name for physics in parts.values() for name in physics.unknowns}
    if absent := [name for name in unknowns if name not in used]:
        way = "" if formulas else " A function has its own: FunctionPhysics(f, unknowns=...)."
        raise ValueError(f"--unknown names {absent[0]!r}, which is in no formula.{way}")
    modules = tuple(dict.fromkeys(path.partition(":")[0] for path in paths))
    if len(parts) > 1:
        return GivenPhysics(parts, code if paths else None, modules)
    ((key, physics),) = parts.items()
    return GivenPhysics(physics, {"": code[key]} if paths else None, modules)


def _formula(text: str, data: TableData, unknowns: Mapping[str, Unknown]) -> FormulaPhysics:
    """The physics of a formula, with the unknown parameters that it has."""
    try:
        own = {name: each for name, each in unknowns.items() if name in names_in(text)}
        return FormulaPhysics(text, data.X.columns, unknowns=own)
    except ValueError as error:
        raise ValueError(f"{error} {_HOW}") from error


def _function(path: str, data: TableData) -> tuple[Physics, str]:
    """The physics that a path names, and the code that makes it of what the path names."""
    thing = imported(path)
    try:
        physics = array_physics(thing, data.X.to_numpy())
    except (TypeError, PhysicsError) as error:
        row = f" The first row is line {data.lines[0]} of the file."
        raise ValueError(f"{error}{row * isinstance(error, PhysicsError)}") from error
    expression = path.replace(":", ".")
    is_numpy = isinstance(physics, BlackBoxPhysics) and physics is not thing
    return physics, f"BlackBoxPhysics({expression})" if is_numpy else expression


def _code(physics: FormulaPhysics) -> str:
    """The code that makes the physics of a formula."""
    text = f"FormulaPhysics({physics.formula!r}, {[*physics.columns]!r}"
    return text + (f", unknowns={dict(physics.unknowns)!r})" if physics.unknowns else ")")


def imported(path: str) -> Any:
    """The object that a path ``module:name`` names."""
    module, _, name = path.partition(":")
    if not _PATH.fullmatch(path):
        file = module.endswith(".py") or "/" in module or "\\" in module
        hint = " Give the module without folder and .py, and run this in its folder." * file
        raise ValueError(
            f"expected module:function, such as pump:head for the function head of pump.py.{hint}"
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
        near = meant(module, (file.stem for file in Path().glob("*.py")))
        raise ValueError(
            f"there is no module {error.name!r} in this folder, or where "
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
        raise ValueError(f"{module} has no {name!r}; it has {has}.{meant(name, own)}") from error


def _check(physics: Physics, data: TableData) -> None:
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
        hint = " Commas part the outputs of a formula: is one a decimal comma?"
        raise ValueError(
            f"expected {plural(m, 'column')}, one for each of --outputs "
            f"{', '.join(data.Y.columns)}, found {Y.shape[-1]}."
            f"{hint * isinstance(physics, FormulaPhysics)}"
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


def _told(rows: Sequence[int], data: TableData) -> str:
    """The first of some rows by their lines in the file and their inputs."""
    shown = []
    for i in rows[:_SHOWN]:
        values = zip(data.X.columns, data.X.values[i].tolist(), strict=True)
        at = ", ".join(f"{name} = {value:.6g}" for name, value in values)
        shown.append(f"\n  line {data.lines[i]}: {at}")
    more = f"\n  and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
    return f"{''.join(shown)}{more}"
