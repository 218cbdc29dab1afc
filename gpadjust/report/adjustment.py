"""Where is the physics wrong, and where does trust in it lie?"""

from __future__ import annotations

from functools import partial

from gpadjust.physics import PhysicsError
from gpadjust.report import figures
from gpadjust.report.images import drawn
from gpadjust.report.markup import Markup, join, table, tag
from gpadjust.report.numbers import failure, listed, number, percent, with_unit
from gpadjust.report.subject import Adjusted, Subject
from gpadjust.report.verdict import spread_of
from gpadjust.validation import Trust, trust

_BANDS = "Solid lines are means; bands hold 95 % of the function, without measurement noise."
_ROUNDING = 1e-9  # of the observations' standard deviation
_APART = (
    "Observations are of rho f_p + delta alone: how much of it is rho's and how much delta's the "
    "data tell far less surely than their sum."
)


def where_wrong(subject: Subject) -> Markup:
    """The prediction beside the physics, rho and delta, for each output."""
    inputs = figures.inputs_drawn(subject)
    parts: list[str] = []
    for j, name in enumerate(subject.outputs):
        if len(subject.outputs) > 1:
            parts.append(tag("h3", name))
        shown = subject.adjusted[j]
        parts.append(tag("p", " ".join(_words(subject, shown, j))))
        parts.append(drawn(partial(figures.slices, subject, j, inputs)))
        parts.append(drawn(partial(figures.pairs, subject, j)))
    held = figures.held(subject, inputs)
    notes = [tag("p", held, class_="note")] if held else []
    return join([*notes, *parts])


def trusted(subject: Subject) -> Markup:
    """Which share of the predictions rests on the physics, on data, or on neither."""
    shares: list[tuple[str, Adjusted, Trust]] = []
    parts: list[str] = []
    for name, shown in zip(subject.outputs, subject.adjusted, strict=True):
        if shown is None:
            continue
        try:
            shares.append((name, shown, trust(shown.model)))
        except PhysicsError as error:
            parts.append(tag("p", f"{name}: {failure(error)}", class_="caution"))
    if not shares:
        return join([*parts, *([] if parts else [tag("p", _none(subject))])])
    rows = []
    for name, shown, found in shares:
        three = (found.physics, found.data, found.neither)
        told = [percent(float(share[shown.output])) for share in three]
        rows.append([name, shown.structure, *told])
    head = ["output", "by the model", "physics", "data", "neither"]
    points = f"{len(shares[0][2].X):,}"
    words = (
        f"Of {points} points spread over the box of the data: the share at which the prediction "
        "rests on the physics (its interval holds f_p, and is narrower than the discrepancies that "
        "were seen), on the data (its interval excludes f_p: the model is sure that the physics is "
        "wrong there), or on neither (too few data to tell)."
    )
    parts += [tag("p", words), table("What predictions rest on", head, rows)]
    inputs = figures.inputs_drawn(subject)
    for name, shown, found in shares:
        parts.append(drawn(partial(figures.trusts, found, shown.output, inputs, name)))
    over = {1: "Along the input", 2: "Over both inputs"}.get(len(subject.inputs))
    over = over or "Along each input, for all values of the others"
    colours = "blue where it rests on the physics, orange on the data, grey on neither"
    parts.append(tag("p", f"{over}: {colours}.", class_="note"))
    return join(parts)


def _none(subject: Subject) -> str:
    """Why neither rho and delta nor trust can be shown."""
    if subject.is_sampled:
        return "AR1 knows its physics through samples alone, so that nothing is held against it."
    return "There is no physics that could be adjusted, trusted or overridden."


def _words(subject: Subject, shown: Adjusted | None, output: int) -> list[str]:
    """What the figures of an output show."""
    if shown is None:
        return [f"{_none(subject)} The figures show the prediction. {_BANDS}"]
    name = subject.outputs[output]
    found = []
    for physics, values in subject.physics_at(subject.X, output):
        off = subject.Y[:, output] - values
        off = off[~off.isnan()]
        rms, mean = float(off.square().mean().sqrt()), float(off.mean())
        found.append(
            f"At the data, the {physics} ({subject.as_it_is}) is off by "
            f"{with_unit(number(rms), name)} (root mean square; observed less physics is "
            f"{with_unit(number(mean), name)} in the mean)."
        )
    terms = [term for term in shown.model.term_names if term != "f"]
    top = "the prediction of what is recommended, and dashed the physics"
    if subject.comparison is None:
        top = "the prediction, and dashed the physics"
    if len(subject.inputs) == 1:
        top += ", with the data"
    found.append(f"Topmost: {top}.")
    if terms:
        weight = "" if shown.weight == 1 else f" (weight {shown.weight:.2f})"
        means = [shown.model.term_mean(term, shown.output) for term in terms]
        means = [
            0.0 if abs(mean) < _ROUNDING * spread_of(subject, output) else mean for mean in means
        ]
        back = [f"{term} = {number(mean)}" for term, mean in zip(terms, means, strict=True)]
        found.append(
            f"Below: {listed(terms)} of {shown.structure}{weight}, with ticks at the data; dashed, "
            f"what they fall back to without data, {listed(back)}."
        )
        if len(terms) > 1:
            found.append(_APART)
    return [*found, _BANDS]
