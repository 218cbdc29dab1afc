"""Parts of all figures: colours, axes, names, bands, and one output of a posterior."""

from __future__ import annotations

import math
import re
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
from gpadjust.core.model import Predictive

BLUE, RED, GREY = "#0072B2", "#D55E00", "0.45"  # told apart by the colour-blind, too
BAND: dict[str, Any] = {"color": BLUE, "alpha": 0.2, "lw": 0}
DOTS: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4.5, "mec": "white", "mew": 0.6}


def quantile(level: float) -> float:
    """Half the width of the central interval, in standard deviations."""
    check_level(level)
    return NormalDist().inv_cdf((1 + level) / 2)


def mean_and_ends(prediction: Any, output: int, level: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean and the ends of the interval of one output of a posterior, ``n`` each."""
    z, marginals = quantile(level), getattr(prediction, "marginals", prediction)
    if isinstance(marginals, Marginals):
        ends = [marginals.quantile((1 + sign * level) / 2) for sign in (-1, 1)]
        mean = marginals.prediction.mean
    else:
        mean, half = prediction.mean, z * prediction.variance.sqrt()
        ends = [mean - half, mean + half]
    low, high = (column(end, output) for end in ends)
    return column(mean, output), low, high


def column(values: Tensor, output: int) -> Tensor:
    """One output of ``n x m`` values."""
    if values.dim() != 2:
        raise ValueError(
            f"Expected n x m values to draw, got shape {tuple(values.shape)}; plot the elements of "
            "a batch one by one."
        )
    if checked_whole("output", output, 0) >= values.shape[-1]:
        raise ValueError(f"There is no output {output}; there are {values.shape[-1]}, from 0.")
    return values[:, output].detach()


def observed(values: Tensor, output: int) -> Tensor:
    """The points, of ``n``, at which an output is not NaN; at least one."""
    seen = ~values.isnan()
    if not seen.any():
        raise ValueError(
            f"Output {output} has no observed value to draw, {len(values)} points of NaN; choose "
            "another `output`."
        )
    return seen


def labels(of: Any, kind: str, number: int) -> list[str]:
    """Return the names of the inputs or outputs (``kind``), or x or y with subscripts."""
    symbol = {"input": "x", "output": "y"}[kind]
    default = [symbol] if number == 1 else [f"{symbol}{k + 1}" for k in range(number)]
    owner = of.data if isinstance(of, Predictive) else of  # a model
    names = getattr(owner, f"{kind}_names", None) or default
    return [re.sub(r"^([xy])(\d+)$", r"$\1_{\2}$", _as_text(name)) for name in names]


def _as_text(name: str) -> str:
    """A name in which dollars are dollars, unless they hold a formula that can be drawn."""
    lines = []
    for line in name.split("\n"):
        try:
            MathTextParser("path").parse(line)
            lines.append(line)
        except ValueError:
            lines.append(line.replace("$", r"\$"))
    return "\n".join(lines)


def axes_of(given: Any, rows: int, columns: int, size: float = 3.2) -> Any:
    """The axes that the user gave as an array, or those of a new figure of pyplot."""
    if given is not None:
        return given_axes(given, (rows, columns))
    width = 1.3 * size if columns == 1 else 1.15 * size
    figure = plt.figure(figsize=(width * columns, size * rows), layout="constrained")
    return figure.subplots(rows, columns, squeeze=False)


def given_axes(axes: Any, shape: tuple[int, ...]) -> Any:
    """The axes that the user gave, as an array of the shape needed."""
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
    ax: Axes, truth: Tensor, mean: Tensor, ends: Any, level: float, xlabel: str, ylabel: str
) -> None:
    """Draw predictions with the ends of their intervals against what is true."""
    low, high = ends
    diagonal = [min(truth.min(), mean.min()), max(truth.max(), mean.max())]
    ax.plot(diagonal, diagonal, color=GREY, lw=1, ls="--")
    label, errors = f"mean, {100 * level:g} %", torch.stack([mean - low, high - mean])
    errors = errors.clamp_min(0.0)
    ax.errorbar(truth, mean, errors, color=BLUE, **DOTS, elinewidth=1, alpha=0.85, label=label)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.legend(frameon=False, loc="upper left")
    tidy(ax)


def legend(ax: Axes) -> None:
    """Add a legend and take away what is not needed."""
    ax.legend(frameon=False)
    tidy(ax)


def tidy(ax: Axes) -> None:
    """Take away the frame's upper and right sides."""
    ax.spines[["top", "right"]].set_visible(False)
