"""Sections with figures of a page: where the physics is wrong, and where predictions rest on it."""

from __future__ import annotations

from contextlib import suppress
from itertools import combinations

import torch
from torch import Tensor

from gpadjust.physics import PhysicsError, PhysicsParameters
from gpadjust.report import markup as html
from gpadjust.report.markup import Markup, drawn, image, tag
from gpadjust.report.subject import Subject
from gpadjust.validation import plots, trust
from gpadjust.validation.plots import (
    BLUE,
    DOTS,
    GREY,
    RED,
    band,
    labels,
    legend,
    lines_along,
    mean_and_ends,
    tidy,
)
from gpadjust.validation.trust import SIDES
from gpadjust.validation.verdict import has_one_sign, named_point
from gpadjust.words import labelled, name_and_unit, noted, number, percent, with_unit

_CORRELATED = 0.7  # absolute correlation of parameters whose pair is drawn
_MOST = 12  # inputs along which slices are drawn, in all outputs together
_BANDS = "Solid lines are means; bands cover 95 % of the function, without measurement noise."
_NONE = "This model has no formula to adjust or to trust."
_TRUST = (
    "Shares of {} points in the range of the data at which the prediction rests on the formula "
    "(its interval covers the formula, and is narrower than errors of the formula at the data), "
    "on the data (its interval excludes the formula), or on neither (there are too few data to "
    "decide)."
)


def where_wrong(subject: Subject) -> Markup:
    """Return the correction of the physics along each input, for each output."""
    inputs = inputs_drawn(subject)
    parts: list[Markup] = []
    if len(subject.inputs) > 1:
        pairs = named_point(subject.inputs, subject.base, subject.levels)
        others = f"Along each input the others stay at the median of the data: {', '.join(pairs)}"
        if len(inputs) < len(pairs):
            few = f"drawn: {len(inputs)} of {len(pairs)} inputs, those that move predictions most"
            others = noted(others, few)
        parts.append(tag("p", f"{others}.", class_="note"))
    for j, name in enumerate(subject.outputs):
        if len(subject.outputs) > 1:  # the title has a single one
            parts.append(tag("h3", name))
        parts += [tag("p", " ".join(_words(subject, j))), corrections(subject, j, inputs)]
    return html.join(parts)


def trusted(subject: Subject) -> Markup:
    """Return the shares of predictions that rest on the physics, on data, or on neither."""
    rows, failures, points = [], [], 0
    for j, (name, shown) in enumerate(zip(subject.outputs, subject.adjusted, strict=True)):
        if shown is None:
            continue
        try:
            basis = trust(shown.model)
        except PhysicsError as error:  # at some of these points
            failures.append(tag("p", f"{name}: {html.failure(error)}", class_="caution"))
            continue
        points = len(basis.X)  # of Sobol's sequence, for each output the same
        shares = [percent(getattr(basis, side)[j]) for side in SIDES]
        rows.append([name, shown.structure, *shares])
    if not rows:
        return html.join(failures or [tag("p", _NONE)])
    head = ["output", "by the model", "formula", "data", "neither"]
    table = html.table("Basis of the predictions", head, rows)
    return html.join([*failures, tag("p", _TRUST.format(f"{points:,}")), table])


@torch.no_grad()
def inputs_drawn(subject: Subject) -> list[int]:
    """Return the inputs along which slices are drawn: those that move the predictions most."""
    most = max(2, _MOST // len(subject.outputs))
    if len(subject.inputs) <= most:
        return [*range(len(subject.inputs))]
    spread = subject.Y.sub(subject.Y.nanmean(0)).square().nanmean(0).sqrt().clamp_min(1e-300)
    effects = []
    for _, X in lines_along(subject.model, base=subject.base):
        effects.append(0.0)
        with suppress(PhysicsError):  # its figure reports it, if it is among them
            mean = subject.model.predict(X).mean
            effects[-1] = float(((mean.amax(0) - mean.amin(0)) / spread).max())
    return sorted(sorted(range(len(effects)), key=lambda i: -effects[i])[:most])


@drawn
def agreement(subject: Subject, output: int) -> list[Markup]:
    """Return observations over left-out predictions, by the formula and corrected."""
    formulas = [*subject.physics_at(subject.X, output).values()]
    first = {"your formula": formulas[0]} if formulas else {}
    figure = html.new_figure(3.2)
    y = subject.loo.judged[:, output]
    legend(plots.draw_left_out(figure.subplots(), subject.loo, y, output, first))
    alt = f"measured over predicted {subject.outputs[output]}, by the formula and corrected"
    return [image(figure, alt)]


@drawn
def corrections(subject: Subject, output: int, inputs: list[int]) -> list[Markup]:
    """Return the correction of the formula along each input, with the data as dots.

    It is what the prediction adds to the physics, in per cent of it, or in the output's unit where
    the physics changes sign. Without a single physics it is the prediction itself.
    """
    name = subject.outputs[output]
    y = subject.loo.judged[:, output]
    at_data = [*subject.physics_at(subject.X, output).values()]
    is_correction = len(at_data) == 1
    is_share = is_correction and has_one_sign(at_data[0])
    label = labels(subject.outputs)[output]
    unit = ""  # the label has it
    if is_correction:
        label = "correction"
        unit = name_and_unit(name)[1]
    if is_share:
        unit = "%"

    def relative(values: Tensor, f: Tensor) -> Tensor:
        # y - f, or 100 (y - f) / |f| in per cent
        return (values - f) * (100 / f.abs()) if is_share else values - f

    images = []
    lines = lines_along(subject.model, output, base=subject.base)
    for i in inputs:
        x, X = lines[i]
        figure = html.new_figure(2.4)
        ax = figure.subplots()
        # The prediction less the formula along the line, and the data less the formula at them.
        ends = mean_and_ends(subject.model.marginals(X), output, 0.95)
        dots = y
        if is_correction:
            (f,) = subject.physics_at(X, output).values()
            ends = tuple(relative(values, f) for values in ends)
            dots = relative(y, at_data[0])
            ax.axhline(0, color=GREY, ls="--", lw=1.2)
        band(ax, x, ends, 0.95)
        ax.plot(subject.X[:, i], dots, color=RED, **DOTS | {"ms": 3})
        visible = [ends[0], dots[~dots.isnan()]]
        if is_correction:
            visible.append(x.new_zeros(1))  # the dashed line
        ax.set_ylim(*_limits(torch.cat(visible)))
        room = 0.03 * float(x[-1] - x[0])  # for complete dots at the ends
        ax.set(xlim=(float(x[0]) - room, float(x[-1]) + room), xlabel=labels(subject.inputs)[i])
        ax.set_ylabel(labelled(label, unit))
        tidy(ax)
        images.append(image(figure, f"{label} of {name} over {subject.inputs[i]}, with the data"))
    return images


def _limits(values: Tensor) -> tuple[float, float]:
    """Return limits of an axis that show all of some values but few that are far off."""
    low, high = values.quantile(0.01), values.quantile(0.99)  # not the worst outliers
    # A constant has no range: take a width that its rounding does not exceed.
    room = 0.15 * (high - low).clamp_min(1e-12 * values.abs().max() + 1e-300)
    return float(low - room), float(high + room)


@drawn
def densities(parameters: PhysicsParameters) -> list[Markup]:
    """Return the posterior of each parameter with its prior, and pairs that are correlated."""
    figures = {name: html.new_figure(2.0) for name in parameters}
    plots.plot_parameters(parameters, axes=[figure.subplots() for figure in figures.values()])
    alt = "density of {}, posterior and prior"
    images = [image(figure, alt.format(name)) for name, figure in figures.items()]
    varying = [i for i in range(len(figures)) if parameters.sd[i] > 0]
    names = labels([*parameters])
    for i, j in combinations(varying, 2):
        pair = parameters.draws[:, [i, j]].mT
        if float(torch.corrcoef(pair)[0, 1].abs()) > _CORRELATED:
            figure = html.new_figure(2.4)
            ax = figure.subplots()
            ax.plot(*pair, color=BLUE, **DOTS | {"ms": 3})
            ax.set(xlabel=names[i], ylabel=names[j])
            tidy(ax)
            images.append(image(figure, f"draws of {names[i]} and {names[j]}, correlated"))
    return images


@drawn
def left_out(subject: Subject, output: int) -> list[Markup]:
    """Return left-out predictions against observations, and their standardized residuals."""
    name = subject.outputs[output]
    alts = [f"predictions of left-out {name} against observations", f"their residuals, of {name}"]
    figures = [html.new_figure(2.9) for _ in alts]
    plots.plot_leave_one_out(subject.loo, output=output, axes=[f.subplots() for f in figures])
    return [image(figure, alt) for figure, alt in zip(figures, alts, strict=True)]


@drawn
def coverages(subject: Subject, output: int) -> list[Markup]:
    """Return observed against nominal coverage."""
    figure = html.new_figure(2.9)
    plots.plot_coverage(subject.loo, output=output, ax=figure.subplots())
    return [image(figure, f"observed against nominal coverage of {subject.outputs[output]}")]


def _words(subject: Subject, output: int) -> list[str]:
    """Return the words above the figures of an output."""
    shown = subject.adjusted[output]
    name = subject.outputs[output]
    if shown is None:
        return [f"{_NONE} The figures show the prediction. {_BANDS}"]
    parameters = "as it is"
    if any(physics.unknowns for physics in subject.physics.values()):
        parameters = "with fitted parameters"
        if any(term.kernel is not None for term in shown.model.terms):
            # The formula calibrated by itself, above, has others.
            parameters = "with the parameters fitted together with the correction"
    words = []
    for physics, values in subject.physics_at(subject.X, output).items():
        errors = subject.loo.judged[:, output] - values
        rms, mean = number(errors.square().nanmean().sqrt()), number(errors.nanmean())
        formula = physics.replace("physics", "formula", 1)
        words.append(
            f"At the data, the {formula} ({parameters}) is off by {with_unit(rms, name)} (root "
            f"mean square; observed less formula is {with_unit(mean, name)} in the mean)."
        )
    if len(subject.physics) > 1:
        return [*words, f"The figures show the prediction. {_BANDS}"]
    words.append(
        "The lines show by how much the model corrects the formula along each input. Each dot is a "
        "measurement less the formula, at its own values of the other inputs."
    )
    return [*words, _BANDS]
