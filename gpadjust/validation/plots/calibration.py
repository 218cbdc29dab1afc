"""Figures of calibration."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from scipy.stats import binom
from torch import Tensor

from gpadjust.validation.leave_one_out import LeaveOneOut
from gpadjust.validation.plots.drawing import (
    BLUE,
    GREY,
    column,
    given_axes,
    labels,
    legend,
    new_axes,
    observed,
    tidy,
    whole,
)
from gpadjust.validation.scores import Scores


def plot_calibration(
    prediction: Tensor | LeaveOneOut | Scores, *, output: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw the observed coverage of central intervals against the nominal one.

    Below the diagonal the intervals are too narrow, above it too wide. The band holds 95 % of the
    observed coverages of a calibrated prediction with as many points, at each level.

    Args:
        prediction: PIT values, ``n`` or ``n x m``, or what has them. Those that are NaN, where
            nothing was observed, are left out.
        output: Which output to draw.
        ax: Where to draw. Default: a new figure.

    Raises:
        TypeError: If there are no PIT values in what was given, as in a model.
        ValueError: If PIT values are not between 0 and 1, or there is no such output.

    Example:
        >>> import torch
        >>> plot_calibration(torch.rand(50)).get_ylabel()
        'observed coverage'
    """
    pit, title = _pit_and_title(prediction, output)
    if ax is None:
        ax = new_axes(1, 1, size=3.6)[0, 0]
        ax.set_title(title)
    ax = given_axes(ax, (1,))[0]
    levels = np.linspace(0, 1, 201)
    n = len(pit)
    low, high = (binom.ppf(p, n, levels) / n for p in (0.025, 0.975))
    ax.fill_between(levels, low, high, color=GREY, alpha=0.2, lw=0, label="95 % if calibrated")
    ax.plot([0, 1], [0, 1], color=GREY, lw=1, ls="--")
    reached = np.sort(2 * (pit - 0.5).abs().numpy())
    steps = np.arange(n + 1) / n
    ax.step(
        [0, *reached, 1], [*steps, steps[-1]], where="post", color=BLUE, lw=1.8, label="observed"
    )
    ax.set(xlabel="nominal coverage", ylabel="observed coverage", aspect="equal")
    ax.set(xlim=(0, 1), ylim=(0, 1.01))
    ax.legend(frameon=False, loc="upper left")
    tidy(ax)
    return ax


def plot_pit(
    prediction: Tensor | LeaveOneOut | Scores,
    *,
    output: int = 0,
    bins: int = 10,
    ax: Axes | None = None,
) -> Axes:
    """Draw the histogram of PIT values: flat if calibrated, U-shaped if too sure.

    The band holds 95 % of the counts of a bin if calibrated.

    Args:
        prediction: PIT values, ``n`` or ``n x m``, or what has them. Those that are NaN, where
            nothing was observed, are left out.
        output: Which output to draw.
        bins: Number of bins.
        ax: Where to draw. Default: a new figure.

    Raises:
        TypeError: As :func:`plot_calibration`.
        ValueError: As :func:`plot_calibration`, or if ``bins`` is not a positive whole number.

    Example:
        >>> import torch
        >>> len(plot_pit(torch.rand(50), bins=5).patches)
        5
    """
    bins = whole(bins, "bins", 1)
    pit, title = _pit_and_title(prediction, output)
    if ax is None:
        ax = new_axes(1, 1)[0, 0]
        ax.set_title(title)
    ax = given_axes(ax, (1,))[0]
    n = len(pit)
    low, high = binom.ppf([0.025, 0.975], n, 1 / bins)
    ax.hist(pit.numpy(), bins=bins, range=(0, 1), color=BLUE, alpha=0.75, ec="white")
    ax.fill_between(
        [0, 1], low, high, color=GREY, alpha=0.25, lw=0, zorder=3, label="95 % if calibrated"
    )
    ax.axhline(n / bins, color=GREY, lw=1, ls="--", zorder=3)
    ax.set(xlabel="probability integral transform", ylabel="count", xlim=(0, 1))
    ax.set_ylim(top=1.25 * max(high, ax.get_ylim()[1]))  # room for the legend
    legend(ax)
    return ax


def _pit_and_title(prediction: Tensor | LeaveOneOut | Scores, output: int) -> tuple[Tensor, str]:
    """The PIT values of what was observed, and which output they are of, if that is a question."""
    prediction = prediction.score() if isinstance(prediction, LeaveOneOut) else prediction
    pit = prediction if isinstance(prediction, Tensor) else getattr(prediction, "pit", None)
    if not isinstance(pit, Tensor):
        raise TypeError(
            f"Expected what has PIT values, got {type(prediction).__name__}; pass "
            "`leave_one_out(model)` of a model, `score(posterior, Y)` of a posterior, or the "
            "values themselves as a torch tensor."
        )
    pit = pit.unsqueeze(-1) if pit.dim() == 1 else pit
    values = column(pit, output)
    values = values[observed(values, output)]
    if not ((values >= 0) & (values <= 1)).all():
        raise ValueError("Expected PIT values between 0 and 1, as `gpadjust.validation.pit` makes.")
    label = labels(prediction, "output", pit.shape[-1])[output]
    return values, "" if label == "y" else label
