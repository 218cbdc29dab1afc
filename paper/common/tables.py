"""Tables in Markdown: for the terminal, for a file, and from there for the pages."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from paper.common.experiment import Run, Table
from paper.common.runs import IDENTIFYING
from paper.common.verdicts import Difference, Judged, paired

Cell = Callable[[pd.DataFrame], Any]
"""What a cell shows of the runs of its row."""

_START, _END = r"<!-- (?!end)(\S+) -->\n", "<!-- end -->"
NOT_RUN = "*Not run yet.*"
_FRAGMENT = re.compile(_START + r"((?:(?!<!-- ).*\n)*?)" + _END)


def frame(
    runs: Sequence[Run], lists: str | Sequence[str] = (), index: str = "episode"
) -> pd.DataFrame:
    """Return runs as a table, without what identifies them.

    Args:
        runs: The runs.
        lists: The entry that has lists by name, such as ``"trials"``; or the entries that are lists
            themselves. If given, there is a row for each of their elements.
        index: The column that counts the elements of a run, from 1.
    """
    if not lists:
        return pd.DataFrame([{k: v for k, v in r.items() if k not in IDENTIFYING} for r in runs])
    names = [lists] if isinstance(lists, str) else lists
    rows = []
    for run in runs:
        columns = run[lists] if isinstance(lists, str) else {n: run[n] for n in names if n in run}
        own = {name: run[name] for name in run if name not in {*IDENTIFYING, *names}}
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
    """Return the rows of a table: parts of the runs, by their labels.

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


def of(
    value: str,
    how: str | Callable[[Any], float] = "mean",
    form: str = ".3g",
    **only: Any,
) -> Cell:
    """Return a cell with a statistic of a column; empty where there is none.

    Args:
        value: The column.
        how: The statistic: a name that pandas knows, or a function of the values.
        form: Of the number.
        only: Values of other columns, of the runs that are taken.
    """

    def cell(runs: pd.DataFrame) -> str:
        values = pd.to_numeric(part_of(runs, **only)[value])
        if how == "mean":
            known = values.dropna()
            # In whatever order the values are.
            return number(math.fsum(known) / len(known) if len(known) else math.nan, form)
        # As one group: of values that are all alike pandas then finds a spread of 0.
        return number(values.groupby(lambda _: 0).agg(how).get(0), form)

    return cell


def part_of(runs: pd.DataFrame, **only: Any) -> pd.DataFrame:
    """Return the runs that have these values in these columns."""
    for column, value in only.items():
        runs = runs[runs[column] == value]
    return runs


def mean_error(
    value: str, form: str, error: str | None = None, *, counted: bool = False, **only: Any
) -> Cell:
    """Return a cell with the mean, its standard error if runs differ, and the number of runs."""

    def cell(runs: pd.DataFrame) -> str:
        found = Difference.of(pd.to_numeric(part_of(runs, **only)[value]))
        text = number(found.mean, form)
        if not math.isnan(found.error):
            text += f" ± {found.error:{error or form}}"
        return text + (f" ({found.n})" if counted and found.n > 1 else "")

    return cell


def ratio_of(value: str, name: str, other: str) -> Cell:
    """Return a cell with the geometric mean of two learners' paired ratios, and its interval."""
    return lambda runs: paired(runs, value, "learner", name, other, ratio=True).ratio()


def across(runs: pd.DataFrame, by: str, labels: Mapping[Any, str], cell: Cell) -> dict[str, Cell]:
    """Return columns for the values of a column that the runs have, in the order of labels."""

    def restricted(value: Any) -> Cell:
        return lambda part: cell(part[part[by] == value])

    found = {*runs[by]}
    return {label: restricted(value) for value, label in labels.items() if value in found}


def table(
    rows: Mapping[str, pd.DataFrame],
    columns: Mapping[str, Cell],
    corner: str = "",
    more: Iterable[Sequence[str]] = (),
) -> str:
    """Return a table of runs.

    Args:
        rows: The runs of each row, by its label, as ``groups`` makes them.
        columns: What cells show of them, by the heads of columns.
        corner: The head of the labels.
        more: Further rows, such as published numbers; cells that they lack are empty.
    """
    lines = [[label, *(str(cell(r)) for cell in columns.values())] for label, r in rows.items()]
    lines += [[*row, *[""] * (1 + len(columns) - len(row))] for row in more]
    return markdown([corner, *columns], lines)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def as_document(tables: Mapping[str, Table]) -> str:
    """Return tables as a file, each between the markers that it has in the pages."""
    parts = [
        f"{table.title}\n\n<!-- {name} -->\n{table.text}\n<!-- end -->"
        for name, table in tables.items()
    ]
    return "\n\n".join(parts) + "\n"


def fragments(text: str) -> dict[str, str]:
    """Return the texts between the markers of a text, by their names."""
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


def number(value: Any, form: str = ".3g") -> str:
    """Return a number in a cell, which is empty if there is none."""
    return "" if pd.isna(value) else format(value, form)


def claims_table(parts: Mapping[str, Sequence[Judged]]) -> str:
    """Return verdicts on the same claims side by side, a column for each heading."""
    rows = []
    for judged in zip(*parts.values(), strict=True):
        found = [f"**{claim.verdict}**: {claim.measured}" for claim in judged]
        if len(found) == 2 and found[0] == found[1]:
            found[1] = "the same"
        rows.append([judged[0].id, judged[0].claim, *found])
    return markdown(["", "claim", *parts], rows)
