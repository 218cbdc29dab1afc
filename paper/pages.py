"""Tables in the pages, and numbers that documents quote of them.

A quoted number is a link to its table, whose title is its place there:
``[0.31](../results/first/tables.md#first:trials "CKA, trial 1 :: cost")``. A reader sees the place
as a tooltip. The row is its first cell, or the first cells joined by commas where that is needed.
"""

from __future__ import annotations

import re
from pathlib import Path

from paper.common.tables import filled, fragments

PAPER = Path(__file__).parent
ROOT = PAPER.parent
PAGES = sorted([*PAPER.glob("*.md"), *PAPER.glob("*/*.md")])
QUOTING = [ROOT / "README.md", *PAGES, *sorted((ROOT / "docs").rglob("*.md"))]
"""Documents whose quotes are checked."""
_LINK = re.compile(r"\[([^][]*)\]\(([^)\s]*tables\.md)#([^)\s]+)(?:\s+\"([^\"]*)\")?\)")
_NUMBER = re.compile(r"(?<![\w.])[-+\N{MINUS SIGN}]?\d[\d,]*(?:\.\d+)?(?:e[-+]\d+)?")


def report() -> None:
    """Write every result into the pages."""
    tables = results(PAPER / "results")
    for path in PAGES:
        path.write_text(filled(path.read_text(), tables))


def results(folder: Path) -> dict[str, str]:
    """Return the tables of all experiments, by the names of their markers."""
    tables: dict[str, str] = {}
    for path in sorted(folder.glob("*/tables.md")):
        tables |= fragments(path.read_text())
    return tables


def wrong_quotes(text: str, tables: dict[str, str]) -> list[str]:
    """Return the quotes of a text that differ from their tables, each with the reason."""
    by_anchor = {name.lower(): table for name, table in tables.items()}
    wrong = []
    for quoted, _, anchor, place in _LINK.findall(text):
        reason = _reason(quoted, by_anchor.get(anchor), place)
        if reason:
            wrong.append(f"[{quoted}](#{anchor}): {reason}")
    return wrong


def _reason(quoted: str, table: str | None, place: str) -> str:
    """Return what is wrong with a quote; empty if nothing is."""
    numbers = _NUMBER.findall(quoted)
    if table is None:
        return "there is no such table"
    if not numbers:
        return ""
    row, separator, column = place.partition(" :: ")
    if not separator:
        return 'its link has no title with a place, "row :: column"'
    cells = [cell for label, cell in _cells(table, column) if label == row]
    if len(cells) != 1:
        return f"there are {len(cells)} cells at {place!r}, not one"
    left = iter(_NUMBER.findall(cells[0]))
    for number in numbers:  # in the order of the cell
        if not any(_rounds_to(exact, number) for exact in left):
            return f"the table has {cells[0]!r}"
    return ""


def _cells(table: str, column: str) -> list[tuple[str, str]]:
    """Return the cells of a column, each for every label of its row."""
    lines = [line[2:-2].split(" | ") for line in table.splitlines() if line.startswith("| ")]
    header, rows = lines[0], lines[2:]
    if column not in header:
        return []
    place, above, cells = header.index(column), [""] * len(header), []
    for row in rows:
        row = [cell.strip().strip("*") for cell in row]
        above = [cell or old for cell, old in zip(row, above, strict=True)]
        labels = {", ".join(above[:k]) for k in range(1, place + 1)}
        cells += [(label, row[place]) for label in sorted(labels)]
    return cells


def _rounds_to(exact: str, quoted: str) -> bool:
    """Tell whether a number is quoted as it is, rounded, or in per cent."""
    value, shown = (
        float(re.sub("\N{MINUS SIGN}", "-", n).replace(",", "")) for n in (exact, quoted)
    )
    decimals = len(quoted.partition(".")[2])
    half = 0.5001 * 10.0**-decimals
    return abs(value - shown) <= half or abs(100 * value - shown) <= half
