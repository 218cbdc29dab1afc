"""Inputs of a command line: columns of CSV files or a spreadsheet, and options that are texts."""

from __future__ import annotations

import csv
import hashlib
import math
from argparse import Namespace
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files.fields import split_unit
from gpadjust.files.table import LARGEST, Table
from gpadjust.report.markup import bare, listed, plural

_HINT = (
    "Name columns as the file does; a unit in brackets may be left out, so that 'head' is 'head "
    '[m]\', and "h=head" calls it h.'
)


@dataclass(frozen=True)
class Columns:
    """Columns by their names, with units in brackets: like a DataFrame, as far as models ask."""

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
    """Open a CSV file or a workbook by the marks of a command line; errors have its options."""
    path = Path(file)
    if not path.exists():
        near = (other.name for other in path.absolute().parent.glob("*") if other.is_file())
        raise FileNotFoundError(f"There is no file {file!r}.{meant(path.name, near)}")
    if not path.is_file():
        what = "a folder" if path.is_dir() else "a device or a pipe"
        raise OSError(f"{file!r} is {what}, expected a CSV file.")
    return Table(file, **table_options(arguments), hint=_HINT + hint, is_command=True)


def table_options(arguments: Namespace) -> dict[str, Any]:
    """Return the options of a :class:`Table` that a command line has, None where it has none."""
    return {
        "delimiter": None if arguments.delimiter is None else mark_of(arguments.delimiter),
        "decimal": arguments.decimal,
        "names": names_of(arguments.names, "--names") or None,
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

    Inputs that are texts are categories, too; dates are times since the first. A command line has
    units and the number of rows.
    """
    d, asked = len(inputs), [*inputs.items(), *outputs.items()]
    columns = [table.label(column) for _, column in asked]
    check_different(columns, "columns as inputs and outputs")
    known = f"--inputs {','.join(inputs)}; name it there"
    check_names(categories, "--categories or --batches", inputs, known)
    units = {} if arguments.units is None else pairs(arguments.units, "--units")
    old = [column for _, column in asked]
    known = ", ".join(repr(name) for name, _ in asked)
    check_names(units, "--units", [*inputs, *outputs, *old, *columns], known)
    names, values, remarks = list[str](), list[Tensor](), list[str]()
    levels: dict[str, tuple[Any, ...]] = {}
    for (name, column), label in zip(asked, columns, strict=True):
        short, unit = split_unit(name if name != column else label)
        named = [units[key] for key in (name, column, label) if key in units]
        unit = (named or [unit or table.unit(column)])[0]
        is_input = len(values) < d
        if is_dates := is_input and table.has_dates(column):
            unit = unit or "s"
            remarks.append(f"{short} is the time since the first row, in {unit}.")
        names.append(f"{short} [{unit}]" if unit else short)
        if is_dates:
            values.append(table.times(column, unit))
        elif is_input and (name in categories or _are_names(table, column)):
            numbers, levels[names[-1]] = table.categories(column)
            values.append(numbers)
        else:
            values.append(table.numbers(column, may_miss=not is_input))
    everything, lines = torch.stack(values, -1), torch.tensor(table.lines)
    has_none = everything[:, d:].isnan().all(-1)
    rows = (~has_none).nonzero().flatten()
    if left := [str(line) for line in lines[has_none].tolist()]:
        shown = [*left[:10], f"{len(left) - 10} more"] if len(left) > 10 else left
        plural_s = "s" * (len(left) > 1)
        remarks.append(f"Left out, as they have no output: line{plural_s} {listed(shown)}.")
    if (n := len(rows)) > arguments.rows:
        order = torch.randperm(n, generator=torch.Generator().manual_seed(arguments.seed))
        rows = rows[order[: arguments.rows].sort().values]
        remarks.append(
            f"Of {plural(n, 'row')} {arguments.rows:,} were taken, drawn at random by --seed: a "
            "comparison takes time with the cube of their number. --rows takes more or fewer."
        )
    X, Y = everything[rows].split([d, len(outputs)], -1)
    for name, count in zip(names[d:], (~Y.isnan()).sum(0).tolist(), strict=True):
        if count < 2:
            raise ValueError(
                f"{table.file}: expected two rows or more with a number in {name!r}, found "
                f"{count}; a comparison wants eight or more to show anything."
            )
    if missing := int(Y.isnan().sum()):
        remarks.append(
            f"{plural(missing, 'output')} missing in rows that have others: each output learns "
            "from its own rows."
        )
    for name, own in levels.items():
        if isinstance(own[0], str):
            numbered = listed(f"{k} is {level}" for k, level in enumerate(own))
            remarks.append(f"The physics reads {bare(name)} as a number: {numbered}.")
    X_and_Y = Columns(tuple(names[:d]), X), Columns(tuple(names[d:]), Y)
    return TableData(*X_and_Y, lines[rows].tolist(), tuple(remarks), levels)


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
    named = pairs(arguments.states, "--states", short=True)
    check_names(hidden, "--hidden", named, "--states")
    has_times = math.isnan(number_of(arguments.time))
    if not arguments.actions and not has_times:
        raise ValueError("Expected --actions, as there is no column of times to stand for them.")
    acting = {"time": arguments.time}
    if arguments.actions:
        acting = pairs(arguments.actions, "--actions", short=True)
    columns = {
        "states": {name: None if name in hidden else column for name, column in named.items()},
        "actions": acting,
        "time": arguments.time if has_times else float(arguments.time),
        "time_unit": arguments.time_unit,
        "segment": arguments.segment,
    }
    own = {**named, **acting}
    units = {name: hidden[name] if name in hidden else table.unit(own[name]) for name in own}
    units["time"] = arguments.time_unit or "s"
    return columns, {name: unit for name, unit in units.items() if unit}


def mark_of(text: str) -> str:
    """Return the mark between two fields, one character; a tab may be written as in Python."""
    mark = {"\\t": "\t", "tab": "\t"}.get(text, text)
    if len(mark) != 1:
        raise ValueError(f"Expected --delimiter as one character, or tab, found {text!r}.")
    return mark


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


def pairs(text: str, option: str, *, short: bool = False) -> dict[str, str]:
    """Return ``"a=m,b=s"`` as a dictionary; ``"a"`` is ``"a=a"`` if it may be ``short``."""
    values = dict[str, str]()
    for field in names_of(text, option):
        name, equals, value = (part.strip() for part in field.rpartition("="))
        if short and not equals:
            name = value
        if not name or not value or name in values:
            raise ValueError(
                f"Expected {option} such as a=1,b=2, with different names, found {field!r}."
            )
        values[name] = value
    return values


def check_names(names: Iterable[str], option: str, known: Iterable[str], option_of: str) -> None:
    """Raise a ValueError if an option names what another one does not."""
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"{option} names {unknown[0]!r}, which is none of {option_of}.")


def check_different(names: Sequence[str], what: str) -> None:
    """Raise a ValueError if a name is there twice."""
    if again := sorted(name for name in names if names.count(name) > 1):
        raise ValueError(f"Expected different {what}, found {again[0]!r} more than once.")


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
        if not 0 <= number_of(text) <= LARGEST:
            raise ValueError(
                f"Expected {option} as a standard deviation in the unit of {name!r}, such as 0.1, "
                f"found {text!r}."
            )
    return [number_of(sds.get(name, "0")) ** 2 for name in names]


def meant(name: str, known: Iterable[str]) -> str:
    """Return a hint at the name that was meant, if some is near."""
    near = get_close_matches(name, [*known], n=1)
    return f" Is it {near[0]!r}?" if near else ""
