"""Figures of what predictions rest on: the physics, the data, or neither."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.validation.plots.drawing import (
    BLUE,
    RED,
    column,
    given_axes,
    labels,
    new_axes,
    tidy,
    two_inputs,
)
from gpadjust.validation.trust import SIDES, Trust

_COLORS = dict(zip(SIDES, (BLUE, RED, "0.85"), strict=True))


def plot_trust(trust: Trust, *, output: int = 0, bins: int = 10, axes: Any = None) -> Any:
    """Draw along each input which share of the predictions rests on physics, data, or neither.

    The shares of all points are in the legend.

    Args:
        trust: What :func:`~gpadjust.validation.trust` returned.
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
    axes = new_axes(1, d)[0] if axes is None else given_axes(axes, (d,))
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


def plot_trust_pair(
    trust: Trust, inputs: tuple[int, int] = (0, 1), *, output: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw over two inputs which predictions rest on physics, data, or neither, as points.

    Args:
        trust: What :func:`~gpadjust.validation.trust` returned.
        inputs: The two inputs, counted from 0.
        output: Which output to draw.
        ax: Where to draw. Default: a new figure.

    Raises:
        TypeError: As :func:`plot_trust`.
        ValueError: If there is no such output, or ``inputs`` are not two of the model's.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.validation import trust
        >>> X = torch.rand(9, 2, dtype=torch.float64)
        >>> model = CKA(X, X.prod(-1, keepdim=True), physics=lambda X: X[..., :1])
        >>> plot_trust_pair(trust(model)).get_xlabel()
        '$x_{1}$'
    """
    side, named = _side_and_names(trust, output)
    d = trust.X.shape[-1]
    i, j = two_inputs(inputs, d, "`plot_trust`")
    ax = (new_axes(1, 1, size=4) if ax is None else given_axes(ax, (1, 1)))[0, 0]
    for k, kind in enumerate(SIDES):
        points = trust.X[side == k]
        style: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4, "mew": 0}
        ax.plot(points[:, i], points[:, j], color=_COLORS[kind], **style, label=named[kind])
    names = labels(trust, "input", d)
    ax.set(xlabel=names[i], ylabel=names[j])
    _legend(ax, trust, output)
    tidy(ax)
    return ax


def _side_and_names(trust: Trust, output: int) -> tuple[Tensor, dict[str, str]]:
    """What each prediction of an output rests on, and what the legend says of the shares."""
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
