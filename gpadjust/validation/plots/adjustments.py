"""Figures of rho and delta: where is the physics wrong?"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.validation.leave_one_out import training_data
from gpadjust.validation.plots.drawing import (
    GREY,
    RED,
    band,
    given_axes,
    mean_and_half_width,
    new_axes,
    tidy,
)

_SYMBOLS = {"rho": r"$\rho$", "delta": r"$\delta$"}
_UNADJUSTED = {"rho": 1.0, "delta": 0.0}


def plot_adjustment(
    model: Any,
    *,
    bounds: Tensor | None = None,
    base: Tensor | None = None,
    output: int = 0,
    level: float = 0.95,
    num_points: int = 200,
    axes: Any = None,
) -> Any:
    r"""Draw :math:`\rho` and :math:`\delta` with their intervals: where is the physics wrong?

    One row for each that the model has, one column for each input, along which the others stay at
    a base point. The dashed line is the physics as it is, :math:`\rho = 1` and
    :math:`\delta = 0`; ticks at the bottom are the training inputs.

    Args:
        model: A model with ``rho`` or ``delta``.
        bounds: Range of the inputs, ``2 x d``. Default: that of the training inputs.
        base: The base point, ``d``. Default: the median of the training inputs.
        output: Which output to draw.
        level: Nominal coverage of the intervals.
        num_points: Number of points of each curve.
        axes: Axes to draw on. Default: a new figure.

    Returns:
        An array of axes, ``rows x d``.

    Raises:
        TypeError: If the model has neither rho nor delta.
        ValueError: If ``bounds`` or ``base`` have the wrong shape, or there is no such output.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> plot_adjustment(model).shape
        (2, 1)
    """
    names = _adjustments(model)
    train_X, bounds, base = _domain(model, bounds, base)
    d = train_X.shape[-1]
    shape = (len(names), d)
    axes = new_axes(*shape, size=2.6) if axes is None else given_axes(axes, shape)
    for i in range(d):
        x = torch.linspace(bounds[0, i].item(), bounds[1, i].item(), num_points).to(base)
        X = base.repeat(num_points, 1)
        X[:, i] = x
        for ax, name in zip(axes[:, i], names, strict=True):
            with torch.no_grad():
                mean, half = mean_and_half_width(getattr(model, name)(X), output, level)
            ax.axhline(_UNADJUSTED[name], color=GREY, lw=1, ls="--")
            band(ax, x, mean, half, level)
            bottom = ax.get_xaxis_transform()
            ax.plot(train_X[:, i], torch.zeros(len(train_X)), "|", color=RED, transform=bottom)
            ax.set_xlim(bounds[0, i].item(), bounds[1, i].item())
            tidy(ax)
        axes[-1, i].set_xlabel("x" if d == 1 else f"$x_{{{i + 1}}}$")
    for row, name in zip(axes, names, strict=True):
        low, high = zip(*(ax.get_ylim() for ax in row), strict=True)
        for ax in row:  # slices of one function are compared by eye
            ax.set_ylim(min(low), max(high))
        row[0].set_ylabel(_SYMBOLS[name])
    axes[0, 0].legend(frameon=False)
    return axes


def plot_adjustment_pair(
    model: Any,
    inputs: tuple[int, int] = (0, 1),
    *,
    bounds: Tensor | None = None,
    base: Tensor | None = None,
    output: int = 0,
    num_points: int = 40,
    axes: Any = None,
) -> Any:
    r"""Draw the mean and the sd of :math:`\rho` and :math:`\delta` over two inputs, as contours.

    Args:
        model: A model with ``rho`` or ``delta``.
        inputs: The two inputs, counted from 0; the others stay at the base point.
        bounds: As in :func:`plot_adjustment`.
        base: As in :func:`plot_adjustment`.
        output: Which output to draw.
        num_points: Number of points along each input.
        axes: Axes to draw on. Default: a new figure.

    Returns:
        An array of axes, ``rows x 2``: mean and sd.

    Raises:
        TypeError: If the model has neither rho nor delta.
        ValueError: As :func:`plot_adjustment`, and if ``inputs`` are not two of the model's.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> X = torch.rand(9, 2, dtype=torch.float64)
        >>> model = CKA(X, X.prod(-1, keepdim=True), physics=lambda X: X[..., :1])
        >>> plot_adjustment_pair(model, num_points=5).shape
        (2, 2)
    """
    names = _adjustments(model)
    train_X, bounds, base = _domain(model, bounds, base)
    d = train_X.shape[-1]
    i, j = inputs
    if i == j or not (0 <= i < d and 0 <= j < d):
        raise ValueError(f"Expected two different inputs from 0 to {d - 1}, got {inputs}.")
    shape = (len(names), 2)
    axes = new_axes(*shape) if axes is None else given_axes(axes, shape)
    lines = [torch.linspace(bounds[0, k].item(), bounds[1, k].item(), num_points) for k in (i, j)]
    grid = torch.meshgrid(*(line.to(base) for line in lines), indexing="xy")
    X = base.repeat(num_points**2, 1)
    X[:, i], X[:, j] = grid[0].flatten(), grid[1].flatten()
    for row, name in zip(axes, names, strict=True):
        with torch.no_grad():
            one_sd = 0.6826894921370859
            mean, sd = mean_and_half_width(getattr(model, name)(X), output, one_sd)
        for ax, values, title, colors in zip(
            row, (mean, sd), ("mean", "sd"), ("viridis", "cividis"), strict=True
        ):
            contour = ax.contourf(*grid, values.reshape(grid[0].shape), levels=12, cmap=colors)
            ax.figure.colorbar(contour, ax=ax)
            ax.plot(train_X[:, i], train_X[:, j], "o", color=RED, ms=4, mec="white", mew=0.6)
            ax.set(title=f"{title} of {_SYMBOLS[name]}", xlabel=f"$x_{{{i + 1}}}$")
            ax.set(ylabel=f"$x_{{{j + 1}}}$", xlim=bounds[:, i], ylim=bounds[:, j])
    return axes


def _adjustments(model: Any) -> list[str]:
    names = [name for name in _SYMBOLS if callable(getattr(model, name, None))]
    if not names:
        raise TypeError(
            f"{type(model).__name__} has neither rho nor delta to draw; CKA, RRA, ScaleGP and "
            "BiasGP have."
        )
    return names


def _domain(
    model: Any, bounds: Tensor | None, base: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Training inputs, the range to draw, and the base point."""
    train_X, _ = training_data(model)
    d = train_X.shape[-1]
    if bounds is None:
        lower, upper = train_X.min(0).values, train_X.max(0).values
        # An input that never changed is drawn around its value.
        pad = torch.where(lower == upper, 0.5 * lower.abs().clamp_min(1.0), torch.zeros_like(lower))
        bounds = torch.stack([lower - pad, upper + pad])
    if base is None:
        base = train_X.median(0).values
    if bounds.shape != (2, d) or not (bounds[0] < bounds[1]).all():
        raise ValueError(
            f"Expected bounds of shape (2, {d}), lower below upper, got {bounds.tolist()}."
        )
    if base.shape != (d,):
        raise ValueError(f"Expected a base point of {d} inputs, got shape {tuple(base.shape)}.")
    return train_X, bounds, base.to(train_X)
