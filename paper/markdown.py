"""Tables for the READMEs."""

from __future__ import annotations

from collections.abc import Sequence

NOT_RUN = "No results yet."


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
