"""Copies the committed results into the pages, between their markers."""

from __future__ import annotations

from pathlib import Path

from paper.common.tables import filled, fragments

PAPER = Path(__file__).parent
_FOLDERS = ("*.md", "*/*.md")
PAGES = sorted([PAPER.parent / "README.md", *(p for f in _FOLDERS for p in PAPER.glob(f))])


def report() -> None:
    """Write every result into the pages."""
    found = results(PAPER / "results")
    for path in PAGES:
        path.write_text(filled(path.read_text(), found))


def results(folder: Path) -> dict[str, str]:
    """The tables of all experiments, by the names of their markers."""
    found: dict[str, str] = {}
    for path in sorted(folder.glob("*/tables.md")):
        found |= fragments(path.read_text())
    return found
