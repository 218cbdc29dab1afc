"""The figure of a collection; it needs matplotlib, ``pip install gpadjust[plot]``."""

from __future__ import annotations

import math
from typing import Any

import matplotlib.pyplot as plt
import torch

from gpadjust.active.collection import Collection
from gpadjust.validation.plots import BLUE, DOTS, GREY, RED, given_axes, labels, legend, tidy

__all__ = ["plot_collection"]


def plot_collection(collection: Collection, *, axes: Any = None) -> Any:
    """Draw the inputs and outputs of measurements in their order, and the best outputs so far.

    Dots are measurements, hollow dots pending points; failed measurements are not drawn.

    Args:
        collection: The collection.
        axes: An axis for each input and output, returned. Default: a new figure.
    """
    X, Y, pending = collection.X, collection.Y, collection.pending
    n, d, m = len(X), X.shape[-1], Y.shape[-1]
    if axes is None:
        figure = plt.figure(figsize=(6, 1.6 * (d + m)), layout="constrained")
        axes = figure.subplots(d + m, 1, sharex=True, squeeze=False)
    axes = given_axes(axes, (d + m,))
    # Inputs first, with their bounds and pending points.
    numbers = torch.arange(1, n + len(pending) + 1)
    for i, ax in enumerate(axes[:d]):
        for bound in collection.bounds[:, i].tolist():
            ax.axhline(bound, color=GREY, lw=0.8, ls=":")
        ax.plot(numbers[:n], X[:, i], color=BLUE, **DOTS)
        ax.plot(numbers[n:], pending[:, i], color=BLUE, **DOTS | {"mfc": "none", "mec": BLUE})
    for values, ax in zip(Y.mT, axes[d:], strict=True):
        # A missing output is neither the lowest nor the highest.
        lowest = values.nan_to_num(nan=math.inf).cummin(0).values
        highest = values.nan_to_num(nan=-math.inf).cummax(0).values
        ax.plot(numbers[:n], values, color=GREY, **DOTS)
        for curve, color, label in ((highest, RED, "highest"), (lowest, BLUE, "lowest")):
            ax.step(numbers[:n], curve, where="post", color=color, label=f"{label} so far")
    names = [*labels([f"x{i + 1}" for i in range(d)]), *labels([f"y{j + 1}" for j in range(m)])]
    for ax, label in zip(axes, names, strict=True):
        ax.set_ylabel(label)
        tidy(ax)
    if m:
        legend(axes[d])
    axes[-1].set_xlabel("measurement")
    return axes
