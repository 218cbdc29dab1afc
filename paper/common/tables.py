"""Tables in Markdown: for the terminal, for a file, and from there for the pages."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from paper.common.experiment import Run, Table
from paper.common.runs import IDENTIFYING
from paper.common.verdicts import Judged

Cell = Callable[[pd.DataFrame], Any]
"""What a cell shows of the runs of its row."""

_START, _END = r"<!-- (?!end)(\S+) -->\n", "<!-- end -->"
NOT_RUN = "*Not run yet.*"
_FRAGMENT = re.compile(_START + r"((?:(?!<!-- ).*\n)*?)" + _END)


def frame(
    runs: Sequence[Run], lists: str | Sequence[str] = (), index: str = "episode"
) -> pd.DataFrame:
    """Runs as a table, without what identifies them.

    Args:
        runs: The runs.
        lists: The entry that has lists by name, such as ``"trials"``; or the entries that are lists
            themselves. If given, there is a row for each of their elements.
        index: The column that counts the elements of a run, from 1.
    """
    if not lists:
        return pd.DataFrame([{k: v for k, v in r.items() if k not in IDENTIFYING} for r in runs])
    rows = []
    for run in runs:
        columns = run[lists] if isinstance(lists, str) else {name: run[name] for name in lists}
        left = {*IDENTIFYING, *([lists] if isinstance(lists, str) else lists)}
        own = {name: value for name, value in run.items() if name not in left}
        each = zip(*columns.values(), strict=True)
        rows += [
            {**own, index: i, **dict(zip(columns, values, strict=True))}
            for i, values in enumerate(each, 1)
        ]
    return pd.DataFrame(rows)


def groups(
    runs: pd.DataFrame,
    by: str | Sequence[str],
    labels: Mapping[Any, str] | Callable[..., str] | None = None,
) -> dict[str, pd.DataFrame]:
    """The rows of a table: parts of the runs, by their labels.

    Args:
        runs: All runs.
        by: The column that tells the parts apart, or several.
        labels: The labels of values, in the order of the rows: values that have none are left out.
            Or a function that makes a label (of several columns, it is given several values); the
            rows then have the order of the runs, as without labels.
    """
    parts = {
        values[0] if isinstance(by, str) else values: part
        for values, part in runs.groupby([by] if isinstance(by, str) else [*by], sort=False)
    }
    if isinstance(labels, Mapping):
        return {label: parts[value] for value, label in labels.items() if value in parts}
    label = labels or (lambda *values: ", ".join(map(str, values)))
    return {label(*([v] if isinstance(by, str) else v)): part for v, part in parts.items()}


def of(value: str, how: str | Callable[[Any], float] = "mean", form: str = ".3g") -> Cell:
    """A cell with a statistic of a column; empty where there is none.

    Args:
        value: The column.
        how: The statistic: a name that pandas knows, or a function of the values.
        form: Of the number.
    """

    def cell(runs: pd.DataFrame) -> str:
        if how == "mean":
            return number(exact_mean(runs[value]), form)
        # As one group: of values that are all alike pandas then finds a spread of 0.
        return number(runs.groupby(lambda _: 0)[value].agg(how).get(0), form)

    return cell


def exact_mean(values: pd.Series[float]) -> float:
    """The mean, in whatever order the values are; nan are left out, and the mean of none."""
    known = values.dropna()
    return math.fsum(known) / len(known) if len(known) else math.nan


def across(runs: pd.DataFrame, by: str, labels: Mapping[Any, str], cell: Cell) -> dict[str, Cell]:
    """Columns for the values of a column that the runs have, in the order of their labels."""

    def restricted(value: Any) -> Cell:
        return lambda part: cell(part[part[by] == value])

    found = {*runs[by]}
    return {label: restricted(value) for value, label in labels.items() if value in found}


def table(
    rows: Mapping[str, pd.DataFrame],
    columns: Mapping[str, Cell],
    corner: str = "",
    *,
    bold: bool = False,
) -> str:
    """A table of runs.

    Args:
        rows: The runs of each row, by its label, as ``groups`` makes them.
        columns: What cells show of them, by the heads of columns.
        corner: The head of the labels.
        bold: Whether the lowest number of a row is bold, and what looks the same.
    """
    found = []
    for label, runs in rows.items():
        cells = [str(cell(runs)) for cell in columns.values()]
        if bold:
            best = min((cell for cell in cells if cell), key=float, default="")
            cells = [f"**{cell}**" if cell and cell == best else cell for cell in cells]
        found.append([label, *cells])
    return markdown([corner, *columns], found)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def with_rows(text: str, rows: Iterable[Sequence[str]]) -> str:
    """A table with further rows, such as published numbers; cells that they lack are empty."""
    width = text.partition("\n")[0].count(" | ") + 1
    lines = [[*row, *[""] * (width - len(row))] for row in rows]
    return "\n".join([text, *("| " + " | ".join(line) + " |" for line in lines)])


def aligned(text: str) -> str:
    """A text whose tables have columns of equal width, as a terminal shows them."""
    return re.sub(r"^\|.*\|(\n\|.*\|)*$", _aligned, text, flags=re.MULTILINE)


def _aligned(match: re.Match[str]) -> str:
    rows = [line[2:-2].split(" | ") for line in match[0].splitlines()]
    del rows[1]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def as_document(tables: Mapping[str, Table]) -> str:
    """Tables as a file, each between the markers that it has in the pages."""
    parts = [
        f"{table.title}\n\n<!-- {name} -->\n{table.text}\n<!-- end -->"
        for name, table in tables.items()
    ]
    return "\n\n".join(parts) + "\n"


def fragments(text: str) -> dict[str, str]:
    """What stands between the markers of a text, by their names."""
    _check_markers(text)
    return {name: content.rstrip("\n") for name, content in _FRAGMENT.findall(text)}


def filled(text: str, tables: Mapping[str, str]) -> str:
    """Replace what stands between the markers of a text.

    Raises:
        ValueError: If there is nothing for one of them, or one has no end. Of an experiment without
            any table it is said that it was not run.
    """
    _check_markers(text)
    ran = {name.partition(":")[0] for name in tables}

    def fragment(match: re.Match[str]) -> str:
        name = match[1]
        if name not in tables and name.partition(":")[0] in ran:
            raise ValueError(f"No result is called {name!r}; there are {sorted(tables)}.")
        return f"<!-- {name} -->\n{tables.get(name, NOT_RUN)}\n<!-- end -->"

    return _FRAGMENT.sub(fragment, text)


def _check_markers(text: str) -> None:
    """Raise a ValueError unless each marker has an end of its own."""
    whole = {match.start() for match in _FRAGMENT.finditer(text)}
    for match in re.finditer(_START, text):
        if match.start() not in whole:
            raise ValueError(f"<!-- {match[1]} --> has no {_END} before the next marker; add it.")


def number(value: Any, form: str = ".3g", missing: str = "") -> str:
    """A number in a cell."""
    return missing if pd.isna(value) else format(value, form)


def numbers(table: pd.DataFrame, header: Sequence[str], form: str) -> str:
    """A table of numbers, its index first."""
    rows = [
        [str(label), *(number(value, form) for value in values)]
        for label, values in zip(table.index, table.to_numpy(), strict=True)
    ]
    return markdown(header, rows)


def claims_table(kind: str, parts: Mapping[str, Sequence[Judged]]) -> str:
    """Verdicts on the same claims, side by side.

    Args:
        kind: What they are called.
        parts: Of each column, by its heading.
    """
    rows = []
    for judged in zip(*parts.values(), strict=True):
        found = [f"**{claim.verdict}**: {claim.measured}" for claim in judged]
        if len(found) == 2 and found[0] == found[1]:
            found[1] = "the same"
        rows.append([judged[0].id, judged[0].claim, *found])
    return markdown(["", kind, *parts], rows)
