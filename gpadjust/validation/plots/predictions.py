"""Plots of predictions: along an input, of left-out observations, and their coverage."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from scipy.stats import binom
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.validation.leave_one_out import LeaveOneOut, observations
from gpadjust.validation.plots.drawing import (
    BAND,
    BLUE,
    DOTS,
    GREY,
    RED,
    against_truth,
    axes_of,
    band,
    column,
    labels,
    legend,
    mean_and_ends,
    observed,
    quantile,
    tidy,
)
from gpadjust.validation.scores import Scores


def plot_prediction(
    model: Any,
    X: Tensor,
    Y: Tensor | None = None,
    *,
    output: int = 0,
    level: float = 0.95,
    observation_noise: bool = False,
    ax: Axes | None = None,
) -> Axes:
    """Draw what a model predicts.

    With one input: the mean, the central interval, the training data, the physics, and the truth
    if ``Y`` is given. With more: the predictions against ``Y``, with their intervals.

    Args:
        model: Any BoTorch model.
        X: Raw inputs, ``n x d``.
        Y: True values there, ``n x m``; needed if ``d > 1``. Those that are NaN are left out.
        output: Which output to draw.
        level: Nominal coverage of the intervals.
        observation_noise: Whether the intervals are those of observations.
        ax: Where to draw. Default: a new figure.

    Raises:
        TypeError: If ``X`` or ``Y`` is no tensor, or ``level`` no number.
        ValueError: If shapes or ``level`` are wrong, there is no such output, or ``Y`` is missing.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> plot_prediction(model, X).get_xlabel()
        'x'
    """
    _check_inputs(X, Y)
    if X.shape[-1] > 1 and Y is None:
        raise ValueError(
            f"X has {X.shape[-1]} inputs, so predictions are drawn against the truth: pass `Y`; "
            "for slices through a model use `plot_adjustment`."
        )
    with torch.no_grad():
        posterior = model.posterior(X, observation_noise=observation_noise)
    drawn = mean_and_ends(posterior, output, level)
    label = labels(model, "output", posterior.mean.shape[-1])[output]
    if Y is not None and Y.shape[-1] != posterior.mean.shape[-1]:
        raise ValueError(
            f"Expected Y with the {posterior.mean.shape[-1]} outputs of the model as its columns, "
            f"got shape {tuple(Y.shape)}."
        )
    if Y is not None:
        truth = column(Y, output)
        seen = observed(truth, output)
    ax = axes_of(ax, 1, 1)[0, 0]
    if X.shape[-1] > 1:
        of = "" if label == "y" else f" {label}"
        mean, *ends = (each[seen] for each in drawn)
        against_truth(ax, truth[seen], mean, ends, level, f"true{of}", f"predicted{of}")
        return ax
    order = X[:, 0].argsort()
    x = X[order, 0].detach()
    mean, low, high = (each[order] for each in drawn)
    band(ax, x, mean, low, high, level)
    draw_physics(ax, model, X[order], x, output)
    if Y is not None:
        order = order[seen[order]]
        ax.plot(X[order, 0].detach(), truth[order], color="black", lw=1, ls=":", label="truth")
    train_X, train_Y = observations(model)
    y = column(train_Y, output)
    ax.plot(train_X[~y.isnan(), 0], y[~y.isnan()], color=RED, **DOTS, label="data")
    ax.set(xlabel=labels(model, "input", 1)[0], ylabel=label)
    legend(ax)
    return ax


def plot_leave_one_out(
    loo: LeaveOneOut, *, output: int = 0, level: float = 0.95, axes: Any = None
) -> Any:
    """Draw left-out predictions against the observations, and standardized residuals.

    Points at which the output was not observed are left out.

    Args:
        loo: The result of :func:`~gpadjust.validation.leave_one_out`, without batch.
        output: Which output to draw.
        level: Nominal coverage of the intervals.
        axes: Two axes to draw on. Default: a new figure.

    Returns:
        An array of two axes.

    Raises:
        TypeError: If ``loo`` is something else, as a model, or ``level`` is no number.
        ValueError: If there is a batch, no such output, or ``level`` is not between 0 and 1.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.validation import leave_one_out
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> plot_leave_one_out(leave_one_out(model)).shape
        (2,)
    """
    if not isinstance(loo, LeaveOneOut):
        raise TypeError(
            f"Expected a LeaveOneOut, got {type(loo).__name__}; pass `leave_one_out(model)`."
        )
    z = quantile(level)
    seen = observed(column(loo.Y, output), output)
    values = (loo.Y, loo.mean, loo.variance.sqrt(), loo.residuals)
    Y, mean, sd, residuals = (column(each, output)[seen] for each in values)
    label = labels(loo, "output", loo.Y.shape[-1])[output]
    axes = axes_of(axes, 1, 2)[0]
    of = "" if label == "y" else f" {label}"
    ends = (mean - z * sd, mean + z * sd)
    against_truth(axes[0], Y, mean, ends, level, f"observed{of}", "predicted without it")
    axes[1].axhspan(-z, z, **BAND, label=f"{100 * level:g} %")
    axes[1].axhline(0, color=GREY, lw=1, ls="--")
    axes[1].plot(mean, residuals, color=BLUE, **DOTS)
    top = 1.35 * max(z, residuals.abs().max().item())  # room for the legend
    axes[1].set(xlabel="predicted without it", ylabel="standardized residual", ylim=(-top, top))
    legend(axes[1])
    return axes


@torch.no_grad()
def physics_at(model: Any, X: Tensor) -> dict[str, Tensor]:
    """Return the outputs ``n x m`` of each physics by name, the means of their draws."""
    found: dict[str, Tensor] = {}
    names = {t.physics: t.name.removeprefix("rho_") for t in getattr(model, "terms", ())}
    f = model.places(X, model.values).f if getattr(model, "physics", None) else []
    for i, outputs in enumerate(f):
        name = f"physics {names.get(i, i + 1)}" if len(f) > 1 else "physics"
        values = (outputs * model.unit).mT
        found[name] = model.marginals_of(values, torch.zeros_like(values)).prediction.mean
    return found


def draw_physics(ax: Axes, model: Any, X: Tensor, x: Tensor, output: int) -> None:
    """Draw an output of each physics at ``X``, over one of its columns."""
    styles = cycle(("--", "-.", ":"))
    for (name, f_p), style in zip(physics_at(model, X).items(), styles, strict=False):
        ax.plot(x, column(f_p, output), color=GREY, ls=style, lw=1.2, label=name)


def _check_inputs(X: Tensor, Y: Tensor | None) -> None:
    for name, values in (("X", X), ("Y", Y)):
        if not isinstance(values, Tensor) and (name == "X" or values is not None):
            raise TypeError(
                f"Expected {name} to be a torch tensor, got {type(values).__name__}; convert it "
                f"with `torch.as_tensor({name}, dtype=torch.float64)`."
            )
    if X.dim() != 2 or not X.numel():
        raise ValueError(f"Expected X of shape n x d, one point or more, got {tuple(X.shape)}.")
    if Y is not None and (Y.dim() != 2 or len(Y) != len(X)):
        raise ValueError(
            f"Expected Y of shape {len(X)} x m, one row for each of X, got {tuple(Y.shape)}."
        )


def plot_coverage(
    prediction: Tensor | LeaveOneOut | Scores, *, output: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw the observed coverage of central intervals against the nominal one.

    Below the diagonal the intervals are too narrow, above it too wide. The band holds 95 % of the
    observed coverages of predictions whose intervals hold, of as many points, at each level.

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
        >>> plot_coverage(torch.rand(50)).get_ylabel()
        'observed coverage'
    """
    pit, ax = _pit_and_axes(prediction, output, ax, 3.6)
    levels = np.linspace(0, 1, 201)
    n = len(pit)
    low, high = (binom.ppf(p, n, levels) / n for p in (0.025, 0.975))
    ax.fill_between(levels, low, high, color=GREY, alpha=0.2, lw=0, label="95 % if intervals hold")
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
    """Draw the histogram of PIT values: flat if intervals hold, U-shaped if too sure.

    The band holds 95 % of the counts of a bin if intervals hold.

    Other arguments, and errors, are those of :func:`plot_coverage`; ``bins``, the number of bins,
    is a positive whole number.

    Example:
        >>> import torch
        >>> len(plot_pit(torch.rand(50), bins=5).patches)
        5
    """
    bins = checked_whole("bins", bins, 1)
    pit, ax = _pit_and_axes(prediction, output, ax, 3.2)
    n = len(pit)
    low, high = binom.ppf([0.025, 0.975], n, 1 / bins)
    ax.hist(pit.numpy(), bins=bins, range=(0, 1), color=BLUE, alpha=0.75, ec="white")
    ax.fill_between(
        [0, 1], low, high, color=GREY, alpha=0.25, lw=0, zorder=3, label="95 % if intervals hold"
    )
    ax.axhline(n / bins, color=GREY, lw=1, ls="--", zorder=3)
    ax.set(xlabel="probability integral transform", ylabel="count", xlim=(0, 1))
    ax.set_ylim(top=1.25 * max(high, ax.get_ylim()[1]))  # room for the legend
    legend(ax)
    return ax


def _pit_and_axes(
    prediction: Tensor | LeaveOneOut | Scores, output: int, ax: Axes | None, size: float
) -> tuple[Tensor, Axes]:
    """Return the PIT values of what was observed, and the axes; new ones have a title."""
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
    drawn = axes_of(ax, 1, 1, size)[0, 0]
    if ax is None and label != "y":
        drawn.set_title(label)
    return values, drawn
