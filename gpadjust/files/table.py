"""Columns of a CSV file or a spreadsheet, read as they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from gpadjust.files import fields as read
from gpadjust.files.rows import is_value, numeric_columns, rows_of_sheet, rows_of_text
from gpadjust.physics.formula import symbol

LARGEST = 1e100
"""The largest number that is read; squares of more are no numbers."""
_OF_RECORDS = (
    "Say which column it is, such as `states={'theta': 'q'}`; None, if a state was not measured."
)


class Table:
    r"""The columns of a table by their names.

    Delimiter, decimal mark and encoding are found, unless given. Names are in the line before the
    first numbers, with units in brackets, ``[m]`` or ``(m)``, or in a line of their own; what is
    before is not read. Where the names are one fewer than the fields of all lines, the first column
    has the names of rows, as R writes them. Lines and columns are counted from 1, as editors do.
    Lines of nothing but empty fields are left out.

    Args:
        file: The file: a CSV file, or a workbook, ``*.xlsx`` (the extra ``excel``).
        delimiter: The mark between two fields of a CSV file. Default: the one that fits.
        decimal: The decimal mark of its numbers, a point or a comma. Default: the one that fits.
        names: The names of all columns, of a file without, or in place of its own.
        sheet: The sheet of a workbook that has more than one.
        hint: The way out where a column is not there.
        is_command: Whether errors name options as on a command line.

    Attributes:
        names: The names of all columns, without units.
        units: Their units, empty where there is none.
        lines: The line of each row, at which an editor shows its beginning.
        remarks: Sentences on lines that are not read, and on a column that has no name.

    Raises:
        OSError: If the file cannot be read.
        ImportError: If it is a workbook, and openpyxl is not installed.
        ValueError: If it is no table, has no names, no rows or several sheets, or a row has not one
            field for each name.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     file = Path(folder, "pump.csv")
        ...     _ = file.write_text("speed (rpm);head [m]\n1000;2,5\n2000;\n")
        ...     table = Table(file)
        >>> table.names, table.units
        (('speed', 'head'), ('rpm', 'm'))
        >>> table.numbers("head", may_miss=True)
        tensor([2.5000,    nan], dtype=torch.float64)
    """

    def __init__(
        self,
        file: str | Path,
        *,
        delimiter: str | None = None,
        decimal: str | None = None,
        names: Sequence[str] | None = None,
        sheet: str | None = None,
        hint: str = _OF_RECORDS,
        is_command: bool = False,
    ) -> None:
        self.file, self._hint, self._is_command = str(file), hint, is_command
        self._is_text = Path(file).suffix.lower() != ".xlsx"
        mark = ""
        if not self._is_text:
            rows = rows_of_sheet(file, sheet)
        elif sheet is not None:
            raise ValueError(f"{file}: expected a workbook, *.xlsx, to have a sheet {sheet!r}.")
        else:
            rows, mark = rows_of_text(file, delimiter)
        rows = [row for row in rows if any(row[1])]
        fields = [row for _, row in rows]
        header, units, first = _heads(fields, names is not None)
        if first >= len(rows):
            what = "only a line of names" if rows else "an empty file"
            raise ValueError(f"{file}: expected a line of names and then rows, found {what}.")
        if header is None and names is None:
            shown = ", ".join(map(repr, fields[0][:5]))
            raise ValueError(
                f"{file}, line {rows[0][0]}: expected a line of names before the numbers, found "
                f"{shown}; give names of all columns by {self._option('names', ['a', 'b'])}."
            )
        self._header, self._rows = rows[header or 0][0], rows[first:]
        self.remarks: list[str] = []
        if header:
            self.remarks.append(f"{file}: the names are in line {self._header}; not read before.")
        self.headers = self._one_for_each_field([] if header is None else fields[header], names)
        self.names, self.units = _names_and_units(self.headers, fields[units] if units else [])
        self.lines = tuple(line for line, _ in self._rows)
        commas = [text for _, row in self._rows for text in row if "," in text]
        self.decimal, self._has_groups = read.decimal_of(commas, mark)
        if decimal is not None:
            self.decimal, self._has_groups = decimal, True
        if not self._is_text:
            self.decimal, self._has_groups = ".", False  # its numbers have none

    def __len__(self) -> int:
        return len(self._rows)

    def bare(self, name: str) -> str:
        """Return the name of a column without its unit."""
        return self.names[self._column(name)]

    def unit(self, name: str) -> str:
        """Return the unit of a column, empty if there is none."""
        return self.units[self._column(name)]

    def label(self, name: str) -> str:
        """Return the name of a column with its unit, as ``head [m]``."""
        return self._labels[self._column(name)]

    def texts(self, name: str) -> list[str]:
        """Return the fields of a column.

        Raises:
            ValueError: If there is no such column, or several, or a field is empty.
        """
        column, texts = self._column(name), []
        for line, fields in self._rows:
            texts.append(fields[column])
            if not texts[-1]:
                self._refuse(line, column, "a text", "")
        return texts

    def categories(self, name: str) -> tuple[Tensor, tuple[float, ...] | tuple[str, ...]]:
        """Return the categories of a column: numbers, ``N``, and the levels, sorted.

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
        """Return the numbers of a column, ``N``, in float64.

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
            text = fields[column]
            value = self._number(text)
            if not math.isfinite(value) and not (may_miss and math.isnan(value)):
                self._refuse(line, column, expected, text)
            if abs(value) > LARGEST:
                self._refuse(
                    line, column, f"a number between {-LARGEST:.0e} and {LARGEST:.0e}", text
                )
            values.append(value)
        return torch.tensor(values, dtype=torch.float64)

    def has_dates(self, name: str) -> bool:
        """Return whether the first field of a column is a date or a time of day."""
        return read.is_moment(self._rows[0][1][self._column(name)])

    def times(self, name: str, unit: str | None = None) -> Tensor:
        """Return the times of a column, ``N``, in a unit of time, by default in seconds.

        Dates and times of day become the time since the first. Numbers are in the unit of the
        column's name, in brackets or as in ``time_ms``, and without one in ``unit``.

        Raises:
            ValueError: If there is no such column, a field is no number, or is a date beside
                numbers or one that may be read in two ways; if the column is in minutes, hours,
                days or no unit of time, unless the unit of the result is given.
        """
        column = self._column(name)
        where = f"{self.file}, column {column + 1} ({self.headers[column]!r})"
        size = read.seconds_in(unit or "s")
        if size is None:
            raise ValueError(f"Expected a unit of time, s, ms, us, min, h or d, found {unit!r}.")
        if self.has_dates(name):
            try:
                seconds = read.seconds_of(self.texts(name))
            except ValueError as error:
                raise ValueError(f"{where}: {error}.") from error
            return torch.tensor(seconds, dtype=torch.float64) / size
        own = self.units[column] or read.time_unit_of(self.names[column])
        own_size = read.seconds_in(own or unit or "s")
        if unit is None and (own_size is None or own_size > 1):
            in_s = self._option("time_unit", "s")
            way = f"if the column is in seconds, {in_s}."
            if own_size is not None:
                per_own = self._option("time_unit", own)
                way = f"if rates are per {own}, {per_own}; if per s, {in_s}, which converts it."
            raise ValueError(f"{where}: expected a time in seconds, found {own!r}; {way}")
        return self.numbers(name) * ((own_size or size) / size)

    def _number(self, text: str) -> float:
        """Return a number; NaN for nothing, infinity for what is none."""
        return read.number(text, self.decimal, grouped=self._has_groups)

    @property
    def _labels(self) -> list[str]:
        pairs = zip(self.names, self.units, strict=True)
        return [f"{name} [{unit}]" if unit else name for name, unit in pairs]

    def _column(self, name: str) -> int:
        """Return the place of a column: by its name as it is, without its unit, or as a symbol."""
        symbols = [*map(symbol, self.names)]
        places: list[int] = []
        for known in (self.headers, self._labels, self.names, symbols):
            places = [i for i, other in enumerate(known) if other == name]
            if len(places) == 1:
                return places[0]
            if places:
                break
        where = f"{self.file}, line {self._header}"
        if places:
            columns = " and ".join(str(place + 1) for place in places)
            raise ValueError(
                f"{where}: expected one column {name!r}, found columns {columns}; "
                "rename those that are not meant."
            )
        found = ", ".join(map(repr, self.headers))
        # Units and capitals are no part of a likeness.
        plain = dict(zip(map(str.casefold, self.names), self.headers, strict=True))
        near = get_close_matches(read.split_unit(name)[0].casefold(), plain, n=1)
        meant = f" Is it {plain[near[0]]!r}?" if near else ""
        raise ValueError(f"{where}: expected a column {name!r}, found {found}.{meant} {self._hint}")

    def _one_for_each_field(
        self, header: Sequence[str], names: Sequence[str] | None
    ) -> tuple[str, ...]:
        """Return names of all columns; empty fields at the end of rows are left out."""
        width = max(len(fields) for _, fields in self._rows)
        while width > 1 and not any(field for _, row in self._rows for field in row[width - 1 :]):
            width -= 1
        found = [name.lstrip("#%").strip() for name in header] if names is None else [*names]
        while len(found) > width and not found[-1]:
            found.pop()
        if names is None and len(found) == width - 1 and self._begins_with_names(width):
            found.insert(0, "")
            self.remarks.append(f"{self.file}: the first column has no name, and those of rows.")
        width = len(found)
        for i, (line, fields) in enumerate(self._rows):
            kept = fields[:width] if not any(fields[width:]) else fields
            if len(kept) != width:
                fields_s = "field" + "s" * (width != 1)
                raise ValueError(
                    f"{self.file}, line {line}: expected {width} {fields_s}, one for each name, "
                    f"found {len(kept)}; correct the line, or leave it out."
                    f"{self._miscounted(found, kept)}"
                )
            self._rows[i] = line, kept
        return tuple(found)

    def _begins_with_names(self, width: int) -> bool:
        """Return whether the first fields of all rows are 1, 2, 3 ..., or no numbers."""
        texts = [fields[0] for _, fields in self._rows if len(fields) == width]
        are_numbered = texts == [str(i + 1) for i in range(len(texts))]
        return len(texts) == len(self) and (are_numbered or not any(map(is_value, texts)))

    def _miscounted(self, names: Sequence[str], fields: Sequence[str]) -> str:
        """Return a hint why a row has other fields than there are names."""
        if len(fields) == 2 * len(names) and all(map(read.is_number, fields)):
            return " Are its commas decimal commas, too? Save it with semicolons in between."
        if len(fields) == len(names) + 1:
            return " Has one of its columns no name? Give names of all: " + self._option(
                "names", [*names, "other"]
            )
        return ""

    def _option(self, name: str, value: str | list[str]) -> str:
        """Return an option as its user writes it."""
        if not self._is_command:
            return f"`{name}={value!r}`"
        text = value if isinstance(value, str) else ",".join(value)
        return f"--{name.replace('_', '-')} {text!r}"

    def _refuse(self, line: int, column: int, expected: str, text: str) -> NoReturn:
        raise ValueError(
            f"{self.file}, line {line}, column {column + 1} ({self.headers[column]!r}): expected "
            f"{expected}, found {text!r}; correct the field, or leave the line out."
            f"{self._cause(line, column, text)}"
        )

    def _cause(self, line: int, column: int, text: str) -> str:
        """Return a hint why a field may be no number."""
        value, _, unit = text.partition(" ")
        if read.is_moment(text):
            return " Dates are read as the time of a log, and as inputs."
        if value and unit and read.is_number(value):
            return f" Write its unit into the name, {self.names[column]} [{unit}]."
        if line == self.lines[0] and not any(map(is_value, self._rows[0][1])):
            return " If this line has units, put them in brackets."
        if not read.is_number(text):
            return ""
        if not self._is_text:
            return " It is a text there, not a number."
        other, name = (",", "comma") if self.decimal == "." else (".", "point")
        way = f" If this {name} is a decimal {name}, say so by {self._option('decimal', other)}"
        if math.isfinite(read.number(text, self.decimal, grouped=True)):
            way += f"; if it parts thousands, by {self._option('decimal', self.decimal)}"
        return f"{way}."


def _heads(
    rows: Sequence[Sequence[str]], names_are_given: bool
) -> tuple[int | None, int | None, int]:
    """Return the rows that have the names and the units, or None, and the first row of data.

    Names are words above columns of numbers, in the last row before the data. A row with numbers
    there is one of names only if none are given.
    """
    numeric, width = numeric_columns(rows), max(map(len, rows), default=0)
    heads = [] if numeric else [0]
    first = 0
    for i, row in enumerate(rows if numeric else ()):
        fields = [row[k] for k in numeric if k < len(row)]
        has_words, has_values = any(map(_is_word, fields)), any(map(is_value, fields))
        may_be_data = bool(heads) or names_are_given or not has_words
        if has_values and may_be_data and len(row) >= width - 1:
            first = i
            break
        if has_words and sum(map(bool, row)) >= min(width, max(2, width - 1)):
            heads.append(i)
    if not heads and first and any(map(_is_word, rows[first - 1])):
        heads = [first - 1]  # of another number of fields, which is refused
    if not heads:
        return None, None, first
    *before, last = heads
    if before and before[-1] == last - 1:
        marks = [rows[last][k] for k in numeric if k < len(rows[last]) and rows[last][k]]
        if all(map(read.is_unit, marks)):
            return last - 1, last, last + 1
    return last, None, last + 1


def _is_word(field: str) -> bool:
    return math.isinf(read.number(field)) and not is_value(field)


def _names_and_units(
    headers: Sequence[str], units: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names without units, and units; what is in brackets stays where names need it."""
    if units:
        return tuple(headers), tuple(unit.strip("[]() ") for unit in units[: len(headers)])
    pairs = [read.split_unit(header) for header in headers]
    short = [name for name, _ in pairs]
    for i, header in enumerate(headers):
        if short.count(short[i]) > 1:
            pairs[i] = header, ""
    return tuple(name for name, _ in pairs), tuple(unit for _, unit in pairs)
