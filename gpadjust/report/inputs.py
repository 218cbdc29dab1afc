"""Input of a command line: tables, physics, and options that are texts."""

from __future__ import annotations

import csv
import hashlib
import math
import os
import re
import sys
import traceback
from argparse import Namespace
from ast import unparse
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files.fields import split_unit
from gpadjust.files.table import LARGEST, Table
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
from gpadjust.words import bare, labelled, listed, noun_for, plural, shortened

_HINT = (
    "Name columns as the file does; a unit in brackets may be left out, so that 'head' is 'head "
    '[m]\', and "h=head" calls it h.'
)
_PRIOR = re.compile(
    r"\s*([^=\[]+?)\s*(?:\[(.*)\])?\s*=\s*(.+?)\s*(\+/?-|±|\*/|\.\.)\s*(.+?)\s*(%?)\s*"
)  # name, unit, guess, operator, spread, percent sign
# name of a function, its variable, ends of its range
_FUNCTION = re.compile(r"(\w+)\((.+?)\s*:\s*(.+?)\s*\.\.\s*(.+?)\)")
# name, prime of a derivative, right side
_EQUATION = re.compile(r"\s*([^\W\d]\w*)\s*('?)\s*=(?!=)(.*)", flags=re.DOTALL)
_HOW = "A Python function is given as module:function, such as pump:head."
_CELL = re.compile(r"[A-Z]{1,2}\d+")  # of a spreadsheet
_SHOWN = 5  # rows at which a physics fails
_MADE = ("BlackBoxPhysics", "FormulaPhysics", "ODEPhysics", "Unknown")  # names in code of a physics
_SAME = 1e-6  # relative difference that a model's file accepts when it is loaded


@dataclass(frozen=True)
class Columns:
    """Columns by their names, with units in brackets: as much of a DataFrame as models need."""

    columns: tuple[str, ...]
    values: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        """``n`` and ``k``."""
        return tuple(self.values.shape)

    def to_numpy(self) -> Any:
        """Return the values, as an array."""
        return self.values.numpy()


class TableData(NamedTuple):
    """Inputs and outputs of a file, ``n x d`` and ``n x m``, NaN where an output is missing."""

    X: Columns
    Y: Columns
    lines: list[int]  # of the rows in the file
    remarks: tuple[str, ...]
    levels: dict[str, tuple[Any, ...]]  # of categories; of texts, the inputs are their numbers


def open_table(file: str, arguments: Namespace, hint: str = "") -> Table:
    """Open a CSV file or a workbook with the options of a command line, which errors name."""
    path = Path(file)
    if not path.exists():
        others = (other.name for other in path.absolute().parent.glob("*") if other.is_file())
        raise FileNotFoundError(f"There is no file {file!r}.{meant(path.name, others)}")
    if not path.is_file():
        kind = "a folder" if path.is_dir() else "a device or a pipe"
        raise OSError(f"{file!r} is {kind}, expected a CSV file.")
    return Table(file, **table_options(arguments), hint=_HINT + hint, is_command=True)


def table_options(arguments: Namespace) -> dict[str, Any]:
    """Return the options of a :class:`Table` on a command line, None where it has none."""
    mark = {"\\t": "\t", "tab": "\t"}.get(arguments.delimiter, arguments.delimiter)
    if mark is not None and len(mark) != 1:
        raise ValueError(f"Expected --delimiter as one character, or tab, found {mark!r}.")
    return {
        "delimiter": mark,
        "decimal": arguments.decimal,
        "names": names_of(arguments.names, "--names") or None,  # an empty list has no meaning
        "sheet": arguments.sheet,
    }


def read_table(
    table: Table,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    categories: Sequence[str],
    arguments: Namespace,
) -> TableData:
    """Read columns of a table by new names, in the order in which the physics has them.

    Inputs that are texts are categories, too; dates are times since the first. The command line
    specifies units and the number of rows.
    """
    d = len(inputs)
    requested = [*inputs.items(), *outputs.items()]
    labels = [table.label(column) for _, column in requested]
    check_different(labels, "columns as inputs and outputs")
    options = f"--inputs {','.join(inputs)}; name it there"
    check_names(categories, "--categories or --batches", inputs, options)
    units = pairs(arguments.units, "--units")
    spellings = [*inputs, *outputs, *(column for _, column in requested), *labels]
    check_names(units, "--units", spellings, ", ".join(repr(name) for name, _ in requested))
    names, values, remarks = list[str](), list[Tensor](), [*table.remarks]
    levels: dict[str, tuple[Any, ...]] = {}
    for (name, column), label in zip(requested, labels, strict=True):
        short, unit = split_unit(name if name != column else label)
        is_input = len(values) < d
        is_date = is_input and table.has_dates(column)
        in_file = table.unit(column)
        # A unit of the option replaces that of the new name, and this that of the file.
        unit = next((units[key] for key in (name, column, label) if key in units), unit or in_file)
        if is_date:
            unit = unit or "s"
            remarks.append(f"{short} is the time since the first row, in {unit}.")
        elif in_file not in ("", unit):
            remarks.append(
                f"{short} is taken in {unit} instead of {in_file}, its unit in the file; its "
                "numbers are not converted."
            )
        names.append(labelled(short, unit))
        if is_date:
            values.append(table.times(column, unit))
        elif is_input and (name in categories or _are_names(table, column)):
            numbers, levels[names[-1]] = table.categories(column)
            values.append(numbers)
        else:
            values.append(table.numbers(column, may_miss=not is_input))
    matrix = torch.stack(values, -1)
    rows, of_rows = _rows_taken(table, matrix[:, d:], arguments)
    remarks += of_rows
    X, Y = matrix[rows].split([d, len(outputs)], -1)
    # Each output has observations to be judged by.
    for name, count in zip(names[d:], (~Y.isnan()).sum(0).tolist(), strict=True):
        if count < 2:
            raise ValueError(
                f"{table.file}: expected two rows or more with a number in {name!r}, found "
                f"{count}; a comparison needs eight or more to show anything."
            )
    if missing := int(Y.isnan().sum()):
        remarks.append(
            f"{plural(missing, 'output')} missing in rows that have others: each output is fitted "
            "to its own rows."
        )
    for name, of_column in levels.items():
        if isinstance(of_column[0], str):  # numbers stay as they are
            numbered = listed(f"{k} is {level}" for k, level in enumerate(of_column))
            remarks.append(f"The physics reads {bare(name)} as a number: {numbered}.")
    X_and_Y = Columns(tuple(names[:d]), X), Columns(tuple(names[d:]), Y)
    lines = [table.lines[row] for row in rows.tolist()]
    return TableData(*X_and_Y, lines, tuple(remarks), levels)


def _rows_taken(table: Table, Y: Tensor, arguments: Namespace) -> tuple[Tensor, list[str]]:
    """Return the rows with an output, of very many some, and remarks on the others."""
    remarks = []
    has_output = ~Y.isnan().all(-1)
    rows = has_output.nonzero().flatten()
    dropped = [str(table.lines[row]) for row in (~has_output).nonzero().flatten().tolist()]
    if dropped:
        lines = f"{noun_for(len(dropped), 'line')} {listed(shortened(dropped, 10))}"
        remarks.append(f"Left out, as they have no output: {lines}.")
    if (n := len(rows)) > arguments.rows:
        # Drawn at random, as the first rows may be of one place or time; in the order of the file.
        order = torch.randperm(n, generator=torch.Generator().manual_seed(arguments.seed))
        rows = rows[order[: arguments.rows].sort().values]
        remarks.append(
            f"Of {plural(n, 'row')} {arguments.rows:,} were taken, drawn at random by --seed: a "
            "comparison takes time with the cube of their number. --rows takes more or fewer."
        )
    return rows, remarks


def _are_names(table: Table, name: str) -> bool:
    """Return whether all fields of a column begin with a letter, and most of them repeat."""
    try:
        texts = table.texts(name)
    except ValueError:  # one is empty
        return False
    return all(text[0].isalpha() for text in texts) and 2 * len({*texts}) <= max(8, len(texts))


def log_columns(
    table: Table, hidden: Mapping[str, str], arguments: Namespace
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return columns of a log as options of ``Records.read_csv``, None if hidden, and units."""
    states = pairs(arguments.states, "--states", short=True)
    check_names(hidden, "--hidden", states, "--states")
    has_times = math.isnan(number_of(arguments.time))  # otherwise the number is the sampling step
    time = _time_column(table, arguments.time)
    if not arguments.actions and not has_times:
        raise ValueError("Expected --actions, as there is no column of times to stand for them.")
    actions = {"time": time}  # of a machine on which nothing acts
    if arguments.actions:
        actions = pairs(arguments.actions, "--actions", short=True)
    columns = {
        "states": {name: None if name in hidden else column for name, column in states.items()},
        "actions": actions,
        "time": time if has_times else float(time),
        "time_unit": arguments.time_unit,
        "segment": arguments.segment,
    }
    measured = {name: col for name, col in {**states, **actions}.items() if name not in hidden}
    units = {**hidden, **{name: table.unit(column) for name, column in measured.items()}}
    units["time"] = arguments.time_unit or "s"
    return columns, {name: unit for name, unit in units.items() if unit}


def _time_column(table: Table, name: str) -> str:
    """Return the column of times: the only one of dates where no column has the default name."""
    headers = [header for header in table.headers if table.headers.count(header) == 1]
    dates = [header for header in headers if table.has_dates(header)]
    if name != "time" or len(dates) != 1 or name in {*table.headers, *table.names}:
        return name
    column = table.bare(dates[0])
    table.remarks.append(f"{table.file}: the times are in its only column of dates, {column!r}.")
    return column


class GivenPhysics(NamedTuple):
    """A physics, or several by their names, and the Python code by which a program gives it."""

    physics: Any
    code: str  # empty if a model's file holds it, as formulas
    modules: tuple[str, ...] = ()  # that the code needs


def imports_of(code: str, modules: Sequence[str], *names: str) -> str:
    """Return lines that import what the code of a physics needs, and names of the library."""
    names = (*(name for name in _MADE if f"{name}(" in code), *names)
    lines = ["import torch", *(f"import {module}" for module in modules)]
    if re.search(r"\binf\b", code):
        lines.insert(0, "from math import inf\n")
    if names:
        lines.append(f"from gpadjust import {', '.join(names)}")
    return "\n".join(lines)


def unknown_of(text: str) -> tuple[str, Unknown]:
    """Return the name and the prior of an unknown parameter.

    It is ``"E [Pa]=210e9 +- 20 %"``, a standard deviation, of a percentage one that keeps the sign;
    or ``"c=0.1 */ 2"``, a factor; or ``"e=0.1 .. 0.3"``, bounds. ``"c(speed: 0 .. 9)=0.1 */ 2"`` is
    a function.
    """
    match = _PRIOR.fullmatch(text)
    try:
        if match is None:
            raise ValueError("it has another form")
        name, unit, guess, operator, spread, is_share = match.groups()
        function = _FUNCTION.fullmatch(name)
        first = float(guess)
        second = float(spread)
        options: dict[str, Any] = {"sd": second}
        if is_share and operator in ("*/", ".."):
            raise ValueError("a percentage goes with +-")
        if is_share:  # of the guess, and a number that is known to a share has a sign
            bounds = (0.0, math.inf) if first > 0 else (-math.inf, 0.0)
            options = {"sd": 0.01 * second * abs(first), "bounds": bounds}
        elif operator == "*/":
            options = {"factor": second}
        elif operator == "..":
            options = {"bounds": (first, second)}
            first = 0.5 * (first + second)
        if function is not None:
            name, variable, low, high = function.groups()
            options |= {"function_of": variable, "between": (float(low), float(high))}
        return name, Unknown(first, unit=unit or "", **options)
    except ValueError as error:
        raise ValueError(
            "Expected --unknown such as 'E [Pa]=210e9 +- 20 %', 'c=0.1 */ 2' (a factor), or "
            f"'e=0.1 .. 0.3' (bounds), with decimal points, found {text!r}: {error}"
        ) from error


def unknowns_of(texts: Sequence[str]) -> dict[str, Unknown]:
    """Return the unknown parameters of a command line by their names."""
    priors = [(symbol(name), prior) for name, prior in map(unknown_of, texts)]
    check_different([name for name, _ in priors], "--unknown")
    return dict(priors)


def hidden_of(texts: Sequence[str]) -> dict[str, Unknown]:
    """Return hidden states by their names: unit, and mean and sd at the beginning."""
    hidden: dict[str, Unknown] = {}
    for text in texts:
        prior: Unknown | None = None
        with suppress(ValueError):  # the error below has an example of a state
            name, prior = unknown_of(text)
        if prior is None or prior.sd is None:
            raise ValueError(
                "Expected --hidden with mean and standard deviation at its beginning, such as "
                f"'rate [rad/s]=0 +- 2', found {text!r}."
            )
        hidden[name] = prior
    return hidden


def columns_of(
    formulas: Sequence[str], names: Sequence[str], inputs: Sequence[str], unknowns: Sequence[str]
) -> list[str]:
    """Return the columns that formulas name in addition to inputs, in the order of the table."""
    used = {name for formula in formulas for name in names_in(formula)}
    symbols = [symbol(name) for name in (*inputs, *names)]
    columns = [name for name in names if symbol(name) in used]
    check_different([*map(symbol, columns)], "columns in a formula, which has no units")
    absent = sorted(used - {*symbols, *unknowns})
    if not absent and (columns or inputs):
        return columns
    wrong = absent[0] if absent else "none of them"
    hint = meant(wrong, [*symbols, *unknowns])
    if _CELL.fullmatch(wrong):
        hint = f" {wrong} seems to be a cell: write the name of its column."
    raise ValueError(
        f"Expected a formula of columns of the table, {', '.join(symbols)}, and of --unknown; "
        f"found {wrong!r} in --physics {formulas[0]!r}.{hint} Another name for a column: "
        f'--inputs "d=wire d". {_HOW}'
    )


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
        short = _short_name(text, formulas)
        name = text if short in parts else short
        try:  # before the fit, which may take minutes
            if text in formulas:
                parts[name], code[name] = _formula(text, data, unknowns)
            else:
                parts[name], code[name] = _function(text, data)
            _check(parts[name], data)
        except ValueError as error:
            raise ValueError(f"--physics {text}: {error}") from error
    used = {name for physics in parts.values() for name in physics.unknowns}
    if absent := [name for name in unknowns if name not in used]:
        message = f"--unknown names {absent[0]!r}, which is in no formula."
        if not formulas:
            message += " A function has its own: FunctionPhysics(f, unknowns=...)."
        raise ValueError(message)
    # A single physics is itself, several are a dictionary.
    physics: Any = parts
    program = f"{{{', '.join(f'{name!r}: {text}' for name, text in code.items())}}}"
    if len(parts) == 1:
        (physics,) = parts.values()
        (program,) = code.values()
    modules = tuple(dict.fromkeys(text.partition(":")[0] for text in texts if ":" in text))
    if not modules:  # a model's file holds formulas
        program = ""
    return GivenPhysics(physics, program, modules)


def _short_name(text: str, formulas: Sequence[str]) -> str:
    """Return a name for which figures have room."""
    if text not in formulas:
        return text.rpartition(":")[2].rpartition(".")[2]
    if len(formulas) == 1:
        return "formula"
    return f"formula {formulas.index(text) + 1}"


def _formula(text: str, data: TableData, unknowns: Mapping[str, Unknown]) -> tuple[Physics, str]:
    """Return the physics of a formula, with its unknown parameters, and its code."""
    try:
        used = {name: unknown for name, unknown in unknowns.items() if name in names_in(text)}
        physics = FormulaPhysics(text, data.X.columns, unknowns=used)
    except ValueError as error:
        raise ValueError(f"{error} {_HOW}") from error
    arguments = f"{text!r}, {[*physics.columns]!r}"
    if used:
        arguments += f", unknowns={used!r}"
    return physics, f"FormulaPhysics({arguments})"


def _function(path: str, data: TableData) -> tuple[Physics, str]:
    """Return the physics that a path names, and its code."""
    function = imported(path)
    code = path.replace(":", ".")
    try:
        physics = array_physics(function, data.X.to_numpy())
    except TypeError as error:
        raise ValueError(str(error)) from error
    except PhysicsError as error:
        row = f"The first row is line {data.lines[0]} of the file."
        raise ValueError(f"{error} {row}") from error
    is_numpy = isinstance(physics, BlackBoxPhysics) and physics is not function
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
        path = paths[0]
        if len(texts) > 1 or unknowns:
            raise ValueError(
                f"Expected {path} alone: it has the next values of all states, and its own "
                "unknown parameters, as of ODEPhysics(f, ..., unknowns=...)."
            )
        try:
            physics = as_physics(imported(path))
        except (ValueError, TypeError) as error:
            raise ValueError(f"--physics {path}: {error}") from error
        return GivenPhysics(physics, path.replace(":", "."), (path.partition(":")[0],))
    # Read the right side of each state, and whether it is a derivative: a prime, or nothing.
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
            f"of next values, found equations for {', '.join(sides)}."
        )
    # One formula has all states as its outputs, with commas between them.
    formula = ", ".join(sides[name] for name in states)
    columns = [*states, *actions]
    check_names(unknowns, "--unknown", names_in(formula), "the names in equations")
    physics = FormulaPhysics(formula, columns, unknowns=unknowns)
    priors = "".join(f"        {name!r}: {prior!r},\n" for name, prior in unknowns.items())
    rest = f"{formula!r},\n    {columns},\n    unknowns={{\n{priors}    }},\n"
    code = f"FormulaPhysics(\n    {rest})"
    if primes == {"'"}:  # x' = f(x, u), integrated over a step
        physics = ODEPhysics(physics, step, len(states))
        code = f"ODEPhysics({code}, step={step!r}, state_dim={len(states)})"
    return GivenPhysics(physics, code)


def imported(path: str) -> Any:
    """Return the object that a path ``module:name`` names."""
    module, _, name = path.partition(":")
    files = [file.stem for file in Path().glob("*.py")]
    if os.getcwd() not in sys.path:  # as of a script there
        sys.path.insert(0, os.getcwd())
    try:
        return attrgetter(name)(import_module(module))
    except (Exception, SystemExit) as error:  # importing runs the user's code
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f" ({Path(last.filename).name}, line {last.lineno})"
        if "importlib" in last.filename or last.filename == __file__:  # not the user's code
            place = ""
        near = meant(module, files)
        if module in files:
            near = meant(name, vars(sys.modules.get(module, object)))
        raise ValueError(
            f"it cannot be imported, {type(error).__name__}: {error}{place}. Expected "
            "module:function, such as pump:head for the function head of pump.py in this folder, "
            f"or one of PYTHONPATH.{near}"
        ) from error


@torch.no_grad()
def _check(physics: Physics, data: TableData) -> None:
    """Raise a ValueError that names the lines of the file at which a physics fails."""
    m = len(data.Y.columns)
    Y = _values(physics, data)
    again = _values(physics, data)  # a random physics cannot be judged
    if Y.shape[-1] != m:
        message = (
            f"expected {plural(m, 'column')}, one for each of --outputs "
            f"{', '.join(data.Y.columns)}, found {Y.shape[-1]}."
        )
        if isinstance(physics, FormulaPhysics):
            message += " Commas part the outputs of a formula: is one a decimal comma?"
        raise ValueError(message)
    is_same = torch.isclose(again, Y, rtol=_SAME, atol=_SAME * float(Y.abs().max()))
    exclude = "Correct the physics there, or exclude such inputs:"
    settle = "Take random numbers out of it, or let it set their seed itself:"
    checks = {
        f"values between {-LARGEST:.0e} and {LARGEST:.0e}": (Y.abs() > LARGEST, exclude),
        "the same values whenever it is called": (~is_same, settle),
    }
    for expected, (is_wrong, way_out) in checks.items():
        if rows := is_wrong.any(-1).nonzero().flatten().tolist():
            counts = f"found others in {len(rows)} of {plural(len(data.lines), 'row')}"
            raise ValueError(f"expected {expected}, {counts}. {way_out}{_lines(rows, data)}")


def _values(physics: Physics, data: TableData) -> Tensor:
    """Return a physics at the data; its error, if any, names the lines of the file."""
    X = data.X.values
    physics.forget()  # it would repeat remembered values
    try:
        return physics(X)
    except PhysicsError as error:
        rows = [*error.rows]
        message = str(error.args[0])
        errors = dict[int, str]()
        if len(rows) == len(X) > 1:  # the call failed as a whole: try its rows one by one
            for i in rows:
                try:
                    physics(X[i : i + 1])
                except PhysicsError as of_row:
                    errors[i] = str(of_row.args[0])
        if 0 < len(errors) < len(X):
            rows = [*errors]
            message = errors[rows[0]]
        raise ValueError(message + _lines(rows, data)) from error


def _lines(rows: Sequence[int], data: TableData) -> str:
    """Return the first of some rows by their lines in the file and their inputs."""
    texts = []
    for i in rows[:_SHOWN]:
        values = zip(data.X.columns, data.X.values[i].tolist(), strict=True)
        at = ", ".join(f"{name} = {value:.6g}" for name, value in values)
        texts.append(f"\n  line {data.lines[i]}: {at}")
    if len(rows) > _SHOWN:
        texts.append(f"\n  and {len(rows) - _SHOWN} more")
    return "".join(texts)


def digest_of(file: str) -> str:
    """Return the name of a file, and the beginning of its SHA-256."""
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return f"{Path(file).name} (SHA-256 {digest[:12]}...)"


def names_of(text: str | None, option: str) -> list[str]:
    """Return names with commas between them, quoted as in a CSV file where they have commas."""
    if text is None:
        return []
    names = [""]
    with suppress(csv.Error):  # of several lines
        names = [field.strip() for field in next(csv.reader([text], skipinitialspace=True))]
    if not names or "" in names:
        raise ValueError(
            f"Expected names with commas between them, such as a,b, found {option} {text!r}."
        )
    return names


def pairs(text: str | None, option: str, *, short: bool = False) -> dict[str, str]:
    """Return ``"a=m,b=s"`` as a dictionary; ``"a"`` is ``"a=a"`` if it may be ``short``."""
    values = dict[str, str]()
    for field in names_of(text, option):
        # The last sign: a name may have others.
        name, equals, value = (part.strip() for part in field.rpartition("="))
        if short and not equals:
            name = value
        if not name or not value or name in values:
            raise ValueError(
                f"Expected {option} such as a=1,b=2, with different names, found {field!r}."
            )
        values[name] = value
    return values


def check_names(names: Iterable[str], option: str, others: Iterable[str], of_others: str) -> None:
    """Raise a ValueError if an option names what another one does not."""
    if unknown := [name for name in names if name not in others]:
        raise ValueError(f"{option} names {unknown[0]!r}; expected one of {of_others}.")


def check_different(names: Sequence[str], subject: str) -> None:
    """Raise a ValueError if a name is there twice."""
    if repeated := sorted(name for name in names if names.count(name) > 1):
        raise ValueError(f"Expected different {subject}, found {repeated[0]!r} more than once.")


def number_of(text: str) -> float:
    """Return a number; NaN of another text."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def variances_of(
    sds: Mapping[str, str], option: str, names: Sequence[str], option_of: str, *, all_of: bool
) -> list[float]:
    """Return the variance of each column, of standard deviations by name; 0 unless of all."""
    check_names(sds, option, names, option_of)
    if lacking := [name for name in names if all_of and name not in sds]:
        raise ValueError(f"{option} lacks {lacking[0]!r}: give it for each of them, or for none.")
    for name, text in sds.items():
        if not 0 <= number_of(text) <= LARGEST:  # NaN is not
            raise ValueError(
                f"Expected {option} as a standard deviation in the unit of {name!r}, such as 0.1, "
                f"found {text!r}."
            )
    return [number_of(sds.get(name, "0")) ** 2 for name in names]


def meant(name: str, others: Iterable[str]) -> str:
    """Return a hint at the name that was meant, if some is near."""
    near = get_close_matches(name, [*others], n=1)
    return f" Is it {near[0]!r}?" if near else ""
