"""The figure that one wants first: what a model predicts, and how it adjusts the physics."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.kinds.categories import on_levels
from gpadjust.validation.leave_one_out import observations
from gpadjust.validation.plots.adjustments import adjustments_of, domain, plot_adjustment
from gpadjust.validation.plots.drawing import (
    DOTS,
    RED,
    axes_of,
    band,
    column,
    labels,
    mean_and_ends,
    quantile,
    tidy,
)
from gpadjust.validation.plots.predictions import draw_physics


def plot_model(
    model: Any,
    *,
    bounds: Tensor | None = None,
    base: Tensor | None = None,
    output: int = 0,
    level: float = 0.95,
    num_points: int = 200,
    axes: Any = None,
) -> Any:
    r"""Draw predictions, and :math:`\rho` and :math:`\delta` below, along each input.

    The first row has the mean, the central interval and the physics; of
    one input also the data, of several ticks at the bottom, at the training inputs, as the curves
    are slices through the base point. The other rows are those of :func:`plot_adjustment`, if the
    model adjusts a physics.

    The arguments and errors are those of :func:`plot_adjustment`.

    Returns:
        An array of axes, ``rows x d``.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> plot_model(model).shape
        (3, 1)
    """
    names = adjustments_of(model)
    num_points = checked_whole("num_points", num_points, 2)
    quantile(level)  # refused before there is a figure
    train_X, bounds, base, _ = domain(model, bounds, base, output)
    d, train_Y = train_X.shape[-1], observations(model)[1]
    y = column(train_Y, output)
    axes = axes_of(axes, 1 + len(names), d, 2.6)
    for i, ax in enumerate(axes[0]):
        X = base.repeat(num_points, 1)
        X[:, i] = x = torch.linspace(bounds[0, i], bounds[1, i], num_points, dtype=base.dtype)
        X = on_levels(model, X)
        with torch.no_grad():
            drawn = mean_and_ends(model.marginals(X), output, level)
            draw_physics(ax, model, X, x, output)
        band(ax, x, *drawn, level)
        if d == 1:
            ax.plot(train_X[:, 0], y[~y.isnan()], color=RED, **DOTS, label="data")
        else:
            bottom = ax.get_xaxis_transform()
            ax.plot(train_X[:, i], torch.zeros(len(train_X)), "|", color=RED, transform=bottom)
        ax.set_xlim(*bounds[:, i].tolist())
        tidy(ax)
    low, high = zip(*(ax.get_ylim() for ax in axes[0]), strict=True)
    for ax in axes[0]:
        ax.set_ylim(min(low), max(high))
    axes[0, 0].set_ylabel(labels(model, "output", train_Y.shape[-1])[output])
    axes[0, 0].legend(frameon=False)
    if names:
        options: dict[str, Any] = {"output": output, "level": level, "num_points": num_points}
        plot_adjustment(model, bounds=bounds, base=base, axes=axes[1:], **options)
    else:
        for ax, label in zip(axes[0], labels(model, "input", d), strict=True):
            ax.set_xlabel(label)
    return axes
