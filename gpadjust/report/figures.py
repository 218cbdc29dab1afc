"""Sections with figures of a page: where the physics is wrong, and where predictions rest on it."""

from __future__ import annotations

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
    column,
    labels,
    legend,
    lines_along,
    mean_and_ends,
    tidy,
)
from gpadjust.validation.trust import physics_at
from gpadjust.words import bare, name_and_unit, number, percent, with_unit

_MOST = 12  # inputs along which slices are drawn, in all outputs together
_CORRELATED = 0.7  # absolute correlation of parameters whose pair is drawn
_BANDS = "Solid lines are means; bands hold 95 % of the function, without measurement noise."
_NONE = "There is no physics that could be adjusted, trusted or overridden."
_TRUST = (
    "Of {} points spread over the box of the data: the share at which the prediction rests on the "
    "physics (its interval holds f_p, and is narrower than the discrepancies that were seen), on "
    "the data (its interval excludes f_p: the model is sure that the physics is wrong there), or "
    "on neither (too few data to tell)."
)


def where_wrong(subject: Subject) -> Markup:
    """Return the correction of the physics along each input, for each output."""
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
        parts += [tag("p", " ".join(_words(subject, j))), corrections(subject, j, inputs)]
    return html.join(parts)


def trusted(subject: Subject) -> Markup:
    """Return the shares of predictions that rest on the physics, on data, or on neither."""
    rows, failed, points = [], [], 0
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
        points = len(basis.X)
    if not rows:
        return html.join(failed or [tag("p", _NONE)])
    head = ["output", "by the model", "physics", "data", "neither"]
    shares_of = html.table("Basis of the predictions", head, rows)
    return html.join([*failed, tag("p", _TRUST.format(f"{points:,}")), shares_of])


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
def agreement(subject: Subject, output: int) -> list[Markup]:
    """Return observations over left-out predictions, by the formula and corrected."""
    name, formulas = subject.outputs[output], subject.physics_at(subject.X, output)
    first = dict(zip(["your formula"], formulas.values(), strict=False))
    figure = html.new_figure(3.2)
    ax = plots.draw_left_out(
        figure.subplots(), subject.loo, subject.judged[:, output], output, first
    )
    legend(ax)
    return [image(figure, f"measured over predicted {name}, by the formula and corrected")]


@drawn
def corrections(subject: Subject, output: int, inputs: list[int]) -> list[Markup]:
    """Return the correction of the formula along each input, with the data as dots.

    It is what the prediction adds to the physics, in per cent of it, or in the output's unit where
    the physics changes sign. Without a single physics it is the prediction itself.
    """
    shown, name = subject.adjusted[output], subject.outputs[output]
    at_data = [*subject.physics_at(subject.X, output).values()]
    lines = lines_along(subject.model, output, base=subject.base)
    figures, y = [], subject.judged[:, output]
    is_correction = shown is not None and len(at_data) == 1
    is_share = is_correction and bool((at_data[0] > 0).all() or (at_data[0] < 0).all())
    unit = "%" if is_share else name_and_unit(name)[1]
    label = "correction" if is_correction else labels(subject.outputs)[output]
    for i in inputs:
        x, X = lines[i]
        figure = html.new_figure(2.4)
        ax = figure.subplots()
        f, data = torch.zeros_like(x), torch.zeros_like(y)
        if is_correction:
            assert shown is not None
            (values,) = physics_at(shown.model, X).values()
            f, data = column(values, output), at_data[0]
            ax.axhline(0, color=GREY, ls="--", lw=1.2)
        sizes = [100 / each.abs() if is_share else torch.ones_like(each) for each in (f, data)]
        ends = mean_and_ends(subject.model.marginals(X), output, 0.95)
        curve, *band_ends = ((each - f) * sizes[0] for each in ends)
        band(ax, x, [curve, *band_ends], 0.95)
        dots = (y - data) * sizes[1]
        ax.plot(subject.X[:, i], dots, color=RED, **DOTS | {"ms": 3})
        ax.set_ylim(*_limits(torch.cat([curve, dots[~dots.isnan()], 0 * x[:is_correction]])))
        room = 0.03 * float(x[-1] - x[0])  # for whole dots at the ends
        ax.set(xlim=(float(x[0]) - room, float(x[-1]) + room), xlabel=labels(subject.inputs)[i])
        ax.set_ylabel(f"{label} [{unit}]" if unit and is_correction else label)
        tidy(ax)
        figures.append(image(figure, f"{label} of {name} over {subject.inputs[i]}, with the data"))
    return figures


def _limits(values: Tensor) -> tuple[float, float]:
    """Return limits of an axis that show all of some values but few that are far off."""
    low, high = values.quantile(0.01), values.quantile(0.99)
    room = 0.15 * (high - low).clamp_min(1e-12 * values.abs().max() + 1e-300)
    return float(low - room), float(high + room)


@drawn
def densities(parameters: PhysicsParameters) -> list[Markup]:
    """Return the posterior of each parameter beside its prior, and pairs that are correlated."""
    names = [*parameters]
    drawn = [html.new_figure(2.0) for _ in names]
    plots.plot_parameters(parameters, axes=[figure.subplots() for figure in drawn])
    images = [
        image(figure, f"density of {name}, posterior and prior")
        for figure, name in zip(drawn, names, strict=True)
    ]
    varying = [i for i in range(len(names)) if parameters.sd[i] > 0]
    for i, j in combinations(varying, 2):
        x, y = parameters.draws[:, i], parameters.draws[:, j]
        if float(torch.corrcoef(torch.stack([x, y]))[0, 1].abs()) > _CORRELATED:
            figure = html.new_figure(2.4)
            ax = figure.subplots()
            ax.plot(x, y, color=BLUE, **DOTS | {"ms": 3})
            ax.set(xlabel=labels([names[i]])[0], ylabel=labels([names[j]])[0])
            tidy(ax)
            images.append(image(figure, f"draws of {names[i]} and {names[j]}, correlated"))
    return images


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


def _words(subject: Subject, output: int) -> list[str]:
    """Return the words above the figures of an output."""
    shown, name = subject.adjusted[output], subject.outputs[output]
    if shown is None:
        return [f"{_NONE} The figures show the prediction. {_BANDS}"]
    words = []
    has_unknowns = any(physics.unknowns for physics in subject.physics.values())
    is_it = "with fitted parameters" if has_unknowns else "as it is"
    if has_unknowns and any(term.kernel is not None for term in shown.model.terms):
        # The formula calibrated by itself, above, has others.
        is_it = "with the parameters fitted together with the correction"
    for physics, values in subject.physics_at(subject.X, output).items():
        off = subject.judged[:, output] - values
        rms, mean = number(off.square().nanmean().sqrt()), number(off.nanmean())
        words.append(
            f"At the data, the {physics} ({is_it}) is off by {with_unit(rms, name)} (root "
            f"mean square; observed less physics is {with_unit(mean, name)} in the mean)."
        )
    if len(subject.physics) > 1:
        return [*words, f"The figures show the prediction. {_BANDS}"]
    words.append(
        "The lines show by how much the model corrects the formula along each input. Each dot is a "
        "measurement less the formula, at its own values of the other inputs."
    )
    return [*words, _BANDS]
