"""Figures of objects by ``plot()``, and their tables of HTML in a notebook.

The functions that draw are in rooms above those of the objects; the first figure imports them by
name, and matplotlib.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib import import_module
from typing import Any

FIGURES = {
    "Predictive": "validation.plots.plot_model",
    "PhysicsParameters": "validation.plots.plot_parameters",
    "Priors": "validation.plots.plot_priors",
    "LeaveOneOut": "validation.plots.plot_leave_one_out",
    "Comparison": "validation.plots.plot_comparison",
    "Collection": "active.plots.plot_collection",
    "Identification": "records.plots.plot_identification",
    "Lack": "records.plots.plot_lack",
    "Agent": "control.plots.plot_agent",
    "Dyna": "control.plots.plot_agent",
}
"""The function that draws objects of a class and of its subclasses."""


class Display:
    """An object with a figure, whose class is in :data:`FIGURES`."""

    def plot(self, **options: Any) -> Any:
        """Draw the object, by the function of :data:`FIGURES` with these options; return axes.

        Raises:
            ImportError: If matplotlib is not installed.
        """
        names = [kind.__name__ for kind in type(self).__mro__]
        room, _, name = next(FIGURES[n] for n in names if n in FIGURES).rpartition(".")
        try:
            import matplotlib as _  # noqa: F401
        except ImportError as error:
            raise ImportError(
                'plot() needs matplotlib; run `pip install "gpadjust[plot]"`.'
            ) from error
        return getattr(import_module(f"gpadjust.{room}"), name)(self, **options)


def html_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of HTML with every text escaped; leading spaces of a text stay.

    Example:
        >>> html_table("a < b", ["", "mean"], [["g", "9.81"]])[:42]
        '<table><caption>a &lt; b</caption><tr><th '
    """
    style = 'style="text-align: left; white-space: pre"'
    lines = []
    for kind, cells in [("th", head), *(("td", row) for row in rows)]:
        texts = [f"<{kind} {style}>{escape(cell)}</{kind}>" for cell in cells]
        lines += [f"<tr>{''.join(texts)}</tr>"] if texts else []
    return f"<table><caption>{escape(caption)}</caption>{''.join(lines)}</table>"


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of texts as lines with columns of one width.

    Example:
        >>> print(text_table([["", "mean"], ["mass", "0.25"]]))
              mean
        mass  0.25
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
