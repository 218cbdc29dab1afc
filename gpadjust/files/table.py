"""Columns of a CSV file or a spreadsheet."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from gpadjust.files import fields as read
from gpadjust.files.rows import is_value, numeric_columns, rows_of_sheet, rows_of_text
from gpadjust.physics.formula import symbol
from gpadjust.words import plural

LARGEST = 1e100
"""The largest number that is accepted; squares of larger ones may overflow."""
_RECORDS_HINT = "Name its column, as in `states={'theta': 'q'}`; None, if a state was not measured."


class Table:
    r"""The columns of a table by their names.

    Delimiter, decimal mark and encoding are inferred. Names are in the line before the first
    numbers, units in brackets after the names, ``[m]`` or ``(m)``, or in a line below them. Earlier
    lines are skipped, as are lines without a value. If each row has one field more than there are
    names, the first column has the names of the rows, as R writes them. Lines and columns are
    counted from 1. Methods raise a ValueError if there is no such column, or several.

    Args:
        file: A CSV file, or a workbook, ``*.xlsx`` (the extra ``excel``).
        delimiter: The mark between two fields of a CSV file. Default: inferred.
        decimal: The decimal mark of its numbers, a point or a comma. Default: inferred.
        names: The names of all columns, which replace the names in the file.
        sheet: The sheet of a workbook in which more than one has cells.
        hint: The advice of the error on a missing column.
        is_command: If True, errors name options as on a command line.

    Attributes:
        names: The names of all columns, without units.
        units: The units of all columns, or "".
        lines: The line in the file at which each row begins.
        remarks: Sentences on skipped lines, a column without a name, and points of thousands.

    Raises:
        OSError: If the file cannot be read.
        ImportError: If it is a workbook, and openpyxl is not installed.
        ValueError: If it is not a table, has no names, no rows or several sheets, or a row does not
            have one field for each name.

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
        hint: str = _RECORDS_HINT,
        is_command: bool = False,
    ) -> None:
        self.file = str(file)
        self._hint, self._is_command = hint, is_command
        self._is_text = Path(file).suffix.lower() != ".xlsx"
        mark = ""
        if not self._is_text:
            rows = rows_of_sheet(file, sheet, self._option)
        elif sheet is not None:
            raise ValueError(f"{file}: expected a workbook, *.xlsx, to have a sheet {sheet!r}.")
        else:
            rows, mark = rows_of_text(file, delimiter)
        rows = [row for row in rows if any(row[1])]
        fields = [row for _, row in rows]
        header, units, first = _heads(fields, names is not None)
        if first >= len(rows):
            content = "only a line of names"
            if not rows:
                content = "an empty file"
            raise ValueError(f"{file}: expected a line of names and then rows, found {content}.")
        if header is None and names is None:
            shown = ", ".join(map(repr, fields[0][:5]))
            raise ValueError(
                f"{file}, line {rows[0][0]}: expected a line of names before the numbers, found "
                f"{shown}; give names of all columns by {self._option('names', ['a', 'b'])}."
            )
        self._header = rows[header or 0][0]
        self._rows = rows[first:]
        self.remarks: list[str] = []
        if header:
            remark = f"{file}: the names are in line {self._header}; earlier lines are not read."
            self.remarks.append(remark)
        header_fields = [] if header is None else fields[header]
        self.headers = self._header_of_each_field(header_fields, names)
        self.names, self.units = _names_and_units(self.headers, fields[units] if units else [])
        self.lines = tuple(line for line, _ in self._rows)
        if not self._is_text:
            self.decimal, self._has_groups = ".", False  # cells of a workbook are Python's numbers
        elif decimal is not None:
            self.decimal, self._has_groups = decimal, True
        else:
            marked = [text for _, row in self._rows for text in row if {*text} & {*".,"}]
            self.decimal, self._has_groups = read.decimal_of(marked, mark)
            pointed = [text for text in marked if "," not in text and read.is_number(text)]
            if pointed and (self.decimal, self._has_groups) == (",", True):
                self.remarks.append(f"{file}: points separate thousands, as in {pointed[0]!r}.")

    def __len__(self) -> int:
        return len(self._rows)

    def bare(self, name: str) -> str:
        """Return the name of a column without its unit."""
        return self.names[self._column(name)]

    def unit(self, name: str) -> str:
        """Return the unit of a column, or ""."""
        return self.units[self._column(name)]

    def label(self, name: str) -> str:
        """Return the name of a column with its unit, such as ``head [m]``."""
        return self._labels[self._column(name)]

    def texts(self, name: str) -> list[str]:
        """Return the fields of a column; raise a ValueError if one is empty."""
        column = self._column(name)
        for line, fields in self._rows:
            if not fields[column]:
                self._refuse(line, column, "a text", "")
        return [fields[column] for _, fields in self._rows]

    def categories(self, name: str) -> tuple[Tensor, tuple[float, ...] | tuple[str, ...]]:
        """Return the categories of a column: numbers, ``N``, and the sorted levels.

        If a field is not a number, the levels are texts, numbered from 0. None may be empty.
        """
        texts = self.texts(name)
        values = [self._number(text) for text in texts]
        if all(map(math.isfinite, values)):  # numbers are their own levels
            return torch.tensor(values, dtype=torch.float64), tuple(sorted({*values}))
        levels = tuple(sorted({*texts}))
        return torch.tensor([levels.index(t) for t in texts], dtype=torch.float64), levels

    def numbers(self, name: str, *, may_miss: bool = False) -> Tensor:
        """Return the numbers of a column, ``N``, in float64.

        If it ``may_miss``, a field that is empty or has a word for a missing value is NaN.

        Raises:
            ValueError: If a field is not a finite number, or one beyond 1e100.
        """
        column = self._column(name)
        expected = "a number"
        if may_miss:
            expected += ", or nothing if it was not measured"
        values = []
        for line, fields in self._rows:
            value = self._number(fields[column])
            if not math.isfinite(value) and not (may_miss and math.isnan(value)):
                self._refuse(line, column, expected, fields[column])
            if abs(value) > LARGEST:
                limits = f"a number between {-LARGEST:.0e} and {LARGEST:.0e}"
                self._refuse(line, column, limits, fields[column])
            values.append(value)
        return torch.tensor(values, dtype=torch.float64)

    def has_dates(self, name: str) -> bool:
        """Return whether the first field of a column is a date or a time of day."""
        return read.is_moment(self._rows[0][1][self._column(name)])

    def times(self, name: str, unit: str | None = None) -> Tensor:
        """Return the times of a column, ``N``, in a unit of time, by default in seconds.

        Dates and times of day become the time since the first. Numbers are in the unit of the
        column, in brackets or as in ``time_ms``, or in ``unit`` if the column has no unit.

        Raises:
            ValueError: If a field is not a number, dates are ambiguous or mixed with numbers, or
                the column is in minutes, hours, days or not in a unit of time, unless ``unit`` is
                given.
        """
        column = self._column(name)
        where = f"{self.file}, column {column + 1} ({self.headers[column]!r})"
        seconds_in_unit = read.seconds_in(unit or "s")
        if seconds_in_unit is None:
            raise ValueError(f"Expected a unit of time, s, ms, us, min, h or d, found {unit!r}.")
        if self.has_dates(name):
            try:
                seconds = read.seconds_of(self.texts(name))
            except ValueError as error:
                raise ValueError(f"{where}: {error}.") from error
            return torch.tensor(seconds, dtype=torch.float64) / seconds_in_unit
        column_unit = self.units[column] or read.time_unit_of(self.names[column])
        seconds_in_column = read.seconds_in(column_unit or unit or "s")
        # A step of minutes or more may have rates per minute, too: the user decides.
        if unit is None and (seconds_in_column is None or seconds_in_column > 1):
            in_s = self._option("time_unit", "s")
            advice = f"if the column is in seconds, {in_s}."
            if seconds_in_column is not None:
                option = self._option("time_unit", column_unit)
                advice = f"if rates are per {column_unit}, {option}; if per s, {in_s}, "
                advice += "which converts it."
            raise ValueError(
                f"{where}: expected a time in seconds, found {column_unit!r}; {advice}"
            )
        return self.numbers(name) * ((seconds_in_column or seconds_in_unit) / seconds_in_unit)

    def _number(self, text: str) -> float:
        """Return the number in a field by the conventions of the table."""
        return read.number(text, self.decimal, grouped=self._has_groups)

    @property
    def _labels(self) -> list[str]:
        pairs = zip(self.names, self.units, strict=True)
        return [f"{name} [{unit}]" if unit else name for name, unit in pairs]

    def _column(self, name: str) -> int:
        """Return the place of a column: by its header, its name without the unit, or its symbol."""
        symbols = [*map(symbol, self.names)]
        places: list[int] = []
        # The first spelling that occurs decides, so that headers come before shorter forms.
        for spellings in (self.headers, self._labels, self.names, symbols):
            places = [i for i, spelling in enumerate(spellings) if spelling == name]
            if places:
                break
        if len(places) == 1:
            return places[0]
        where = f"{self.file}, line {self._header}"
        if places:
            columns = " and ".join(str(place + 1) for place in places)
            raise ValueError(
                f"{where}: expected one column {name!r}, found columns {columns}; rename all but "
                "one."
            )
        headers = ", ".join(map(repr, self.headers))
        # Names are compared without units and capitals.
        plain = dict(zip(map(str.casefold, self.names), self.headers, strict=True))
        similar = get_close_matches(read.split_unit(name)[0].casefold(), plain, n=1)
        question = "".join(f" Is it {plain[match]!r}?" for match in similar)
        raise ValueError(
            f"{where}: expected a column {name!r}, found {headers}.{question} {self._hint}"
        )

    def _header_of_each_field(
        self, header: Sequence[str], names: Sequence[str] | None
    ) -> tuple[str, ...]:
        """Return names of all columns; drop empty fields at the end of rows."""
        width = max(len(fields) for _, fields in self._rows)
        while width > 1 and not any(field for _, row in self._rows for field in row[width - 1 :]):
            width -= 1
        headers = [name.lstrip("#%").strip() for name in header]  # a comment may have the names
        if names is not None:
            headers = [*names]
        while len(headers) > width and not headers[-1]:
            headers.pop()
        if names is None and len(headers) == width - 1 and self._begins_with_names(width):
            headers.insert(0, "")
            self.remarks.append(f"{self.file}: the first column has no name; it names the rows.")
        width = len(headers)
        for i, (line, fields) in enumerate(self._rows):
            row = fields
            if not any(fields[width:]):  # a delimiter at the end of a line
                row = fields[:width]
            if len(row) != width:
                raise ValueError(
                    f"{self.file}, line {line}: expected {plural(width, 'field')}, one for each "
                    f"name, found {len(row)}; correct the line, or leave it out."
                    f"{self._miscounted(headers, row)}"
                )
            self._rows[i] = line, row
        return tuple(headers)

    def _begins_with_names(self, width: int) -> bool:
        """Return whether the first fields of all rows are 1, 2, 3 ..., or all texts."""
        texts = [fields[0] for _, fields in self._rows if len(fields) == width]
        are_numbered = texts == [str(i + 1) for i in range(len(texts))]
        return len(texts) == len(self) and (are_numbered or not any(map(is_value, texts)))

    def _miscounted(self, names: Sequence[str], fields: Sequence[str]) -> str:
        """Return a hint why the numbers of fields and names differ, or ""."""
        if len(fields) == 2 * len(names) and all(map(read.is_number, fields)):
            return " Are its commas decimal commas, too? Save it with semicolons between fields."
        if len(fields) == len(names) + 1:
            option = self._option("names", [*names, "other"])
            return f" Does a column have no name? Name all columns: {option}"
        return ""

    def _option(self, name: str, value: str | list[str]) -> str:
        """Return an option in the syntax of Python or of the command line."""
        if not self._is_command:
            return f"`{name}={value!r}`"
        text = value if isinstance(value, str) else ",".join(value)
        return f"--{name.replace('_', '-')} {text!r}"

    def _refuse(self, line: int, column: int, expected: str, text: str) -> NoReturn:
        """Raise the error of a field."""
        raise ValueError(
            f"{self.file}, line {line}, column {column + 1} ({self.headers[column]!r}): expected "
            f"{expected}, found {text!r}; correct the field, or leave the line out."
            f"{self._cause(line, column, text)}"
        )

    def _cause(self, line: int, column: int, text: str) -> str:
        """Return a hint why a field may not be a number, or ""."""
        value, _, unit = text.partition(" ")
        if read.is_moment(text):
            return " A date may be the time of a log, or an input."
        if value and unit and read.is_number(value):
            return f" Write its unit into the name, {self.names[column]} [{unit}]."
        if line == self.lines[0] and not any(map(is_value, self._rows[0][1])):
            return " If this line has units, put them in brackets."
        if not read.is_number(text):
            return ""
        if not self._is_text:
            return " The cell is a text, not a number."
        # The other mark is in the way: a decimal mark, or a separator of thousands.
        other, name = {".": (",", "comma"), ",": (".", "point")}[self.decimal]
        hint = f" If this {name} is a decimal {name}, use {self._option('decimal', other)}"
        if math.isfinite(read.number(text, self.decimal, grouped=True)):
            hint += f"; if it separates thousands, {self._option('decimal', self.decimal)}"
        return f"{hint}."


def _heads(rows: Sequence[Sequence[str]], has_names: bool) -> tuple[int | None, int | None, int]:
    """Return the row of names and the row of units, or None, and the first row of data.

    Names are words above columns of numbers, in the last row before the data. A row of words and
    numbers has the names only if the user gave none.
    """
    numeric = numeric_columns(rows)
    width = max(map(len, rows), default=0)
    if not numeric:  # a table of texts: its first row has the names
        return 0, None, 1
    heads: list[int] = []
    first = 0
    for i, row in enumerate(rows):
        fields = [row[k] for k in numeric if k < len(row)]
        has_words = any(map(_is_word, fields))
        may_be_data = bool(heads) or has_names or not has_words
        if may_be_data and any(map(is_value, fields)) and len(row) >= width - 1:
            first = i
            break
        # A row of names may lack one name, but is not a remark of one field.
        if has_words and sum(map(bool, row)) >= min(width, max(2, width - 1)):
            heads.append(i)
    if not heads and first and any(map(_is_word, rows[first - 1])):
        heads = [first - 1]  # of another number of fields, which is an error
    if not heads:
        return None, None, first
    last = heads[-1]
    if heads[-2:] == [last - 1, last]:  # two rows of words: the second may have the units
        marks = [rows[last][k] for k in numeric if k < len(rows[last]) and rows[last][k]]
        if all(map(read.is_unit, marks)):
            return last - 1, last, last + 1
    return last, None, last + 1


def _is_word(field: str) -> bool:
    return math.isinf(read.number(field)) and not is_value(field)


def _names_and_units(
    headers: Sequence[str], units: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names without units, and units; keep brackets that distinguish two names."""
    if units:
        return tuple(headers), tuple(unit.strip("[]() ") for unit in units[: len(headers)])
    pairs = [read.split_unit(header) for header in headers]
    counts = Counter(name for name, _ in pairs)
    for i, (name, _) in enumerate(pairs):
        if counts[name] > 1:  # x [m] and x [s] are two names
            pairs[i] = headers[i], ""
    return tuple(name for name, _ in pairs), tuple(unit for _, unit in pairs)
