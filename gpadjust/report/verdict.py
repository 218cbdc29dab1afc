"""Does the physics help, and what is recommended?"""

from __future__ import annotations

import math

from botorch.models.transforms.outcome import nanstd

from gpadjust.models import StackedGP
from gpadjust.report.markup import Markup, bullets, join, table, tag
from gpadjust.report.numbers import listed, name_and_unit, number, percent, plural, with_unit
from gpadjust.report.subject import Subject
from gpadjust.validation.ranking import ENOUGH, sign_of
from gpadjust.validation.structures import ALONE, STACKED

_WHAT = {
    "zero mean": "no physics: a Gaussian process of the data alone",
    "physics mean": "f_p + delta(x): the physics, and a bias that depends on the inputs",
    "constant rho": "rho f_p + mu + delta(x): a fitted scale and offset, and a bias",
    "CKA": "rho(x) f_p + delta(x): a scale and a bias that depend on the inputs",
    "calibrated physics": "f_p with fitted parameters, and nothing else",
    ALONE: "f_p as it is, with noise that the other observations tell; no candidate",
    STACKED: "the mixture of all structures with the weights of the table",
}
_ERRORS = {ALONE: "your formula", "calibrated physics": "your formula, calibrated"}
COMPARE = "report(compare(train_X, train_Y, physics))"
_ANSWERS = {1: "Yes", 0: "Not shown", -1: "No"}


def verdicts(subject: Subject, how: str = COMPARE) -> Markup:
    """The answer for each output, in words, with the number and its standard error.

    Args:
        subject: What it is of.
        how: Code or a command that compares, for a subject that was not compared.
    """
    several = len(subject.outputs) > 1
    cards = []
    for j, name in enumerate(subject.outputs):
        answer, kind, sentences = _answer(subject, j, how)
        heading = [tag("h3", name)] if several else []
        body = [tag("p", sentence) for sentence in sentences]
        big = tag("p", answer, class_="answer")
        cards.append(tag("div", *heading, *_errors(subject, j), big, *body, class_=f"card {kind}"))
    return tag("div", *cards, class_="cards")


def recommendation(subject: Subject) -> Markup:
    """Which model is recommended, and why."""
    comparison = subject.comparison
    if comparison is None:
        what = f"This page is of a given model, {subject.model!r}. It was not compared with others."
        return tag("p", what)
    rows = [*comparison.table.values()]
    if len(comparison.models) == 1:
        return tag("p", f"Only {rows[0][0].structure} was fitted: {_what(rows[0][0].structure)}.")
    if comparison.chosen != STACKED:
        name = comparison.chosen
        why = "It has nearly all the weight."
        return tag("p", "Recommended: ", tag("strong", name), f", {_what(name)}. {why}")
    why = "It keeps the doubt between them in its intervals."
    weights = []
    for name, ranked in comparison.table.items():
        shares = listed(
            f"{row.structure} {row.weight:.2f}" for row in ranked if row.weight >= 0.005
        )
        weights.append(f"{name}: {shares}" if len(comparison.table) > 1 else shares)
    mixture = tag("strong", "the mixture of all structures")
    return join(
        [
            tag("p", "Recommended: ", mixture, f". {why}"),
            tag("p", f"Its weights are {'; '.join(weights)}."),
        ]
    )


def structures(subject: Subject) -> Markup:
    """The table of each output, and what the structures are."""
    comparison = subject.comparison
    if comparison is None:
        return _weights(subject)
    parts = []
    for j, output in enumerate(comparison.table):
        unit = name_and_unit(output)[1]
        head = ["structure", "elpd", "less the best", "its error", "weight"]
        head += [f"RMSE [{unit}]" if unit else "RMSE", "RMSE / sd", "in 95 %"]
        spread = spread_of(subject, j)
        rows = [
            [
                row.structure,
                f"{row.elpd:.4g}",
                f"{row.elpd_diff:.3g}",
                f"{row.se_diff:.2g}",
                "-" if row.structure.startswith(ALONE) else f"{row.weight:.2f}",
                number(row.rmse * spread),
                f"{row.rmse:.3g}",
                percent(row.coverage),
            ]
            for row in comparison.rows(output)
        ]
        parts.append(table(f"Left-out predictions of {output}, best first", head, rows, marked=0))
    names = {row.structure: None for output in comparison.table for row in comparison.rows(output)}
    terms = [join([tag("dt", name), tag("dd", _what(name))]) for name in names]
    parts.append(
        tag(
            "p",
            "elpd is the log density of left-out observations, summed, in nats: higher is better. "
            "A difference of less than two of its errors shows nothing. RMSE is of the left-out "
            "predictions, sd is that of the observations, and the last column is the share of "
            "left-out observations within their 95 % intervals.",
        )
    )
    return join([*parts, tag("dl", *terms)])


def advice(subject: Subject, notes: list[str]) -> Markup:
    """What the comparison says in sentences, and warnings of the fit."""
    told = [] if subject.comparison is None else subject.comparison.advice
    sentences = [text.replace("+-", "±") for text in (*told, *notes)]
    return bullets(sentences) if sentences else Markup()


def headline(subject: Subject, how: str = COMPARE) -> str:
    """The answer of all outputs in one line, for the title and the terminal."""
    answers = [_answer(subject, j, how) for j in range(len(subject.outputs))]
    if len(answers) == 1:
        answer, _, (first, *_) = answers[0]
        return f"{answer}. {first}"
    pairs = zip(subject.outputs, answers, strict=True)
    return "; ".join(f"{name}: {answer[0].lower()}" for name, answer in pairs) + "."


def spread_of(subject: Subject, output: int) -> float:
    """The standard deviation of the observations of an output, as tables of `compare` have it."""
    spread = float(nanstd(subject.Y[:, output : output + 1], dim=0))
    return spread if spread > 0 else 1.0


def _answer(subject: Subject, output: int, how: str) -> tuple[str, str, list[str]]:
    """The answer, what kind it is, and sentences."""
    comparison, name = subject.comparison, subject.outputs[output]
    n = int((~subject.Y[:, output].isnan()).sum())
    if not subject.physics and not subject.is_sampled:
        return "No physics", "open", [f"The model of {name} has no physics to be judged."]
    gain = None if comparison is None else comparison.gain.get(name)
    if comparison is None or gain is None:
        return "Not asked", "open", [_not_asked(subject, how)]
    ratio = math.exp(max(-50.0, min(50.0, gain.elpd / n)))
    numbers = (
        f"Log score of {plural(n, 'left-out observation')}, with the physics ({gain.structure}) "
        f"less without ({gain.without}): {gain.elpd:+.1f} ± {gain.se:.1f} nats (sum and standard "
        f"error), which makes each {number(ratio)} times as likely in geometric mean."
    )
    if gain.shown > 0:
        first = f"The physics helps to predict {name}."
        rest = [numbers]
    elif gain.shown < 0:
        first = f"With the physics, {name} is predicted worse than without it."
        rest = [numbers]
    elif n < ENOUGH:
        first = (
            f"{plural(n, 'observation')} of {name} are too few to show whether the physics helps."
        )
        rest = [
            numbers,
            f"Of fewer than {ENOUGH} observations the standard error is itself unknown: neither is "
            "it shown that the physics helps, nor that it does not.",
        ]
    else:
        first = f"These data do not show whether the physics helps to predict {name}."
        rest = [
            numbers,
            "That is not to say that it does not help: the difference is within two standard "
            "errors, and more observations may show one.",
        ]
        sign = sign_of(gain.elpd, gain.se)
        if gain.by_evidence:
            rest[1] = (
                f"{gain.structure} is better by more than two standard errors, but by the evidence "
                "of a model with and without the physics it is of no use: what they do not agree "
                "in is not shown."
                if sign > 0
                else f"{gain.structure} is worse by more than two standard errors, but among those "
                "compared is a model that leaves a physics of no use out by itself: so none is "
                "said to do harm."
            )
        elif sign > 0:
            rest[1] = (
                f"{gain.structure} is better by more than two standard errors, but its fitted "
                "constants may do that by themselves: the best structure without such constants is "
                "not shown to be better."
            )
    kind = {1: "yes", 0: "open", -1: "no"}[gain.shown]
    return _ANSWERS[gain.shown], kind, [first, *rest]


def _not_asked(subject: Subject, how: str) -> str:
    if subject.comparison is None:
        return (
            "This is a report of one model; whether the physics helps takes a comparison with a "
            f"model that has none: {how}"
        )
    return (
        "The comparison has no structure without the physics, or none with it; add 'zero mean' to "
        "its structures."
    )


def _errors(subject: Subject, output: int) -> list[Markup]:
    """How far off the formula, its adjustment and the data alone are, in a line."""
    name = subject.outputs[output]
    if subject.comparison is not None:
        errors = subject.comparison.errors()[name]
    else:
        Y, shown = subject.Y[:, output], subject.physics_at(subject.X, output)
        errors = {
            ALONE if len(shown) == 1 else f"{ALONE} of {physics}": float(
                (Y - values).square().nanmean().sqrt()
            )
            for physics, values in shown
        }
        own = "adjusted" if subject.physics or subject.is_sampled else "data alone"
        errors[own] = float(subject.loo.score().rmse[output])
    if not errors:
        return []
    fitted = ", with fitted parameters" if subject.as_it_is != "as it is" else ""
    told = []
    for what, rmse in errors.items():
        short, of, physics = what.partition(" of ")
        label = _ERRORS.get(short, short) + (fitted if short == ALONE else "")
        told.append(f"{label}{f' {physics}' * bool(of)}: {with_unit(number(rmse), name)}")
    text = "; ".join(told)
    note = tag("span", " (root mean square errors of left-out observations)", class_="note")
    return [tag("p", text[0].upper() + text[1:], note, class_="errors")]


def _weights(subject: Subject) -> Markup:
    """The weights of a mixture that came without a comparison."""
    if not isinstance(subject.model, StackedGP):
        return Markup()
    rows = [[name, *map("{:.2f}".format, w)] for name, w in subject.model.weights.items()]
    return table("Weights of the mixture", ["structure", *subject.outputs], rows)


def _what(name: str) -> str:
    """What a structure is; of one of several physics, of which."""
    short, of, physics = name.partition(" of ")
    what = _WHAT.get(short, "a structure of your own")
    return f"{what} ({physics})" if of else what
