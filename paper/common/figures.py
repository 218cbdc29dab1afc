"""What figures share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image


def save(figure: Figure, path: Path) -> Path:
    """Write a figure to a file of few colors, which is small; return it."""
    drawn = BytesIO()
    with mpl.rc_context({"savefig.dpi": 100}):
        figure.savefig(drawn)
    image = Image.open(drawn).convert("RGB").quantize(96, dither=Image.Dither.NONE)
    image.save(path, optimize=True)
    return path


def panels(
    titles: Sequence[str],
    columns: int,
    size: tuple[float, float],
    *,
    share: bool = True,
    width: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each title.

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


def one_legend(figure: Figure, axes: Iterable[Axes], ncols: int = 3) -> None:
    """Add a legend above a figure, of the lines in any of its panels."""
    handles = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=ncols)


def curves(
    path: Path,
    parts: Mapping[str, pd.DataFrame],
    lines: Mapping[str, tuple[str, str]],
    labels: tuple[str, str],
    finish: Callable[[Axes], object] | None = None,
) -> Path:
    """Draw mean and standard deviation of a measure over trials, a panel for each part of the runs.

    Args:
        path: The file.
        parts: Runs by the title of their panel: a row for each run and ``episode``, ``value``.
        lines: Label and color of the learners that are drawn.
        labels: Labels below and at the left of all panels.
        finish: Adds to a panel.
    """
    figure, axes = panels([*parts], 2, (4.2, 3.0), width=8.0)
    for ax, runs in zip(axes, parts.values(), strict=True):
        for name, (label, color) in lines.items():
            values = runs[runs["learner"] == name].groupby("episode")["value"]
            mean, sd = values.mean(), values.std()
            if len(mean):
                ax.fill_between(mean.index, mean - sd, mean + sd, color=color, alpha=0.12, lw=0)
                ax.plot(mean.index, mean, color=color, lw=1.5, label=label)
        ax.grid(axis="y", color="0.9", lw=0.6)
        ax.set_axisbelow(True)
        if finish:
            finish(ax)
    figure.supxlabel(labels[0], fontsize="medium")
    figure.supylabel(labels[1], fontsize="medium")
    one_legend(figure, axes, ncols=4)
    return save(figure, path)
