"""Rows of a table as texts: of a CSV file in any dialect, or of a workbook."""

from __future__ import annotations

import codecs
import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import timedelta
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any

from gpadjust.files.fields import is_missing, is_moment, is_number

Row = tuple[int, list[str]]
"""The line at which a row begins, counted from 1, and its fields."""

_SURE = (";", "\t", "|")  # which part fields where a decimal comma or a name with blanks may be
_MARKS = (*_SURE, ",", " ")
_SAMPLE = 200  # rows that tell the delimiter
_CODES = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def rows_of_text(file: str | Path, delimiter: str | None) -> tuple[list[Row], str]:
    """Return the rows of a CSV file, without comments before its names, and its delimiter.

    The text is in UTF-8, in UTF-16 with its mark, or, as spreadsheets write it, in Windows-1252.
    """
    content = Path(file).read_bytes()
    try:
        text = content.decode(_CODES.get(content[:2], "utf-8-sig"))
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    first, _, rest = text.partition("\n")
    skipped = 0
    if first.strip().lower().startswith("sep=") and len(first.strip()) == 5:  # Excel's own line
        delimiter, text, skipped = delimiter or first.strip()[4], rest, 1
    mark = delimiter or _delimiter(text)
    try:
        if "\0" in text:
            raise csv.Error("line contains NUL")
        rows = [(line + skipped, fields) for line, fields in _parsed(text, mark)]
    except csv.Error as error:
        raise ValueError(
            f"{file}: expected a CSV file in UTF-8, but {error}; save it as such, in a spreadsheet "
            "as 'CSV UTF-8'."
        ) from error
    return rows, mark


def numeric_columns(rows: Sequence[Sequence[str]]) -> set[int]:
    """Return the columns whose last fields are mostly numbers or moments."""
    body = rows[len(rows) // 2 :][-_SAMPLE:]
    counts: Counter[int] = Counter()
    for fields in body:
        known = [i for i, field in enumerate(fields) if not is_missing(field)]
        counts.update({i: 1 if is_value(fields[i]) else -1 for i in known})
    return {i for i, count in counts.items() if count >= 0}


def is_value(text: str) -> bool:
    """Return whether a field is a number, a date or a time."""
    return is_number(text) or is_moment(text)


def _parsed(text: str, mark: str) -> Iterator[Row]:
    """Return the rows of a text that are not empty, with their lines."""
    lines = StringIO(text, newline="")
    reader, before = csv.reader(lines, delimiter=mark, skipinitialspace=True), 0
    for fields in reader:
        yield before + 1, [field.strip() for field in fields]
        before = reader.line_num


def _delimiter(text: str) -> str:
    """Return the mark by which most fields are numbers or moments, in rows of one width."""
    best, most = ",", 0.0
    for mark in _MARKS:
        rows: list[list[str]] = []
        with suppress(csv.Error):
            rows += [fields for _, fields in islice(_parsed(text, mark), _SAMPLE) if any(fields)]
        widths = Counter(map(len, rows))
        width, count = widths.most_common(1)[0] if rows else (1, 0)
        fields = [field for row in rows[len(rows) // 2 :] for field in row]
        fields = [field for field in fields if not is_missing(field)]
        if width < 2 or not fields:
            continue
        # Words count by half, and not where they seem to be several fields.
        likely = [1.0 if is_value(f) else 0.5 * (not {*f} & {*_SURE}) for f in fields]
        share = sum(likely) / len(fields) * count / len(rows)
        if share > 1.001 * most:
            best, most = mark, share
    return best


def rows_of_sheet(file: str | Path, sheet: str | None) -> list[Row]:
    """Return the rows of a workbook's sheet as texts, all of one width."""
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
        rows: list[Row] = []
        both = (each[sheet or names[0]].iter_rows() for each in (book, formulas))
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
            rows.append((line, [_text(cell.value) for cell in cells]))
    width = max((len(fields) for _, fields in rows), default=0)
    return [(line, fields + [""] * (width - len(fields))) for line, fields in rows]


def _text(cell: Any) -> str:
    """Return a cell as a CSV file has it."""
    if isinstance(cell, timedelta):
        return str(cell.total_seconds())
    return "" if cell is None else repr(cell) if isinstance(cell, float) else str(cell).strip()
