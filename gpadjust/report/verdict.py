"""The page of a model or a comparison, and the verdict that it begins with."""

from __future__ import annotations

import math

from gpadjust.checks import progress_bar
from gpadjust.core.saving import Saved
from gpadjust.report import figures, tables
from gpadjust.report import markup as html
from gpadjust.report.markup import Markup, Page, Verdict, tag
from gpadjust.report.subject import Origin, Subject
from gpadjust.validation.comparison import ALONE, STACKED

_ERRORS = {ALONE: "your formula", "calibrated physics": "your formula, calibrated"}


def page(
    subject: Subject, title: str | None, saved: Saved | str, origin: Origin, progress: bool = False
) -> Page:
    """Return the page; ``saved`` is the model's file, or the reason why there is none."""
    advice = [] if subject.comparison is None else subject.comparison.advice
    sentences = [text.replace("+-", "±") for text in (*advice, *origin.notes)]
    made_by = {
        "Recommendation": lambda: recommendation(subject),
        "Structures": lambda: tables.structures(subject),
        "Where is the physics wrong?": lambda: figures.where_wrong(subject),
        "Where trust lies": lambda: figures.trusted(subject),
        "Left-out predictions": lambda: tables.predictions(subject),
        "Do the intervals hold?": lambda: tables.coverage(subject),
        "Parameters of the physics": lambda: tables.parameters(subject),
        "What was learnt": lambda: tables.summary(subject),
        "Advice": lambda: html.bullets(sentences),
        "Data": lambda: tables.data(subject, origin.remarks),
        "Load the model, predict": lambda: tables.loading(subject, saved, origin),
    }
    bar = progress_bar(progress, made_by.items(), unit="section", leave=False)
    sections = {name: make() for name, make in bar}
    formula = "f_a(x) = rho(x) f_p(x) + delta(x)" if subject.has_physics else "without physics"
    variables = f"{html.listed(subject.outputs)} from {html.listed(subject.inputs)}"
    lead = f"{variables}: {html.plural(len(subject.X), 'row')} of data, {formula}."
    physics = ", ".join(f"{name} ({type(own).__name__})" for name, own in subject.physics.items())
    settings = {
        **origin.settings,
        "model": repr(subject.model),
        "physics": physics or ("known through samples" if subject.has_physics else "none"),
    }
    title = title or f"Report on {', '.join(subject.outputs)}"
    answers = verdicts(subject, origin.how)
    kind = "Errors" if subject.comparison is None else "Left-out errors"
    question, line = "Does the physics help?", headline(answers, kind)
    return Page(title, lead, question, answers, line, sections, settings)


def verdicts(subject: Subject, how: str = Origin.how) -> list[Verdict]:
    """Return the verdict on each output; ``how`` is code or a command that compares."""
    shown = []
    for j, name in enumerate(subject.outputs):
        numbers = errors(subject, j)
        note = "root mean square errors of left-out observations"
        if subject.comparison is None and len(numbers) > 1:
            note += (
                "; the formula's at the data, with the model's parameters if it has unknown ones"
            )
        elif subject.batches:
            note += "; each with an offset for each batch"
        shown.append(Verdict(name, numbers, note, *_answer(subject, name, how)))
    return shown


def headline(verdicts: list[Verdict], kind: str) -> str:
    """Return the errors and the answer of each output, a line each, for the terminal."""
    lines = []
    for name, numbers, _, answer, reasons in verdicts:
        each = "; ".join(f"{what}: {value}" for what, value in numbers.items())
        line = f"{kind} of {name}, {each}." if each else f"{name}:"
        several = len(verdicts) > 1
        lines.append(f"{line} {answer}." if several else f"{line}\n{answer}. {reasons[0]}")
    return "\n".join(lines)


def errors(subject: Subject, output: int) -> dict[str, str]:
    """Return the errors of the formula, its adjustment and the data alone, with the unit."""
    name = subject.outputs[output]
    if subject.comparison is not None:
        rmse_by = subject.comparison.errors()[name]
    else:
        values, rmse_by = subject.physics_at(subject.X, output), {}
        for physics, f_p in values.items():
            alone = ALONE if len(values) == 1 else f"{ALONE} of {physics}"
            rmse_by[alone] = float((subject.judged[:, output] - f_p).square().nanmean().sqrt())
        adjusted = "adjusted" if subject.has_physics else "data alone"
        rmse_by[adjusted] = float(subject.loo.score().rmse[output])
    shown = {}
    for what, rmse in rmse_by.items():
        short, of, physics = what.partition(" of ")
        label = _ERRORS.get(short, short)
        if short == ALONE and any(part.unknowns for part in subject.physics.values()):
            label += ", with fitted parameters"
        which = f" ({physics.removeprefix('physics ')})" * bool(of)
        shown[f"{label}{which}"] = html.with_unit(html.number(rmse), name)
    return shown


def _answer(subject: Subject, name: str, how: str) -> tuple[str, list[str]]:
    """Return the answer for an output, and sentences: those of the comparison, if any."""
    comparison = subject.comparison
    if not subject.has_physics:
        return "No physics", [f"The model of {name} has no physics to be judged."]
    if comparison is None:
        return "Not asked", [
            "This is a report of one model; whether the physics helps takes a comparison with a "
            f"model that has none: {how}"
        ]
    if name not in comparison.gain:
        return "Not asked", [
            "The comparison has no structure without the physics, or none with it; add 'zero mean' "
            "to its structures."
        ]
    gain, rmse = comparison.gain[name], comparison.errors()[name]
    sentences = gain.sentences(name)
    if gain.shown > 0 and rmse.get("adjusted", 0.0) > rmse.get("data alone", math.inf):
        sentences.append(
            "Its error is not the smaller one: what the physics helps with is how sure one is."
        )
    return gain.answer, sentences


def recommendation(subject: Subject) -> Markup:
    """Return the recommended model, and the reason."""
    comparison = subject.comparison
    if comparison is None:
        given = f"This page is of a given model, {subject.model!r}."
        return tag("p", f"{given} It was not compared with others.")
    name = comparison.chosen
    if len(comparison.models) == 1:
        (name,) = comparison.models
        return tag("p", f"Only {name} was fitted: {tables.described(name)}.")
    if name != STACKED:
        why = f", {tables.described(name)}. It has nearly all the weight."
        return tag("p", "Recommended: ", tag("strong", name), why)
    weights = []
    for output, ranked in comparison.table.items():
        rows = [row for row in ranked if row.weight >= 0.005]
        shares = html.listed(f"{row.structure} {row.weight:.2f}" for row in rows)
        weights.append(f"{output}: {shares}" if len(comparison.table) > 1 else shares)
    mixture = tag("strong", "the mixture of all structures")
    why = ". It keeps the doubt between them in its intervals."
    first = tag("p", "Recommended: ", mixture, why)
    return html.join([first, tag("p", f"Its weights are {'; '.join(weights)}.")])
