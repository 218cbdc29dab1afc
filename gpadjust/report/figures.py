"""The figures of the page."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from gpadjust.kinds.categories import on_levels
from gpadjust.physics import PhysicsError
from gpadjust.report.markup import Markup, image, name_and_unit, number, with_unit
from gpadjust.report.subject import Subject
from gpadjust.validation.plots import (
    plot_adjustment,
    plot_coverage,
    plot_leave_one_out,
    plot_trust,
)
from gpadjust.validation.plots.drawing import (
    DOTS,
    GREY,
    RED,
    band,
    column,
    labels,
    mean_and_ends,
    tidy,
)
from gpadjust.validation.plots.predictions import plot_pit
from gpadjust.validation.trust import Trust

_MOST = 12  # inputs along which slices are drawn, in all outputs together
_WIDTH = 3.6  # inches: as wide as a column of the page, so that text has its size
_POINTS = 120  # of a curve
_STYLES = ("--", "-.", ":")


@torch.no_grad()
def inputs_drawn(subject: Subject) -> list[int]:
    """The inputs along which slices are drawn: all, or those that move the predictions most."""
    d, m = len(subject.inputs), len(subject.outputs)
    most = max(2, _MOST // m)
    if d <= most:
        return [*range(d)]
    spread = subject.Y.sub(subject.Y.nanmean(0)).square().nanmean(0).sqrt()
    effect = torch.zeros(d, dtype=torch.float64)
    for i in range(d):
        try:
            mean = subject.model.predict(_slice(subject, i, 21)).mean
        except PhysicsError:
            continue  # its figure will say so, if it is among them
        effect[i] = ((mean.amax(0) - mean.amin(0)) / spread.clamp_min(1e-300)).max()
    return sorted(effect.argsort(descending=True)[:most].tolist())


def slices(subject: Subject, output: int, inputs: list[int]) -> list[Markup]:
    """Along each input what is predicted, the physics, rho and delta, the others at the median."""
    shown = subject.adjusted[output]
    terms = () if shown is None else shown.terms
    d, rows = len(subject.inputs), 1 + len(terms)
    figures = _figures(d, 2.1 + 1.5 * len(terms))
    ratios = [1.4, *[1.0] * len(terms)]
    grids = [f.subplots(rows, sharex=True, squeeze=False, height_ratios=ratios) for f in figures]
    axes = np.hstack(grids)
    with torch.no_grad():
        for i in inputs:
            _prediction(subject, output, i, axes[0, i])
    low, high = zip(*(axes[0, i].get_ylim() for i in inputs), strict=True)
    for i in inputs:
        axes[0, i].set_ylim(min(low), max(high))
    if shown is not None and terms:
        plot_adjustment(shown.model, output=shown.output, axes=axes[1:], num_points=_POINTS)
        _without_legend(axes[1, 0])
        for i in range(1, d):
            for row, name in zip(axes[1:, i], axes[1:, 0], strict=True):
                row.set_ylabel(name.get_ylabel())
    else:
        for i, label in enumerate(labels(subject.model, "input", d)):
            axes[-1, i].set_xlabel(label)
    parts = "the prediction and the physics" if shown is not None else "the prediction"
    below = f"; below, {' and '.join(terms)}" if terms else ""
    return [
        image(figures[i], f"{parts} of {subject.outputs[output]} over {subject.inputs[i]}{below}")
        for i in inputs
    ]


def trusts(trusted: Trust, output: int, inputs: list[int], page_output: str) -> list[Markup]:
    """The basis of predictions along each input."""
    alt = f"whether the prediction of {page_output} rests on physics, data or neither"
    figures = _figures(len(trusted.input_names), 2.0)
    axes = [figure.subplots() for figure in figures]
    plot_trust(trusted, output=output, axes=axes)
    _without_legend(axes[-1])
    for ax in axes:
        ax.set_ylabel(axes[0].get_ylabel())
    return [image(figures[i], f"{alt}, over {trusted.input_names[i]}") for i in inputs]


def left_out(subject: Subject, output: int) -> list[Markup]:
    """Left-out predictions against observations, and their standardized residuals."""
    figures = _figures(2)
    plot_leave_one_out(subject.loo, output=output, axes=[f.subplots() for f in figures])
    name = subject.outputs[output]
    alts = (f"predictions of left-out {name} against observations", f"their residuals, of {name}")
    return [image(figure, alt) for figure, alt in zip(figures, alts, strict=True)]


def coverage(subject: Subject, output: int) -> list[Markup]:
    """Observed against nominal coverage, and the histogram of PIT values."""
    figures = _figures(2)
    plot_coverage(subject.loo, output=output, ax=figures[0].subplots())
    bins = max(4, min(10, subject.counts[output] // 4))
    plot_pit(subject.loo, output=output, bins=bins, ax=figures[1].subplots())
    name = subject.outputs[output]
    alts = (f"observed against nominal coverage of {name}", f"histogram of PIT values of {name}")
    return [image(figure, alt) for figure, alt in zip(figures, alts, strict=True)]


def held(subject: Subject, inputs: list[int]) -> str:
    """At what the other inputs stay."""
    if len(subject.inputs) == 1:
        return ""
    values = zip(subject.inputs, point(subject, subject.base, 3), strict=True)
    pairs = [f"{name_and_unit(name)[0]} = {with_unit(value, name)}" for name, value in values]
    drawn_of = f" (drawn: {len(inputs)} of {len(pairs)} inputs, those that move predictions most)"
    few = drawn_of if len(inputs) < len(pairs) else ""
    return f"Along each input the others stay at the median of the data: {', '.join(pairs)}{few}."


def point(subject: Subject, X: Tensor, digits: int = 4) -> list[str]:
    """The inputs of a point, ``d``, in words: numbers, and the names of categories."""
    names, values = subject.names, enumerate(X.tolist())
    return [names[i][int(x)] if i in names else number(x, digits) for i, x in values]


def _figures(number_of_figures: int, height: float = 2.9) -> list[Figure]:
    size = (_WIDTH, height)  # in inches
    return [Figure(figsize=size, layout="constrained") for _ in range(number_of_figures)]


def _slice(subject: Subject, i: int, number_of_points: int) -> Tensor:
    low, high = subject.X[:, i].min(), subject.X[:, i].max()
    pad = 0.5 * low.abs().clamp_min(1.0) if low == high else torch.zeros_like(low)
    X = subject.base.repeat(number_of_points, 1)
    X[:, i] = torch.linspace(float(low - pad), float(high + pad), number_of_points, dtype=X.dtype)
    return on_levels(subject.model, X)


def _prediction(subject: Subject, output: int, i: int, ax: Any) -> None:
    X = _slice(subject, i, _POINTS)
    x = X[:, i]
    band(ax, x, *mean_and_ends(subject.model.marginals(X), output, 0.95), 0.95)
    curves = subject.physics_at(X, output)
    for k, (name, values) in enumerate(curves.items()):
        ax.plot(x, values, color=GREY, ls=_STYLES[k % 3], lw=1.2, label=name)
    if len(subject.inputs) == 1:
        ax.plot(subject.X[:, 0], column(subject.Y, output), color=RED, **DOTS)
    ax.set_ylabel(labels(subject.model, "output", len(subject.outputs))[output])
    ax.set_xlim(float(x[0]), float(x[-1]))
    if len(curves) > 1:
        ax.legend(frameon=False)
    tidy(ax)


def _without_legend(ax: Any) -> None:
    """The page says what is drawn, once for all figures."""
    if ax.get_legend() is not None:
        ax.get_legend().remove()
