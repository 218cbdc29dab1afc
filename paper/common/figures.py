"""What figures share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure to a file; return it."""
    with mpl.rc_context({"savefig.dpi": 110}):
        figure.savefig(path)
    return path


def panels(
    titles: Sequence[str],
    columns: int,
    size: tuple[float, float],
    *,
    share: bool = True,
    width: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each title.

    Args:
        titles: What stands above the panels.
        columns: Panels in a row.
        size: Of a panel, in inches.
        share: Whether all have the same axes.
        width: The least of the figure, such as that of its legend.
    """
    columns = min(columns, len(titles))
    rows = math.ceil(len(titles) / columns)
    size = (max(width, size[0] * columns), size[1] * rows + 0.8)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=share, sharey=share, squeeze=False).flatten()
    for ax in axes[len(titles) :]:
        ax.set_visible(False)
    for ax, title in zip(axes, titles, strict=False):
        ax.set_title(title, loc="left", fontsize=10)
        ax.tick_params(labelbottom=True)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, list(axes[: len(titles)])


def draw_quartiles(
    ax: Axes,
    records: pd.DataFrame,
    measure: str,
    *,
    by: str = "episode",
    color: str,
    label: str,
    band: bool = True,
) -> None:
    """Draw the median over runs, and the quartiles as a band; they hold where one run fails."""
    values = records.groupby(by)[measure]
    low, middle, high = (values.quantile(q) for q in (0.25, 0.5, 0.75))
    if band:
        ax.fill_between(middle.index, low, high, color=color, alpha=0.15, lw=0)
    ax.plot(middle.index, middle, color=color, lw=1.5, label=label)


def one_legend(figure: Figure, axes: Iterable[Axes], ncols: int = 3) -> None:
    """A legend above a figure, of the lines in any of its panels, of which not all have all."""
    handles = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=ncols)
