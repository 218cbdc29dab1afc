"""Parts of all figures: colours, axes, names, bands, and one output of a prediction."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.mathtext import MathTextParser
from torch import Tensor

from gpadjust.checks import check_level, checked_whole
from gpadjust.core.gaussian import Marginals

BLUE, RED, GREY = "#0072B2", "#D55E00", "0.45"  # told apart by the colour-blind, too
BAND: dict[str, Any] = {"color": BLUE, "alpha": 0.2, "lw": 0}
DOTS: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4.5, "mec": "white", "mew": 0.6}


def quantile(level: float) -> float:
    """Return half the width of the central interval, in standard deviations."""
    check_level(level)
    return NormalDist().inv_cdf((1 + level) / 2)


def mean_and_ends(prediction: Any, output: int, level: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean and the ends of the interval of one output of a posterior, ``n`` each."""
    marginals = getattr(prediction, "marginals", prediction)
    if isinstance(marginals, Marginals):
        mean = marginals.prediction.mean
        low, high = (marginals.quantile((1 + sign * level) / 2) for sign in (-1, 1))
    else:
        mean, half = prediction.mean, quantile(level) * prediction.variance.sqrt()
        low, high = mean - half, mean + half
    return column(mean, output), column(low, output), column(high, output)


def column(values: Tensor, output: int) -> Tensor:
    """Return one output of ``n x m`` values."""
    if values.dim() != 2:
        raise ValueError(
            f"Expected n x m values to draw, got shape {tuple(values.shape)}; plot the elements of "
            "a batch one by one."
        )
    if checked_whole("output", output, 0) >= values.shape[-1]:
        raise ValueError(f"There is no output {output}; there are {values.shape[-1]}, from 0.")
    return values[:, output].detach()


def labels(names: Sequence[str]) -> list[str]:
    """Return names as labels; x1 and y2, which stand for no name, with subscripts."""
    return [re.sub(r"^([xy])(\d+)$", r"$\1_{\2}$", _as_text(name)) for name in names]


def _as_text(name: str) -> str:
    """Return a name in which dollars are dollars, unless they hold a formula to be drawn."""
    lines = []
    for line in name.split("\n"):
        try:
            MathTextParser("path").parse(line)
            lines.append(line)
        except ValueError:
            lines.append(line.replace("$", r"\$"))
    return "\n".join(lines)


def axes_of(given: Any, rows: int, columns: int, size: float = 3.2) -> Any:
    """Return the axes that the user gave as an array, or those of a new figure of pyplot."""
    if given is not None:
        return given_axes(given, (rows, columns))
    width = 1.3 * size if columns == 1 else 1.15 * size
    figure = plt.figure(figsize=(width * columns, size * rows), layout="constrained")
    return figure.subplots(rows, columns, squeeze=False)


def given_axes(axes: Any, shape: tuple[int, ...]) -> Any:
    """Return the axes that the user gave, as an array of the shape needed."""
    axes = np.asarray(axes)
    number = sum(isinstance(ax, Axes) for ax in axes.flat)
    if not number == axes.size == math.prod(shape):
        raise ValueError(f"Expected {' x '.join(map(str, shape))} axes, got {number}.")
    return axes.reshape(shape)


def band(ax: Axes, x: Tensor, mean: Tensor, low: Tensor, high: Tensor, level: float) -> None:
    """Draw a mean and its interval, ``n`` each."""
    ax.fill_between(x, low, high, **BAND, label=f"{100 * level:g} %")
    ax.plot(x, mean, color=BLUE, lw=1.8, label="mean")


def against_truth(
    ax: Axes, truth: Tensor, drawn: Sequence[Tensor], level: float, xlabel: str
) -> None:
    """Draw predictions, a mean and the ends of its interval, against the true values, ``n``."""
    seen = ~truth.isnan()
    truth, mean, low, high = (each[seen] for each in (truth, *drawn))
    diagonal = [min(truth.min(), mean.min()), max(truth.max(), mean.max())]
    ax.plot(diagonal, diagonal, color=GREY, lw=1, ls="--")
    errors = torch.stack([mean - low, high - mean]).clamp_min(0.0)
    label = f"mean, {100 * level:g} %"
    ax.errorbar(truth, mean, errors, color=BLUE, **DOTS, elinewidth=1, alpha=0.85, label=label)
    ax.set_xlabel(xlabel)
    ax.legend(frameon=False, loc="upper left")
    tidy(ax)


def share_limits(axes: Sequence[Axes]) -> None:
    """Give axes the same range of y: slices of one function are compared by eye."""
    low, high = zip(*(ax.get_ylim() for ax in axes), strict=True)
    for ax in axes:
        ax.set_ylim(min(low), max(high))


def legend(ax: Axes) -> None:
    """Add a legend and remove the frame's upper and right sides."""
    ax.legend(frameon=False)
    tidy(ax)


def tidy(ax: Axes) -> None:
    """Remove the frame's upper and right sides."""
    ax.spines[["top", "right"]].set_visible(False)
