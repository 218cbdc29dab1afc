"""Plots of rho and delta, and of the basis of predictions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from torch import Tensor

from gpadjust.checks import checked_bounds, checked_tensor, checked_whole
from gpadjust.kinds.categories import on_levels
from gpadjust.validation.leave_one_out import observations
from gpadjust.validation.plots.drawing import (
    BLUE,
    GREY,
    RED,
    axes_of,
    band,
    column,
    labels,
    mean_and_ends,
    quantile,
    tidy,
)
from gpadjust.validation.trust import SIDES, Trust


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

    One row for each that the model has (a rho for each of several physics), one column for each
    input, along which the others stay at a base point. The dashed line is what the model falls
    back to far from data, such as the physics as it is, :math:`\rho = 1` and
    :math:`\delta = 0`; ticks at the bottom are the training inputs at which the output was
    observed.

    Args:
        model: A model with ``rho`` or ``delta``.
        bounds: Range of the inputs, ``2 x d``, a tensor or lists. Default: that of the training
            inputs.
        base: The base point, ``d``, a tensor or a list. Default: the median of the training inputs.
        output: Which output to draw.
        level: Nominal coverage of the intervals.
        num_points: Number of points of each curve.
        axes: Axes to draw on. Default: a new figure.

    Returns:
        An array of axes, ``rows x d``.

    Raises:
        TypeError: If the model has neither rho nor delta, or ``bounds``, ``base`` or ``level`` are
            no numbers.
        ValueError: If ``bounds``, ``base`` or ``axes`` have the wrong shape, there is no such
            output, ``level`` is not between 0 and 1, or ``num_points`` is below 2.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> plot_adjustment(model).shape
        (2, 1)
    """
    names = _adjustments(model)
    num_points = checked_whole("num_points", num_points, 2)
    quantile(level)  # refused before there is a figure
    train_X, bounds, base, suffix = domain(model, bounds, base, output)
    d = train_X.shape[-1]
    axes = axes_of(axes, len(names), d, 2.6)
    for i, label in enumerate(labels(model, "input", d)):
        x = torch.linspace(bounds[0, i], bounds[1, i], num_points, dtype=base.dtype)
        X = base.repeat(num_points, 1)
        X[:, i] = x
        X = on_levels(model, X)
        for ax, name in zip(axes[:, i], names, strict=True):
            with torch.no_grad():
                drawn = mean_and_ends(model.term(name, X), output, level)
            ax.axhline(unadjusted(model, name), color=GREY, lw=1, ls="--")
            band(ax, x, *drawn, level)
            bottom = ax.get_xaxis_transform()
            ax.plot(train_X[:, i], torch.zeros(len(train_X)), "|", color=RED, transform=bottom)
            ax.set_xlim(*bounds[:, i].tolist())
            tidy(ax)
        axes[-1, i].set_xlabel(label)
    for row, name in zip(axes, names, strict=True):
        low, high = zip(*(ax.get_ylim() for ax in row), strict=True)
        for ax in row:  # slices of one function are compared by eye
            ax.set_ylim(min(low), max(high))
        row[0].set_ylabel(_symbol(name) + suffix)
    axes[0, 0].legend(frameon=False)
    return axes


def adjustments_of(model: Any) -> list[str]:
    """Return the names of the rhos and deltas of a model that vary, if it has a physics."""
    terms = model.terms if getattr(model, "physics", None) else ()
    return [t.name for t in terms if t.varies and t.name not in model.data.input_names]


def _adjustments(model: Any) -> list[str]:
    """Return the names of the rhos and deltas of a model, one at least."""
    names = adjustments_of(model)
    if not names:
        raise TypeError(
            "Expected a model with rho or delta to draw, such as CKA, RRA, ScaleGP and "
            f"PhysicsMeanGP; found {type(model).__name__}."
        )
    return names


def unadjusted(model: Any, name: str) -> float:
    """Return the value of a rho or a delta away from data."""
    return float(next(term.mean for term in model.terms if term.name == name))


def _symbol(name: str) -> str:
    """Return the symbols of ``rho``, ``rho_coarse`` and ``delta``."""
    symbol, _, physics = name.partition("_")
    if symbol not in ("rho", "delta"):
        return name
    return rf"$\{symbol}$" + (f" of {physics}" if physics else "")


def domain(model: Any, bounds: Any, base: Any, output: int) -> tuple[Tensor, Tensor, Tensor, str]:
    """Return inputs at which the output was observed, the range, the base point, and a label."""
    X, Y = observations(model)
    d, num_outputs = X.shape[-1], Y.shape[-1]
    seen = ~column(Y, output).isnan()
    if bounds is None:
        lower, upper = X.min(0).values, X.max(0).values
        # An input that never changed is drawn around its value.
        pad = torch.where(lower == upper, 0.5 * lower.abs().clamp_min(1.0), torch.zeros_like(lower))
        bounds = torch.stack([lower - pad, upper + pad])
    bounds = checked_bounds("bounds", bounds, d).to(X)
    base = X.median(0).values if base is None else checked_tensor("base", base).to(X)
    if base.shape != (d,) or not base.isfinite().all():
        raise ValueError(f"Expected a base point of {d} inputs, finite, got {base.tolist()}.")
    suffix = f"\nfor {labels(model, 'output', num_outputs)[output]}" if num_outputs > 1 else ""
    return X[seen], bounds, base, suffix


_COLORS = dict(zip(SIDES, (BLUE, RED, "0.85"), strict=True))


def plot_trust(trust: Trust, *, output: int = 0, bins: int = 10, axes: Any = None) -> Any:
    """Draw along each input which share of the predictions rests on physics, data, or neither.

    The shares of all points are in the legend.

    Args:
        trust: The result of :func:`~gpadjust.validation.trust`.
        output: Which output to draw.
        bins: Number of parts of each input's range.
        axes: Axes to draw on. Default: a new figure.

    Returns:
        An array of ``d`` axes.

    Raises:
        TypeError: If ``trust`` is something else, as a model.
        ValueError: If there is no such output, ``bins`` is not a positive whole number, or ``axes``
            are not as many as the inputs.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.validation import trust
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> plot_trust(trust(model)).shape
        (1,)
    """
    side, named = _side_and_names(trust, output)
    bins = checked_whole("bins", bins, 1)
    d = trust.X.shape[-1]
    axes = axes_of(axes, 1, d)[0]
    for ax, x, name in zip(axes, trust.X.unbind(-1), labels(trust, "input", d), strict=True):
        edges = np.histogram_bin_edges(x.numpy(), bins)
        counts = np.stack([np.histogram(x[side == i].numpy(), edges)[0] for i in range(3)])
        shares = counts / counts.sum(0).clip(1)
        bottom = np.zeros(bins)
        for share, kind in zip(shares, SIDES, strict=True):
            bar: dict[str, Any] = {"width": np.diff(edges), "align": "edge", "color": _COLORS[kind]}
            ax.bar(edges[:-1], share, bottom=bottom, **bar, label=named[kind])
            bottom += share
        ax.set(xlabel=name, xlim=(edges[0], edges[-1]), ylim=(0, 1))
        tidy(ax)
    axes[0].set_ylabel("share of predictions")
    _legend(axes[-1], trust, output)
    return axes


def _side_and_names(trust: Trust, output: int) -> tuple[Tensor, dict[str, str]]:
    """Return the basis of each prediction of an output, and the legend's text of the shares."""
    if not isinstance(trust, Trust):
        raise TypeError(f"Expected a Trust, got {type(trust).__name__}; pass `trust(model)`.")
    side = column(trust.side, output)
    return side, {k: f"{k}: {100 * getattr(trust, k)[output].item():.0f} %" for k in SIDES}


def _legend(ax: Axes, trust: Trust, output: int) -> None:
    """Add a legend beside the axes, as there is no free place inside."""
    m = trust.override.shape[-1]
    which = f"{labels(trust, 'output', m)[output]} rests on" if m > 1 else "rests on"
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
    ax.legend(frameon=False, title=which, alignment="left", **place)
