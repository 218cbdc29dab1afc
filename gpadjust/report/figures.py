"""Sections with figures of a page: where the physics is wrong, and where predictions rest on it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.physics import PhysicsError
from gpadjust.report import markup as html
from gpadjust.report.markup import Markup, drawn, image, tag
from gpadjust.report.subject import Subject
from gpadjust.validation import Trust, plots, trust
from gpadjust.validation.plots import (
    adjustments_of,
    labels,
    lines_along,
    share_limits,
    unadjusted,
)
from gpadjust.validation.trust import physics_at
from gpadjust.words import bare, listed, number, percent, with_unit

_MOST = 12  # inputs along which slices are drawn, in all outputs together
_BANDS = "Solid lines are means; bands hold 95 % of the function, without measurement noise."
_APART = (
    "Observations are of rho f_p + delta alone: how much of it is rho's and how much delta's the "
    "data tell far less surely than their sum."
)
_NONE = "There is no physics that could be adjusted, trusted or overridden."
_TRUST = (
    "Of {} points spread over the box of the data: the share at which the prediction rests on the "
    "physics (its interval holds f_p, and is narrower than the discrepancies that were seen), on "
    "the data (its interval excludes f_p: the model is sure that the physics is wrong there), or "
    "on neither (too few data to tell)."
)
_COLORS = "blue where it rests on the physics, orange on the data, grey on neither"


def where_wrong(subject: Subject) -> Markup:
    """Return the prediction beside the physics, rho and delta, for each output."""
    inputs = inputs_drawn(subject)
    parts: list[Markup] = []
    if len(subject.inputs) > 1:
        values = zip(subject.inputs, point(subject, subject.base, 3), strict=True)
        pairs = [f"{bare(name)} = {with_unit(value, name)}" for name, value in values]
        few = f" (drawn: {len(inputs)} of {len(pairs)} inputs, those that move predictions most)"
        held = f"Along each input the others stay at the median of the data: {', '.join(pairs)}"
        parts.append(tag("p", f"{held}{few * (len(inputs) < len(pairs))}.", class_="note"))
    for j, name in enumerate(subject.outputs):
        parts += [tag("h3", name)] * (len(subject.outputs) > 1)
        parts += [tag("p", " ".join(_words(subject, j))), slices(subject, j, inputs)]
    return html.join(parts)


def trusted(subject: Subject) -> Markup:
    """Return the shares of predictions that rest on the physics, on data, or on neither."""
    rows, failed, images = [], [], []
    inputs, points = inputs_drawn(subject), 0
    for j, (name, shown) in enumerate(zip(subject.outputs, subject.adjusted, strict=True)):
        if shown is None:
            continue
        try:
            basis = trust(shown.model)
        except PhysicsError as error:
            failed.append(tag("p", f"{name}: {html.failure(error)}", class_="caution"))
            continue
        shares = (basis.physics, basis.data, basis.neither)
        rows.append([name, shown.structure, *(percent(share[j]) for share in shares)])
        images.append(trusts(basis, j, inputs, name))
        points = len(basis.X)
    if not rows:
        return html.join(failed or [tag("p", _NONE)])
    several = "Along each input, for all values of the others"
    over = several if len(subject.inputs) > 1 else "Along the input"
    head = ["output", "by the model", "physics", "data", "neither"]
    shares_of = html.table("Basis of the predictions", head, rows)
    words = tag("p", _TRUST.format(f"{points:,}"))
    return html.join(
        [*failed, words, shares_of, *images, tag("p", f"{over}: {_COLORS}.", class_="note")]
    )


@torch.no_grad()
def inputs_drawn(subject: Subject) -> list[int]:
    """Return the inputs along which slices are drawn: those that move the predictions most."""
    d, m = len(subject.inputs), len(subject.outputs)
    most = max(2, _MOST // m)
    if d <= most:
        return [*range(d)]
    spread = subject.Y.sub(subject.Y.nanmean(0)).square().nanmean(0).sqrt()
    effect = torch.zeros(d, dtype=torch.float64)
    for i, (_, X) in enumerate(lines_along(subject.model, base=subject.base)):
        try:
            mean = subject.model.predict(X).mean
        except PhysicsError:
            continue  # its figure will say so, if it is among them
        effect[i] = ((mean.amax(0) - mean.amin(0)) / spread.clamp_min(1e-300)).max()
    return sorted(effect.argsort(descending=True)[:most].tolist())


def point(subject: Subject, X: Tensor, digits: int = 4) -> list[str]:
    """Return the inputs of a point, ``d``, in words: numbers, and the names of categories."""
    names, values = subject.levels, enumerate(X.tolist())
    return [names[i][int(x)] if i in names else number(x, digits) for i, x in values]


@drawn
def slices(subject: Subject, output: int, inputs: list[int]) -> list[Markup]:
    """Return the prediction, the physics, rho and delta along each input, others at the median."""
    shown = subject.adjusted[output]
    terms = () if shown is None else adjustments_of(shown.model)
    d, rows = len(subject.inputs), 1 + len(terms)
    figures = [html.new_figure(2.1 + 1.5 * len(terms)) for _ in range(d)]
    ratios = [1.4, *[1.0] * len(terms)]
    grids = [f.subplots(rows, sharex=True, squeeze=False, height_ratios=ratios) for f in figures]
    axes = np.hstack(grids)
    lines = lines_along(subject.model, output, base=subject.base)
    for i in inputs:
        (x, X), ax = lines[i], axes[0, i]
        physics = {} if shown is None else physics_at(shown.model, X)
        plots.draw_prediction(ax, subject.model, x, X, output, physics)
        if d == 1:
            plots.draw_data(ax, subject.model, output)
        if len(physics) > 1:
            ax.legend(frameon=False)
        ax.set_ylabel(labels(subject.outputs)[output])
    share_limits([axes[0, i] for i in inputs])
    if shown is not None and terms:
        plots.plot_adjustment(shown.model, base=subject.base, output=output, axes=axes[1:])
        _name_alike(axes[1:])
    else:
        for ax, label in zip(axes[-1], labels(subject.inputs), strict=True):
            ax.set_xlabel(label)
    parts = "the prediction and the physics" if shown is not None else "the prediction"
    below = f"; below, {' and '.join(terms)}" if terms else ""
    alt = f"{parts} of {subject.outputs[output]} over {{}}{below}".format
    return [image(figures[i], alt(subject.inputs[i])) for i in inputs]


@drawn
def trusts(basis: Trust, output: int, inputs: list[int], name: str) -> list[Markup]:
    """Return the basis of predictions of an output of a model, by its name, along each input."""
    figures = [html.new_figure(2.0) for _ in basis.input_names]
    axes = np.array([[figure.subplots() for figure in figures]])
    plots.plot_trust(basis, output=output, axes=[*axes[0]])
    if (legend := axes[0, -1].get_legend()) is not None:
        legend.remove()
    _name_alike(axes)
    alt = f"whether the prediction of {name} rests on physics, data or neither"
    return [image(figures[i], f"{alt}, over {basis.input_names[i]}") for i in inputs]


@drawn
def left_out(subject: Subject, output: int) -> list[Markup]:
    """Return left-out predictions against observations, and their standardized residuals."""
    figures = [html.new_figure(2.9), html.new_figure(2.9)]
    plots.plot_leave_one_out(subject.loo, output=output, axes=[f.subplots() for f in figures])
    name = subject.outputs[output]
    first = image(figures[0], f"predictions of left-out {name} against observations")
    return [first, image(figures[1], f"their residuals, of {name}")]


@drawn
def coverages(subject: Subject, output: int) -> list[Markup]:
    """Return observed against nominal coverage, and the histogram of PIT values."""
    figures = [html.new_figure(2.9), html.new_figure(2.9)]
    plots.plot_coverage(subject.loo, output=output, ax=figures[0].subplots())
    plots.plot_pit(subject.loo, output=output, ax=figures[1].subplots())
    name = subject.outputs[output]
    first = image(figures[0], f"observed against nominal coverage of {name}")
    return [first, image(figures[1], f"histogram of PIT values of {name}")]


def _name_alike(axes: Any) -> None:
    """Give each figure the labels of the first; the page says what is drawn, once for all."""
    if (legend := axes[0, 0].get_legend()) is not None:
        legend.remove()
    for row in axes:
        for ax in row:
            ax.set_ylabel(row[0].get_ylabel())


def _words(subject: Subject, output: int) -> list[str]:
    """Return the words above the figures of an output."""
    shown, name = subject.adjusted[output], subject.outputs[output]
    if shown is None:
        return [f"{_NONE} The figures show the prediction. {_BANDS}"]
    words = []
    has_unknowns = any(physics.unknowns for physics in subject.physics.values())
    is_it = "with fitted parameters" if has_unknowns else "as it is"
    for physics, values in subject.physics_at(subject.X, output).items():
        off = subject.judged[:, output] - values
        rms, mean = number(off.square().nanmean().sqrt()), number(off.nanmean())
        words.append(
            f"At the data, the {physics} ({is_it}) is off by {with_unit(rms, name)} (root "
            f"mean square; observed less physics is {with_unit(mean, name)} in the mean)."
        )
    top = "the prediction, and dashed the physics"
    if subject.comparison is not None:
        top = "the prediction of what is recommended, and dashed the physics"
    words.append(f"Topmost: {top}{', with the data' * (len(subject.inputs) == 1)}.")
    if terms := adjustments_of(shown.model):
        weight = "" if shown.weight == 1 else f" (weight {shown.weight:.2f})"
        back = [f"{term} = {number(unadjusted(shown.model, term))}" for term in terms]
        words.append(
            f"Below: {listed(terms)} of {shown.structure}{weight}, with ticks at the data; "
            f"dashed, what they fall back to without data, {listed(back)}."
        )
        words += [_APART] * (len(terms) > 1)
    return [*words, _BANDS]
