"""Inputs and outputs from a CSV file."""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gpadjust.files import LARGEST, CsvColumns
from gpadjust.report.numbers import listed, name_and_unit, plural

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

    def to_numpy(self) -> Any:
        """The values, as an array."""
        return self.values.numpy()


@dataclass(frozen=True)
class CsvData:
    """What a CSV file says of inputs and outputs.

    Attributes:
        X: The inputs, ``n x d``.
        Y: The outputs, ``n x m``, NaN where there is none.
        lines: The line of each row in the file.
        remarks: What was found on the way, in sentences.
        digest: The beginning of the file's SHA-256.
    """

    X: Columns
    Y: Columns
    lines: tuple[int, ...]
    remarks: tuple[str, ...]
    digest: str


def read_csv(
    file: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    units: dict[str, str],
    delimiter: str = ",",
    decimal: str = ".",
) -> CsvData:
    """Read columns of a CSV file; an output may be missing in some rows.

    Args:
        file: The file, whose first line names the columns.
        inputs: The columns of the inputs, in the order in which the physics takes them.
        outputs: Those of the outputs, in the order in which the physics returns them.
        units: Units of columns whose names do not have them.
        delimiter: What is between two fields.
        decimal: The decimal mark.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If a column is missing or asked for twice, a field is no number, an input is
            missing, or there are too few rows.
    """
    if Path(file).is_dir():
        raise IsADirectoryError(f"{file!r} is a folder, expected a CSV file: give the file's name.")
    if Path(file).exists() and not Path(file).is_file():
        raise OSError(
            f"{file!r} is a device or a pipe, expected a CSV file: write what comes from it to one."
        )
    if not Path(file).exists():
        folder = Path(file).absolute().parent
        names = [path.name for path in folder.glob("*") if path.is_file()]
        near = get_close_matches(Path(file).name, names, n=1)
        meant = f" Is it {near[0]!r}?" if near else ""
        raise FileNotFoundError(f"There is no file {file!r}.{meant}")
    table = CsvColumns(file, delimiter, decimal=decimal, hint=_HINT, option="--{} {!r}")
    headers = [_header(table.names, name) for name in (*inputs, *outputs)]
    if again := sorted({name for name in headers if headers.count(name) > 1}):
        raise ValueError(
            f"Expected different columns as inputs and outputs, got {again[0]!r} more than once."
        )
    values = [table.numbers(name) for name in headers[: len(inputs)]]
    values += [table.numbers(name, may_miss=True) for name in headers[len(inputs) :]]
    names = _with_units(headers, (*inputs, *outputs), units)
    X = torch.stack(values[: len(inputs)], -1)
    Y = torch.stack(values[len(inputs) :], -1)
    seen = ~Y.isnan().all(-1)
    lines = torch.tensor(table.lines)
    remarks = []
    if not seen.all():
        left = [str(line) for line in lines[~seen].tolist()]
        shown = [*left[:10], f"{len(left) - 10} more"] if len(left) > 10 else left
        of = "has no output and is" if len(left) == 1 else "have no output and are"
        line = "Line" if len(left) == 1 else "Lines"
        remarks.append(f"{line} {listed(shown)} {of} left out.")
    X, Y, lines = X[seen], Y[seen], lines[seen]
    for name, y in zip(names[len(inputs) :], Y.unbind(-1), strict=True):
        if (number := int((~y.isnan()).sum())) < 2:
            raise ValueError(
                f"{file}: expected two rows or more with a number in {name!r}, found {number}; a "
                "comparison wants eight or more to show anything."
            )
    missing = int(Y.isnan().sum())
    if missing:
        remarks.append(
            f"{plural(missing, 'output')} missing in rows that have others: each output learns "
            "from its own rows."
        )
    return CsvData(
        Columns(tuple(names[: len(inputs)]), X),
        Columns(tuple(names[len(inputs) :]), Y),
        tuple(lines.tolist()),
        tuple(remarks),
        hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12],
    )


def split(text: str) -> list[str]:
    """Names with commas between them, quoted as in a CSV file where they have commas.

    Raises:
        ValueError: If they are of several lines.
    """
    try:
        (fields,) = csv.reader([text], skipinitialspace=True)
    except csv.Error as error:
        raise ValueError(f"Expected names in one line, found {text!r}: {error}.") from error
    return [field.strip() for field in fields]


def names_of(text: str, option: str) -> list[str]:
    """The names of columns that an option of a command line has.

    Raises:
        ValueError: If there is none, or one is empty.
    """
    names = split(text)
    if not names or "" in names:
        raise ValueError(
            f"Expected names with commas between them, such as a,b, found {option} {text!r}."
        )
    return names


def pairs(text: str, what: str) -> dict[str, str]:
    """``"a=m,b=s"`` as a dictionary."""
    found = {}
    for field in split(text):
        name, equals, value = field.rpartition("=")
        if not (equals and name.strip() and value.strip()):
            raise ValueError(f"Expected {what} such as a=1,b=2, found {field!r}.")
        found[name.strip()] = value.strip()
    return found


def noise_variances(text: str | None, outputs: Sequence[str]) -> list[float] | None:
    """The variances of outputs of the standard deviations that a command line has."""
    if text is None:
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


def _header(names: Sequence[str], asked: str) -> str:
    """The name of a column in the file, that may have a unit where none was asked."""
    bare = [name for name in names if name_and_unit(name)[0] == asked]
    return bare[0] if asked not in names and len(bare) == 1 else asked


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
