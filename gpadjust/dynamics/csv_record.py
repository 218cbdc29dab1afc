"""A record from a CSV file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import torch

from gpadjust.checks import checked_number
from gpadjust.dynamics.record import Record
from gpadjust.files import CsvColumns
from gpadjust.states import StateSpec

Column = TypeVar("Column", bound=str | None)


def read_record(
    file: str | Path,
    spec: StateSpec,
    states: Mapping[str, str | None],
    actions: Mapping[str, str],
    time: str | float,
    segment: str | None,
    delimiter: str,
    decimal: str,
) -> Record:
    """The record in a file; see :meth:`~gpadjust.dynamics.Records.read_csv`.

    Args:
        file: The file.
        spec: What the entries of states and actions are.
        states: The column of each state; None if there is none.
        actions: The column of each action.
        time: The column of times, or the time from one row to the next.
        segment: The column of labels, if there is one.
        delimiter: What is between two fields.
        decimal: The decimal mark of numbers.
    """
    table = CsvColumns(file, delimiter, decimal=decimal)
    if isinstance(time, str):
        times = table.numbers(time)
    else:
        step = checked_number("time", time, above=0)
        times = step * torch.arange(len(table), dtype=torch.float64)
    measured = []
    for name, column in states.items():
        filled_in = name in spec.previous and name == column and name not in table.names
        if column is None or filled_in:
            measured.append(torch.full_like(times, math.nan))
        else:
            measured.append(table.numbers(column, may_miss=True))
    taken = [table.numbers(column) for column in actions.values()]
    labels = None if segment is None else table.texts(segment)
    return Record(times, torch.stack(measured, -1), torch.stack(taken, -1), labels, str(file))


def checked_columns(
    given: Mapping[str, Column] | None, names: Iterable[str], argument: str
) -> dict[str, Column | str]:
    """The column of each name: the one given, or else that of the same name.

    Raises:
        TypeError: If it is no mapping.
        ValueError: If it has another name.
    """
    given, names = {} if given is None else given, tuple(names)
    if not isinstance(given, Mapping):
        raise TypeError(
            f"Expected {argument} as a dictionary from names of the spec to columns, such as "
            f"{{{names[0]!r}: 'q'}}, found {given!r}."
        )
    if unknown := [name for name in given if name not in names]:
        raise ValueError(f"There is no {unknown[0]!r} among the {argument} of the spec, {names}.")
    return {name: given.get(name, name) for name in names}
