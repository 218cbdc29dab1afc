"""Predictions of left-out observations: how good, and how honest."""

from __future__ import annotations

from functools import partial

from scipy.stats import binom

from gpadjust.report import figures
from gpadjust.report.images import drawn
from gpadjust.report.markup import Markup, join, table, tag
from gpadjust.report.numbers import name_and_unit, number, percent, plural, with_unit
from gpadjust.report.subject import Subject
from gpadjust.report.verdict import spread_of
from gpadjust.validation.plots.drawing import quantile

_WORST = 5
_LEVELS = (0.5, 0.8, 0.95)


def predictions(subject: Subject) -> Markup:
    """Each observation predicted from all others, and those that are predicted worst."""
    parts: list[str] = [tag("p", _how(subject))]
    scores = subject.loo.score()
    for j, name in enumerate(subject.outputs):
        rmse = float(scores.rmse[j])
        n = int((~subject.Y[:, j].isnan()).sum())
        words = (
            f"{name}: {plural(n, 'observation')}, root mean square error "
            f"{with_unit(number(rmse), name)}, {percent(rmse / spread_of(subject, j))} of the "
            "standard deviation of the observations."
        )
        parts += [
            tag("p", words),
            drawn(partial(figures.left_out, subject, j)),
            _worst(subject, j),
        ]
    return join(parts)


def calibration(subject: Subject) -> Markup:
    """Whether intervals hold what they promise."""
    rows, parts = [], []
    held_by = {level: subject.loo.score(level).coverage for level in _LEVELS}
    for j, name in enumerate(subject.outputs):
        n = int((~subject.Y[:, j].isnan()).sum())
        for level in _LEVELS:
            share = float(held_by[level][j])
            low, high = (int(binom.ppf(p, n, level)) for p in (0.025, 0.975))
            held = round(share * n)
            says = "too narrow" if held < low else "too wide" if held > high else "in that range"
            cells = [f"{held} of {n}", percent(share), f"{low} to {high} of {n}", says]
            rows.append([f"{name}, {percent(level)}", *cells])
        parts.append(drawn(partial(figures.calibration, subject, j)))
    head = ["interval", "holds", "share", "if calibrated", "the intervals are"]
    words = (
        "If intervals are honest, those of 95 % hold 95 % of left-out observations, but for "
        "chance: the fourth column has the range that 95 of 100 honest models would be in. The "
        "values of the histogram (PIT: where each observation fell within its prediction) are "
        "then evenly spread; a U is too sure, a hill too careful."
    )
    return join([tag("p", words), table("Coverage of left-out intervals", head, rows), *parts])


def _how(subject: Subject) -> str:
    """How observations were left out."""
    first = "Each observation is predicted by a model that has not seen it"
    if subject.comparison is not None and subject.comparison.left_out:
        return (
            f"{first}, as in the table above. Of a mixture its weights, which have seen all, stay."
        )
    if subject.model.num_samples is None:
        return (
            "Each observation is predicted from all others; hyper-parameters (and fitted "
            "parameters of the physics) stay as they are, and have seen it: with few data the "
            "errors are too small."
        )
    return f"{first}, nor have its hyper-parameters: their samples are weighted anew for each."


def _worst(subject: Subject, j: int) -> Markup:
    """The observations that are farthest from their predictions, in standard deviations."""
    loo, name = subject.loo, subject.outputs[j]
    sure = loo.residuals[:, j].abs().nan_to_num(nan=-1.0)
    order = [i for i in sure.argsort(descending=True).tolist() if sure[i] >= 0][:_WORST]
    unit = name_and_unit(name)[1]
    of = f" [{unit}]" if unit else ""
    few = len(subject.inputs) <= 4
    head = ["", f"observed{of}", f"predicted{of}", "95 %", "residual / sd"]
    rows = []
    for i in order:
        half = quantile(0.95) * float(loo.variance[i, j].sqrt())
        mean = float(loo.mean[i, j])
        cells = [number(float(loo.Y[i, j]), 4), number(mean, 4)]
        cells += [f"{number(mean - half, 4)} to {number(mean + half, 4)}"]
        cells += [f"{float(loo.residuals[i, j]):+.1f}"]
        cells += [number(x, 4) for x in subject.X[i].tolist()] if few else []
        rows.append([subject.rows[i], *cells])
    head += list(subject.inputs) if few else []
    caption = f"The {len(rows)} observations of {name} that are farthest from their predictions"
    return table(caption, head, rows)
