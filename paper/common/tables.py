"""Tables in Markdown: for the terminal, for a file, and from there for the READMEs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from paper.common.claims import Judged
from paper.common.experiment import Table

_START, _END = r"<!-- (?!end)(\S+) -->\n", "<!-- end -->"
_FRAGMENT = re.compile(_START + r"((?:(?!<!-- ).*\n)*?)" + _END)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


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
    """Tables as a file, each between the markers that it has in the READMEs."""
    parts = [
        f"{table.title}\n\n<!-- {name} -->\n{table.text}\n<!-- end -->"
        for name, table in tables.items()
    ]
    return "\n\n".join(parts) + "\n"


def fragments(text: str) -> dict[str, str]:
    """What stands between the markers of a text, by their names."""
    _check_markers(text)
    return {name: content.rstrip("\n") for name, content in _FRAGMENT.findall(text)}


def filled(text: str, found: Mapping[str, str]) -> str:
    """Replace what stands between the markers of a text.

    Raises:
        ValueError: If there is nothing for one of them, or one has no end.
    """
    _check_markers(text)

    def fragment(match: re.Match[str]) -> str:
        name = match[1]
        if name not in found:
            raise ValueError(f"No result is called {name!r}; there are {sorted(found)}.")
        return f"<!-- {name} -->\n{found[name]}\n<!-- end -->"

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


def best_in_bold(values: pd.Series[float]) -> list[str]:
    """Two digits of each value, the lowest in bold (and what looks the same)."""
    cells = [f"{value:.2g}" for value in values]
    best = f"{np.nanmin(values):.2g}"
    return [f"**{cell}**" if cell == best else cell for cell in cells]


def settings_table(columns: Mapping[str, Mapping[str, Any]]) -> str:
    """A row for each setting, a column for each of what they are of."""
    names = list(next(iter(columns.values())))
    rows = [[f"`{name}`", *(f"{of[name]}" for of in columns.values())] for name in names]
    return markdown(["setting", *columns], rows)


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
