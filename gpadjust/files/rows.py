"""Rows of a table as texts: of a CSV file in any dialect, or of a workbook."""

from __future__ import annotations

import codecs
import csv
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import timedelta
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any

from gpadjust.files.fields import is_missing, is_moment, is_number

Row = tuple[int, list[str]]
"""The line at which a row begins, counted from 1, and its fields."""

_SURE = (";", "\t", "|")  # delimiters that are part of neither a number nor a name
_MARKS = (*_SURE, ",", " ")
_SAMPLE = 200  # rows from which the delimiter is inferred
_CODES = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def rows_of_text(file: str | Path, delimiter: str | None) -> tuple[list[Row], str]:
    """Return the rows of a CSV file in UTF-8, UTF-16 or Windows-1252, and its delimiter."""
    content = Path(file).read_bytes()
    try:
        text = content.decode(_CODES.get(content[:2], "utf-8-sig"))
    except UnicodeDecodeError:  # the few bytes that Windows-1252 leaves open are replaced
        text = content.decode("cp1252", errors="replace")
    first, _, rest = text.partition("\n")
    is_for_excel = first.strip().lower().startswith("sep=") and len(first.strip()) == 5
    lines_above = 0
    if is_for_excel:
        delimiter = delimiter or first.strip()[4]
        lines_above = 1
        text = rest
    mark = delimiter or _delimiter(text)
    try:
        if "\0" in text:  # newer versions of Python read it as text
            raise csv.Error("line contains NUL")
        rows = [(lines_above + line, fields) for line, fields in _parsed(text, mark)]
    except csv.Error as error:
        raise ValueError(
            f"{file}: expected a CSV file in UTF-8, but {error}; save it as UTF-8, in a "
            "spreadsheet as 'CSV UTF-8'."
        ) from error
    return rows, mark


def numeric_columns(rows: Sequence[Sequence[str]]) -> set[int]:
    """Return the columns whose last fields are mostly numbers, dates or times."""
    body = rows[len(rows) // 2 :][-_SAMPLE:]  # below names, units and remarks
    balance: Counter[int] = Counter()
    for fields in body:
        for i, field in enumerate(fields):
            if is_missing(field):
                continue
            balance[i] += 1 if is_value(field) else -1
    return {i for i, count in balance.items() if count >= 0}


def is_value(text: str) -> bool:
    """Return whether a field is a number, a date or a time."""
    return is_number(text) or is_moment(text)


def _parsed(text: str, mark: str) -> Iterator[Row]:
    """Yield the rows of a text with the line at which each begins."""
    reader = csv.reader(StringIO(text, newline=""), delimiter=mark, skipinitialspace=True)
    last_line = 0
    for fields in reader:
        yield last_line + 1, [field.strip() for field in fields]
        last_line = reader.line_num  # a field in quotes may span several lines


def _delimiter(text: str) -> str:
    """Return the mark that gives the largest share of numbers, dates and times."""
    best_mark = ","
    best_score = 0.0
    for mark in _MARKS:
        rows: list[list[str]] = []
        with suppress(csv.Error):
            rows += [fields for _, fields in islice(_parsed(text, mark), _SAMPLE) if any(fields)]
        fields = [field for row in rows[len(rows) // 2 :] for field in row]
        fields = [field for field in fields if not is_missing(field)]
        if not fields:
            continue
        width, count = Counter(map(len, rows)).most_common(1)[0]
        if width < 2:
            continue
        # score = mean weight of a field times the share of rows with the most common width
        score = sum(map(_weight, fields)) / len(fields) * count / len(rows)
        if score > 1.001 * best_score:  # rounding must not decide between equal marks
            best_mark, best_score = mark, score
    return best_mark


def _weight(field: str) -> float:
    """Return 1 of a value; of a word a half, and 0 if a sure delimiter would split it."""
    if is_value(field):
        return 1.0
    if {*field} & {*_SURE}:
        return 0.0
    return 0.5


def rows_of_sheet(
    file: str | Path, sheet: str | None, option: Callable[[str, str], str]
) -> list[Row]:
    """Return the rows of a sheet of a workbook as texts, all of one width.

    ``option`` writes the option ``sheet`` in errors; sheets without a value need no choice.
    """
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
        names = [worksheet.title for worksheet in book.worksheets]
        if sheet is None and len(names) > 1:  # spreadsheets of old made three sheets
            filled = filter(_has_values, formulas.worksheets)
            names = [worksheet.title for worksheet in filled] or names[:1]
        if sheet not in names and (sheet is not None or len(names) != 1):
            titles = ", ".join(map(repr, names))
            expected = "one sheet" if sheet is None else f"a sheet {sheet!r}"
            way = option("sheet", names[0])
            raise ValueError(f"{file}: expected {expected}, found {titles}; choose one: {way}.")
        rows: list[Row] = []
        values = book[sheet or names[0]].iter_rows()
        sources = formulas[sheet or names[0]].iter_rows()
        for line, (cells, codes) in enumerate(zip(values, sources, strict=True), start=1):
            # The value of a formula that was never computed is empty and of the type of numbers.
            # Of a formula with an empty text as its value the type is text.
            if any(
                cell.value is None and cell.data_type == "n" and code.value is not None
                for cell, code in zip(cells, codes, strict=True)
            ):
                raise ValueError(
                    f"{file}, line {line}: expected a value, found a formula without one; open "
                    "the workbook in a spreadsheet, which computes the value, and save it."
                )
            rows.append((line, [_text(cell.value) for cell in cells]))
    # The rows of a sheet are as long as their last cell.
    width = max((len(fields) for _, fields in rows), default=0)
    return [(line, fields + [""] * (width - len(fields))) for line, fields in rows]


def _has_values(worksheet: Any) -> bool:
    """Return whether a sheet has a cell that is not empty."""
    return any(value is not None for row in worksheet.iter_rows(values_only=True) for value in row)


def _text(cell: Any) -> str:
    """Return a cell as the text of a CSV file."""
    if cell is None:
        return ""
    if isinstance(cell, timedelta):
        return str(cell.total_seconds())
    return repr(cell) if isinstance(cell, float) else str(cell).strip()
