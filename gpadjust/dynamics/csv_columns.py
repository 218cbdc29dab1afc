"""Columns of a CSV file."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor


class CsvColumns:
    """The columns of a CSV file by their names, which its first line has.

    Lines and columns are counted from 1, as editors and spreadsheets do. Lines of nothing but
    empty fields are left out.

    Args:
        file: The file, in UTF-8.
        delimiter: What is between two fields.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it is no text, has no rows, or a row has not one field for each name.
    """

    def __init__(self, file: str | Path, delimiter: str = ",") -> None:
        self.file = str(file)
        try:
            with open(file, encoding="utf-8-sig", newline="") as text:
                reader = csv.reader(text, delimiter=delimiter)
                lines = [(reader.line_num, fields) for fields in reader if any(fields)]
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{file}: expected a CSV file in UTF-8, but {error}.") from error
        if len(lines) < 2:
            found = "only a line of names" if lines else "an empty file"
            raise ValueError(f"{file}: expected a line of names and then rows, found {found}.")
        (_, header), *self._rows = lines
        self.names = tuple(name.strip() for name in header)
        for line, fields in self._rows:
            if len(fields) != len(header):
                raise ValueError(
                    f"{file}, line {line}: expected {len(header)} fields, one for each name, found "
                    f"{len(fields)}; mend the line, or leave it out."
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

    def numbers(self, name: str, *, may_miss: bool = False) -> Tensor:
        """The numbers of a column, ``N``, in float64.

        Args:
            name: The name of the column.
            may_miss: Whether numbers may be missing: NaN, where a field is empty or says so.

        Raises:
            ValueError: If there is no such column, or several, or a field is no finite number.
        """
        column, values = self._column(name), []
        expected = "a number, or nothing where it was not measured" if may_miss else "a number"
        for line, fields in self._rows:
            text = fields[column].strip()
            try:
                value = float(text) if text else math.nan
            except ValueError:
                value = math.inf
            if not math.isfinite(value) and not (may_miss and math.isnan(value)):
                self._refuse(line, column, expected, text)
            values.append(value)
        return torch.tensor(values, dtype=torch.float64)

    def _column(self, name: str) -> int:
        places = [i for i, other in enumerate(self.names) if other == name]
        if len(places) == 1:
            return places[0]
        if places:
            columns = " and ".join(str(place + 1) for place in places)
            raise ValueError(
                f"{self.file}, line 1: expected one column {name!r}, found columns {columns}; "
                "rename those that are not meant."
            )
        found = ", ".join(map(repr, self.names))
        raise ValueError(
            f"{self.file}, line 1: expected a column {name!r}, found {found}. Say which column it "
            "is, such as `states={'theta': 'q'}`, or what is between the fields, by `delimiter`."
        )

    def _refuse(self, line: int, column: int, expected: str, text: str) -> NoReturn:
        raise ValueError(
            f"{self.file}, line {line}, column {column + 1} ({self.names[column]!r}): expected "
            f"{expected}, found {text!r}; mend the field, or leave the line out."
        )
