"""Columns of a CSV file or a spreadsheet."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

LARGEST = 1e100
"""The largest number that is read; squares of more are no numbers."""
_OTHERS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas"}
_OF_RECORDS = (
    "Say which column it is, such as `states={'theta': 'q'}`, or what is between the fields, by "
    "`delimiter`."
)


class TableColumns:
    r"""The columns of a table by their names, which its first line has.

    Lines and columns are counted from 1, as editors and spreadsheets do. Lines of nothing but
    empty fields are left out.

    Args:
        file: The file: a CSV file in UTF-8, or a workbook, ``*.xlsx`` (the extra ``excel``).
        delimiter: What is between two fields of a CSV file.
        decimal: The decimal mark of its numbers, a point or a comma.
        sheet: The sheet of a workbook that has more than one.
        hint: What to do about a column that is not there.
        option: How errors write an option, such as ``"--{} {!r}"`` on a command line.

    Attributes:
        names: The names of all columns.
        lines: The line of each row, at which an editor shows its beginning.

    Raises:
        OSError: If the file cannot be read.
        ImportError: If it is a workbook, and openpyxl is not installed.
        ValueError: If it is no table, has no rows or several sheets, or a row has not one field for
            each name.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     file = Path(folder, "pump.csv")
        ...     _ = file.write_text("speed;head\n1000;2,5\n2000;\n")
        ...     table = TableColumns(file, ";", decimal=",")
        >>> table.names
        ('speed', 'head')
        >>> table.numbers("head", may_miss=True)
        tensor([2.5000,    nan], dtype=torch.float64)
    """

    def __init__(
        self,
        file: str | Path,
        delimiter: str = ",",
        *,
        decimal: str = ".",
        sheet: str | None = None,
        hint: str = _OF_RECORDS,
        option: str = "`{}={!r}`",
    ) -> None:
        self.file, self.decimal = str(file), decimal
        self._is_text = Path(file).suffix.lower() != ".xlsx"
        self._hint, self._option = hint, option
        if not self._is_text:
            self.decimal = "."  # its numbers have none
            rows = _rows_of_sheet(file, sheet)
        elif sheet is not None:
            raise ValueError(f"{file}: expected a workbook, *.xlsx, to have a sheet {sheet!r}.")
        else:
            rows = _rows_of_text(file, delimiter)
        found = [(line, fields) for line, fields in rows if any(map(str.strip, fields))]
        if len(found) < 2:
            what = "only a line of names" if found else "an empty file"
            raise ValueError(f"{file}: expected a line of names and then rows, found {what}.")
        (self._header, header), *self._rows = found
        self.names = tuple(name.strip() for name in header)
        self.lines = tuple(line for line, _ in self._rows)
        for line, fields in self._rows:
            if len(fields) != len(header):
                expected = f"{len(header)} field" + "s" * (len(header) != 1)
                hint = self._other_delimiter() or self._miscounted(line, fields, delimiter)
                raise ValueError(
                    f"{file}, line {line}: expected {expected}, one for each name, found "
                    f"{len(fields)}; correct the line, or leave it out.{hint}"
                )

    def __len__(self) -> int:
        return len(self._rows)

    def texts(self, name: str) -> list[str]:
        """The fields of a column.

        Raises:
            ValueError: If there is no such column, or several, or a field is empty.
        """
        column, texts = self._column(name), []
        for line, fields in self._rows:
            texts.append(fields[column].strip())
            if not texts[-1]:
                self._refuse(line, column, "a text", "")
        return texts

    def categories(self, name: str) -> tuple[Tensor, tuple[float, ...] | tuple[str, ...]]:
        """The categories of a column: numbers, ``N``, and the levels, sorted.

        Where a field is no number the levels are the texts, and the numbers are theirs, from 0.

        Raises:
            ValueError: If there is no such column, or several, or a field is empty.
        """
        texts = self.texts(name)
        values = [self._number(text) for text in texts]
        if all(map(math.isfinite, values)):
            return torch.tensor(values, dtype=torch.float64), tuple(sorted({*values}))
        levels = tuple(sorted({*texts}))
        return torch.tensor([levels.index(t) for t in texts], dtype=torch.float64), levels

    def numbers(self, name: str, *, may_miss: bool = False) -> Tensor:
        """The numbers of a column, ``N``, in float64.

        Args:
            name: The name of the column.
            may_miss: Whether numbers may be missing: NaN, where a field is empty or says so.

        Raises:
            ValueError: If there is no such column, or several, or a field is no finite number, or
                one beyond 1e100.
        """
        column, values = self._column(name), []
        expected = "a number, or nothing where it was not measured" if may_miss else "a number"
        for line, fields in self._rows:
            text = fields[column].strip()
            value = self._number(text)
            if not math.isfinite(value) and not (may_miss and math.isnan(value)):
                self._refuse(line, column, expected, text)
            if abs(value) > LARGEST:
                self._refuse(
                    line, column, f"a number between {-LARGEST:.0e} and {LARGEST:.0e}", text
                )
            values.append(value)
        return torch.tensor(values, dtype=torch.float64)

    def _number(self, text: str) -> float:
        """A number; NaN for nothing, infinity for what is none."""
        if "_" in text or (self.decimal != "." and "." in text):
            return math.inf  # Python would take 1_000, and 1.000 is a thousand there
        try:
            return float(text.replace(self.decimal, ".")) if text else math.nan
        except ValueError:
            return math.inf

    def _column(self, name: str) -> int:
        places = [i for i, other in enumerate(self.names) if other == name]
        if len(places) == 1:
            return places[0]
        where = f"{self.file}, line {self._header}"
        if places:
            columns = " and ".join(str(place + 1) for place in places)
            raise ValueError(
                f"{where}: expected one column {name!r}, found columns {columns}; "
                "rename those that are not meant."
            )
        found = ", ".join(map(repr, self.names))
        # Units in brackets and capitals are no part of a likeness.
        plain = {other.partition("[")[0].strip().casefold(): other for other in self.names}
        near = get_close_matches(name.partition("[")[0].strip().casefold(), plain, n=1)
        meant = f" Is it {plain[near[0]]!r}?" if near else ""
        hint = self._other_delimiter() or f" {self._hint}"
        raise ValueError(f"{where}: expected a column {name!r}, found {found}.{meant}{hint}")

    def _other_delimiter(self) -> str:
        """Return a hint if a single column has the names of several."""
        marks = [mark for mark in _OTHERS if mark in self.names[0]] if len(self.names) == 1 else []
        if not marks or not self._is_text:
            return ""
        return (
            f" There seem to be {_OTHERS[marks[0]]} between its fields: say so by "
            f"{self._option.format('delimiter', marks[0])}."
        )

    def _miscounted(self, line: int, fields: list[str], delimiter: str) -> str:
        """Why a row may have more fields than there are names."""
        if len(self.names) == 1 and line == self.lines[0]:
            return (
                f" Line {self._header} has one name and line {line} has {len(fields)} fields: is "
                f"line {self._header} a comment? Then take it away."
            )
        if len(fields) == len(self.names) + 1 and not fields[-1].strip():
            return (
                f" Its last field is empty: is there a {delimiter!r} too many at its end? Take it "
                f"away, or put one at the end of line {self._header} too."
            )
        return ""

    def _refuse(self, line: int, column: int, expected: str, text: str) -> NoReturn:
        raise ValueError(
            f"{self.file}, line {line}, column {column + 1} ({self.names[column]!r}): expected "
            f"{expected}, found {text!r}; correct the field, or leave the line out."
            f"{self._other_decimal(text)}"
        )

    def _other_decimal(self, text: str) -> str:
        """Return a hint if a field would be a number with the other decimal mark."""
        other = "," if self.decimal == "." else "."
        try:
            float(text.replace(other, "."))
        except ValueError:
            return ""
        if other not in text:
            return ""
        if not self._is_text:
            return " It is a text there, not a number."
        name = {",": "comma", ".": "point"}[other]
        option = self._option.format("decimal", other)
        return f" If this {name} is a decimal {name}, say so by {option}."


def _rows_of_text(file: str | Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """The rows of a CSV file, and the line at which each begins."""
    try:
        with open(file, encoding="utf-8-sig", newline="") as text:
            reader = csv.reader(text, delimiter=delimiter)
            before = 0
            for fields in reader:
                yield before + 1, fields
                before = reader.line_num
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"{file}: expected a CSV file in UTF-8, but {error}; save it as such, in a spreadsheet "
            "as 'CSV UTF-8'."
        ) from error


def _rows_of_sheet(file: str | Path, sheet: str | None) -> Iterator[tuple[int, list[str]]]:
    """The rows of a workbook's sheet as texts, and their numbers."""
    try:
        from openpyxl import load_workbook
    except ImportError as error:
        raise ImportError(
            f'{file} is a workbook, which needs openpyxl; run `pip install "gpadjust[excel]"`, or '
            "save it as CSV."
        ) from error
    with open(file, "rb") as content:
        try:
            book, formulas = (
                load_workbook(content, read_only=True, data_only=only) for only in (True, False)
            )
        except Exception as error:  # of zip, XML and more
            raise ValueError(f"{file}: expected a workbook, *.xlsx, but {error}.") from error
        names = [each.title for each in book.worksheets]
        if sheet not in names and (sheet is not None or len(names) != 1):
            found = ", ".join(map(repr, names))
            asked = "one sheet" if sheet is None else f"a sheet {sheet!r}"
            raise ValueError(f"{file}: expected {asked}, found {found}; say which, by `sheet`.")
        width, name = None, sheet or names[0]
        both = (each[name].iter_rows() for each in (book, formulas))
        for line, (cells, codes) in enumerate(zip(*both, strict=True), start=1):
            # Of a formula whose value is an empty text the cell is one of texts.
            if any(
                cell.value is None and cell.data_type == "n" and code.value is not None
                for cell, code in zip(cells, codes, strict=True)
            ):
                raise ValueError(
                    f"{file}, line {line}: a formula has no value in the file; open the workbook "
                    "in a spreadsheet, which computes it, and save it."
                )
            fields = [_text(cell.value) for cell in cells]
            while fields and not fields[-1]:
                fields.pop()
            width = len(fields) if width is None and fields else width
            yield line, fields + [""] * ((width or 0) - len(fields))


def _text(cell: Any) -> str:
    """A cell as a CSV file has it."""
    return "" if cell is None else repr(cell) if isinstance(cell, float) else str(cell).strip()
