"""The physics of a command line: functions of modules, formulas, and equations of motion."""

from __future__ import annotations

import math
import os
import re
import sys
import traceback
from ast import unparse
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files.table import LARGEST
from gpadjust.physics import (
    BlackBoxPhysics,
    FormulaPhysics,
    ODEPhysics,
    Physics,
    PhysicsError,
    Unknown,
    as_physics,
)
from gpadjust.physics.formula import has_pi, names_in, parse, symbol
from gpadjust.physics.function import array_physics
from gpadjust.report.inputs import TableData, check_different, check_names, meant
from gpadjust.report.markup import plural

_PRIOR = re.compile(
    r"\s*([^=\[]+?)\s*(?:\[(.*)\])?\s*=\s*(.+?)\s*(\+/?-|±|\*/|\.\.)\s*(.+?)\s*(%?)\s*"
)
_EQUATION = re.compile(r"\s*([^\W\d]\w*)\s*('?)\s*=(?!=)(.*)", flags=re.DOTALL)
_HOW = "A Python function is given as module:function, such as pump:head."
_CELL = re.compile(r"[A-Z]{1,2}\d+")
_SHOWN = 5  # rows at which a physics fails
_MADE = ("BlackBoxPhysics", "FormulaPhysics", "ODEPhysics", "Unknown")
_SAME = 1e-6  # as a model's file asks it when it is loaded


class GivenPhysics(NamedTuple):
    """A physics, or several by their names, and the Python code by which a program gives it."""

    physics: Any
    code: str  # empty if a model's file holds it, as formulas
    modules: tuple[str, ...] = ()  # that the code needs


def imports_of(code: str, modules: Sequence[str], *names: str) -> str:
    """Return lines that import what the code of a physics needs, and names of the library."""
    made = [*(name for name in _MADE if f"{name}(" in code), *names]
    lines = ["from math import inf\n"] if re.search(r"\binf\b", code) else []
    lines += ["import torch", *(f"import {module}" for module in modules)]
    lines += [f"from gpadjust import {', '.join(made)}"] if made else []
    return "\n".join(lines)


def unknown_of(text: str) -> tuple[str, Unknown]:
    """Return the name and the prior of an unknown parameter.

    It is ``"E [Pa]=210e9 +- 20 %"``, a standard deviation, of a percentage one that keeps the sign;
    or ``"c=0.1 */ 2"``, a factor; or ``"e=0.1 .. 0.3"``, bounds.
    """
    match = _PRIOR.fullmatch(text)
    try:
        if match is None:
            raise ValueError("it has another form")
        name, unit, guess, how, spread, is_share = match.groups()
        first, second = float(guess), float(spread)
        options: dict[str, Any] = {"sd": second}
        if is_share and how in ("*/", ".."):
            raise ValueError("a percentage goes with +-")
        if is_share:
            bounds = (0.0, math.inf) if first > 0 else (-math.inf, 0.0)
            options = {"sd": 0.01 * second * abs(first), "bounds": bounds}
        elif how == "*/":
            options = {"factor": second}
        elif how == "..":
            first, options = 0.5 * (first + second), {"bounds": (first, second)}
        return name, Unknown(first, unit=unit or "", **options)
    except ValueError as error:
        raise ValueError(
            "Expected --unknown such as 'E [Pa]=210e9 +- 20 %', 'c=0.1 */ 2' (a factor), or "
            f"'e=0.1 .. 0.3' (bounds), with decimal points, found {text!r}: {error}"
        ) from error


def unknowns_of(texts: Sequence[str]) -> dict[str, Unknown]:
    """Return the unknown parameters of a command line by their names."""
    pairs = [(symbol(name), prior) for name, prior in map(unknown_of, texts)]
    check_different([name for name, _ in pairs], "--unknown")
    return dict(pairs)


def hidden_of(texts: Sequence[str]) -> dict[str, Unknown]:
    """Return hidden states by their names: unit, and mean and sd at the beginning."""
    hidden: dict[str, Unknown] = {}
    for text in texts:
        prior: Unknown | None = None
        with suppress(ValueError):
            name, prior = unknown_of(text)
        if prior is None or prior.sd is None:
            raise ValueError(
                "Expected --hidden with what is known of its beginning, mean and standard "
                f"deviation, such as 'rate [rad/s]=0 +- 2', found {text!r}."
            )
        hidden[name] = prior
    return hidden


def columns_of(
    formulas: Sequence[str], names: Sequence[str], inputs: Sequence[str], unknowns: Sequence[str]
) -> list[str]:
    """Return the columns that formulas name beside inputs, in the order of the table."""
    named = {name for formula in formulas for name in names_in(formula)}
    known = [symbol(name) for name in (*inputs, *names)]
    columns = [name for name in names if symbol(name) in named]
    check_different([*map(symbol, columns)], "columns in a formula, which has no units")
    absent = sorted(named - {*known, *unknowns})
    if absent or not (columns or inputs):
        wrong = absent[0] if absent else "none of them"
        hint = meant(wrong, [*known, *unknowns]) if absent else ""
        if _CELL.fullmatch(wrong):
            hint = f" {wrong} seems to be a cell: write the name of its column."
        raise ValueError(
            f"Expected a formula of columns of the table, {', '.join(known)}, and of --unknown; "
            f"found {wrong!r} in --physics {formulas[0]!r}.{hint} Another name for a column: "
            f'--inputs "d=wire d". {_HOW}'
        )
    return columns


def check_constants(formulas: Iterable[str], names: Iterable[str]) -> None:
    """Raise a ValueError if formulas name pi and a column or an unknown parameter has that name."""
    if "pi_" not in map(symbol, names):
        return
    for formula in formulas:
        if has_pi(formula):
            raise ValueError(
                f"Found pi in --physics {formula!r}: formulas take it as 3.14159, and here is a "
                "'pi' of your own. Write yours as pi_, and the number as 3.14159; or give the "
                'column another name, such as "p=pi".'
            )


def given_physics(
    texts: Sequence[str], data: TableData, unknowns: Mapping[str, Unknown]
) -> GivenPhysics:
    """Import functions ``"module:name"``, read formulas, and evaluate them at the data."""
    check_different(texts, "--physics")
    formulas = [text for text in texts if ":" not in text]
    parts, code = dict[str, Physics](), dict[str, str]()
    for text in texts:
        short = text.rpartition(":")[2].rpartition(".")[2]
        if text in formulas:  # a name that figures have room for
            short = f"formula {formulas.index(text) + 1}" if len(formulas) > 1 else "formula"
        name = text if short in parts else short
        make = _formula if text in formulas else _function
        try:
            parts[name], code[name] = make(text, data, unknowns)
            _check(parts[name], data)
        except ValueError as error:
            raise ValueError(f"--physics {text}: {error}") from error
    used = {name for physics in parts.values() for name in physics.unknowns}
    if absent := [name for name in unknowns if name not in used]:
        way = "" if formulas else " A function has its own: FunctionPhysics(f, unknowns=...)."
        raise ValueError(f"--unknown names {absent[0]!r}, which is in no formula.{way}")
    modules = tuple(dict.fromkeys(text.partition(":")[0] for text in texts if ":" in text))
    several = ", ".join(f"{name!r}: {own}" for name, own in code.items())
    expression = f"{{{several}}}" if len(parts) > 1 else code[name]
    physics = parts if len(parts) > 1 else parts[name]
    return GivenPhysics(physics, expression if modules else "", modules)


def _formula(text: str, data: TableData, unknowns: Mapping[str, Unknown]) -> tuple[Physics, str]:
    """Return the physics of a formula, with the unknown parameters that it has, and its code."""
    try:
        own = {name: unknown for name, unknown in unknowns.items() if name in names_in(text)}
        physics = FormulaPhysics(text, data.X.columns, unknowns=own)
    except ValueError as error:
        raise ValueError(f"{error} {_HOW}") from error
    more = f", unknowns={own!r}" if own else ""
    return physics, f"FormulaPhysics({text!r}, {[*physics.columns]!r}{more})"


def _function(path: str, data: TableData, _: object = None) -> tuple[Physics, str]:
    """Return the physics that a path names, and the code that makes it of what the path names."""
    thing, code = imported(path), path.replace(":", ".")
    try:
        physics = array_physics(thing, data.X.to_numpy())
    except (TypeError, PhysicsError) as error:
        row = f" The first row is line {data.lines[0]} of the file."
        raise ValueError(f"{error}{row * isinstance(error, PhysicsError)}") from error
    is_numpy = isinstance(physics, BlackBoxPhysics) and physics is not thing
    return physics, f"BlackBoxPhysics({code})" if is_numpy else code


def motion(
    texts: Sequence[str],
    states: Sequence[str],
    actions: Sequence[str],
    unknowns: Mapping[str, Unknown],
    step: float,
) -> GivenPhysics:
    """Return the physics ``"module:name"`` of a machine, or of equations, one for each state."""
    if paths := [text for text in texts if ":" in text]:
        path, module = paths[0], paths[0].partition(":")[0]
        if len(texts) > 1 or unknowns:
            raise ValueError(
                f"Expected {path} alone: it has the next values of all states, and its own "
                "unknown parameters, as of ODEPhysics(f, ..., unknowns=...)."
            )
        try:
            return GivenPhysics(as_physics(imported(path)), path.replace(":", "."), (module,))
        except (ValueError, TypeError) as error:
            raise ValueError(f"--physics {path}: {error}") from error
    sides, primes = dict[str, str](), set[str]()
    for text in texts:
        match = _EQUATION.fullmatch(text)
        trees = [] if match is None else parse(match[3])
        if match is None or len(trees) != 1 or match[1] in sides:
            raise ValueError(
                'Expected --physics as one equation for each state, such as "rate\'=-sin(angle)" '
                "(a time derivative) or 'level=0.9*level' (its next value), or module:name, found "
                f'{text!r}. Names have no blanks: --states "T=Temperature 1".'
            )
        sides[match[1]] = unparse(trees[0])
        primes.add(match[2])
    if {*sides} != {*states} or len(primes) > 1:
        raise ValueError(
            f"Expected an equation for each of {', '.join(states)}, all of time derivatives or all "
            f"of next values, found those of {', '.join(sides)}."
        )
    formula, columns = ", ".join(sides[name] for name in states), [*states, *actions]
    check_names(unknowns, "--unknown", names_in(formula), "the names in equations")
    physics: Physics = FormulaPhysics(formula, columns, unknowns=unknowns)
    priors = "".join(f"        {name!r}: {own!r},\n" for name, own in unknowns.items())
    rest = f"{formula!r},\n    {columns},\n    unknowns={{\n{priors}    }},\n"
    code = f"FormulaPhysics(\n    {rest})"
    if primes == {"'"}:
        physics = ODEPhysics(physics, step, len(states))
        code = f"ODEPhysics({code}, step={step!r}, state_dim={len(states)})"
    return GivenPhysics(physics, code)


def imported(path: str) -> Any:
    """Return the object that a path ``module:name`` names."""
    module, _, name = path.partition(":")
    files = [file.stem for file in Path().glob("*.py")]
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        return attrgetter(name)(import_module(module))
    except (Exception, SystemExit) as error:  # importing runs the user's code
        last = traceback.extract_tb(error.__traceback__)[-1]
        is_ours = "importlib" in last.filename or last.filename == __file__
        place = "" if is_ours else f" ({Path(last.filename).name}, line {last.lineno})"
        names = [*vars(sys.modules[module])] if module in sys.modules else []
        near = meant(name, names) if module in files else meant(module, files)
        raise ValueError(
            f"it cannot be imported, {type(error).__name__}: {error}{place}. Expected "
            "module:function, such as pump:head for the function head of pump.py in this folder, "
            f"or one of PYTHONPATH.{near}"
        ) from error


@torch.no_grad()
def _check(physics: Physics, data: TableData) -> None:
    """Raise a ValueError that names the lines of the file at which a physics fails."""
    n, m = len(data.lines), len(data.Y.columns)
    Y, again = _values(physics, data), _values(physics, data)
    if Y.shape[-1] != m:
        hint = " Commas part the outputs of a formula: is one a decimal comma?"
        raise ValueError(
            f"expected {plural(m, 'column')}, one for each of --outputs "
            f"{', '.join(data.Y.columns)}, found {Y.shape[-1]}."
            f"{hint * isinstance(physics, FormulaPhysics)}"
        )
    is_same = torch.isclose(again, Y, rtol=_SAME, atol=_SAME * float(Y.abs().max()))
    exclude = "Correct the physics there, or exclude such inputs:"
    settle = "Take random numbers out of it, or let it set their seed itself:"
    checks = {
        f"values between {-LARGEST:.0e} and {LARGEST:.0e}": (Y.abs() > LARGEST, exclude),
        "the same values whenever it is called": (~is_same, settle),
    }
    for expected, (is_wrong, way_out) in checks.items():
        if rows := is_wrong.any(-1).nonzero().flatten().tolist():
            found = f"found others in {len(rows)} of {plural(n, 'row')}"
            raise ValueError(f"expected {expected}, {found}. {way_out}{_lines(rows, data)}")


def _values(physics: Physics, data: TableData) -> Tensor:
    """Return a physics at the data; its error, if any, names the lines of the file."""
    X, errors = data.X.values, dict[int, str]()
    physics.forget()
    try:
        return physics(X)
    except PhysicsError as error:
        rows, message = [*error.rows], str(error.args[0])
        for i in range(len(X) if len(rows) == len(X) > 1 else 0):  # which one does not say
            try:
                physics(X[i : i + 1])
            except PhysicsError as of_row:
                errors[i] = str(of_row.args[0])
        if 0 < len(errors) < len(X):
            rows, message = [*errors], next(iter(errors.values()))
        raise ValueError(message + _lines(rows, data)) from error


def _lines(rows: Sequence[int], data: TableData) -> str:
    """Return the first of some rows by their lines in the file and their inputs."""
    shown = []
    for i in rows[:_SHOWN]:
        values = zip(data.X.columns, data.X.values[i].tolist(), strict=True)
        at = ", ".join(f"{name} = {value:.6g}" for name, value in values)
        shown.append(f"\n  line {data.lines[i]}: {at}")
    more = f"\n  and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
    return f"{''.join(shown)}{more}"
