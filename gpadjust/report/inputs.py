"""Inputs and outputs of a report's command line: columns of a CSV file or a spreadsheet."""

from __future__ import annotations

import csv
import hashlib
import math
import sys
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.files.table_columns import LARGEST, TableColumns
from gpadjust.report.markup import listed, name_and_unit, plural

_HINT = (
    "Name columns as the first line does; a unit in brackets may be left out, so that 'head' is "
    "'head [m]'."
)


@dataclass(frozen=True)
class Columns:
    """Columns with names, as the models take them: like a DataFrame, as far as they ask.

    Attributes:
        columns: The names, with units in brackets.
        values: ``n x k``.
    """

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
    """The inputs and outputs of a file.

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


def open_table(
    file: str, delimiter: str = ",", decimal: str = ".", sheet: str | None = None
) -> TableColumns:
    """Open a CSV file or a workbook; the arguments and errors are those of ``TableColumns``."""
    path = Path(file)
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or a pipe"
        raise OSError(f"{file!r} is {what}, expected a CSV file.")
    if not path.exists():
        near = (each.name for each in path.absolute().parent.glob("*") if each.is_file())
        raise FileNotFoundError(f"There is no file {file!r}.{meant(path.name, near)}")
    said = "--{} {!r}"
    return TableColumns(file, delimiter, decimal=decimal, sheet=sheet, hint=_HINT, option=said)


def read_table(
    table: TableColumns,
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: dict[str, str],
    categories: Sequence[str] = (),
    most: int | None = None,
    seed: int = 0,
) -> TableData:
    """Read columns of a table; an output may be missing in some rows.

    Args:
        table: The table.
        inputs: The columns of the inputs, in the order in which the physics takes them.
        outputs: Those of the outputs, in the order in which the physics returns them.
        units: Units of columns whose names do not have them.
        categories: The inputs that are categories; others that are texts are, too.
        most: The most rows to take; of more, so many are drawn.
        seed: Of the drawing.

    Raises:
        ValueError: If a column is missing or asked for twice, a field is no number, an input is
            missing, or there are too few rows.
    """
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
        raise ValueError(
            f"The category {unknown[0]!r} is none of --inputs {','.join(inputs)}; name it there."
        )
    names = _with_units(headers, asked, units)
    values, levels = [], {}
    for i, name in enumerate(headers):
        if i < d and (asked[i] in categories or _are_names(table, name)):
            column, levels[names[i]] = table.categories(name)
        else:
            column = table.numbers(name, may_miss=i >= d)
        values.append(column)
    X, Y = torch.stack(values[:d], -1), torch.stack(values[d:], -1)
    seen = ~Y.isnan().all(-1)
    remarks = []
    lines = torch.tensor(table.lines)
    if left := [str(line) for line in lines[~seen].tolist()]:
        shown = [*left[:10], f"{len(left) - 10} more"] if len(left) > 10 else left
        remarks.append(
            f"Left out, as they have no output: line{'s' * (len(left) > 1)} {listed(shown)}."
        )
    X, Y, lines = X[seen], Y[seen], lines[seen]
    if most is not None and (n := len(lines)) > most:
        order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
        drawn = order[:most].sort().values
        X, Y, lines = X[drawn], Y[drawn], lines[drawn]
        remarks.append(
            f"Of {plural(n, 'row')} {most:,} were taken, drawn at random by --seed: a comparison "
            "takes time with the cube of their number. --rows takes more or fewer."
        )
    for name, y in zip(names[d:], Y.unbind(-1), strict=True):
        if (number := int((~y.isnan()).sum())) < 2:
            raise ValueError(
                f"{table.file}: expected two rows or more with a number in {name!r}, found "
                f"{number}; a comparison wants eight or more to show anything."
            )
    if missing := int(Y.isnan().sum()):
        remarks.append(
            f"{plural(missing, 'output')} missing in rows that have others: each output learns "
            "from its own rows."
        )
    for name, own in levels.items():
        if isinstance(own[0], str):
            numbers = listed(f"{k} is {level}" for k, level in enumerate(own))
            remarks.append(f"The physics reads {name_and_unit(name)[0]} as a number: {numbers}.")
    digest = digest_of(table.file)
    columns = Columns(tuple(names[:d]), X), Columns(tuple(names[d:]), Y)
    return TableData(*columns, tuple(lines.tolist()), tuple(remarks), digest, levels)


def _are_names(table: TableColumns, name: str) -> bool:
    """Return whether all fields of a column begin with a letter, and most of them repeat."""
    try:
        texts = table.texts(name)
    except ValueError:  # one is empty
        return False
    return all(text[0].isalpha() for text in texts) and 2 * len({*texts}) <= max(8, len(texts))


def mark_of(text: str) -> str:
    """The mark between two fields; a tab may be written as in Python.

    Raises:
        ValueError: If it is not one character.
    """
    mark = {"\\t": "\t", "tab": "\t"}.get(text, text)
    if len(mark) != 1:
        raise ValueError(f"Expected --delimiter as one character, or tab, found {text!r}.")
    return mark


def digest_of(file: str) -> str:
    """The beginning of a file's SHA-256."""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12]


def say(text: str) -> None:
    """Print a line beside the result, while a command works."""
    print(text, file=sys.stderr, flush=True)


def notes_of(caught: Sequence[warnings.WarningMessage]) -> tuple[str, ...]:
    """The texts of warnings that a reader may need, each once."""
    kinds = (DeprecationWarning, PendingDeprecationWarning)
    return tuple(dict.fromkeys(str(w.message) for w in caught if not issubclass(w.category, kinds)))


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


def meant(name: str, known: Iterable[str]) -> str:
    """Return a hint at the name that was meant, if some is near."""
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
