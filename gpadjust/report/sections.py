"""The sections of the page: their words, tables and figures."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from typing import Any

import torch
from scipy.stats import binom
from torch import Tensor

import gpadjust
from gpadjust.core import GP, CalibratedPhysics, KnownNoise, StackedGP
from gpadjust.core.saving import Saved
from gpadjust.kinds.categories import Categories, levels_of
from gpadjust.kinds.heavy_tails import HeavyTails, RowNoise
from gpadjust.kinds.noisy_inputs import NoisyInputs
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.physics import PhysicsError
from gpadjust.physics.import_path import is_formula
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.report import figures
from gpadjust.report.given_physics import needs_inf
from gpadjust.report.markup import (
    Markup,
    bullets,
    code,
    drawn,
    failure,
    join,
    listed,
    name_and_unit,
    number,
    percent,
    plural,
    table,
    tag,
    with_unit,
)
from gpadjust.report.subject import Adjusted, Subject
from gpadjust.validation import Trust, trust
from gpadjust.validation.plots.adjustments import unadjusted
from gpadjust.validation.plots.drawing import quantile
from gpadjust.validation.ranking import spread_of
from gpadjust.validation.structures import ALONE, STACKED

COMPARE = "report(compare(train_X, train_Y, physics))"
_WHAT = {
    "zero mean": "no physics: a Gaussian process of the data alone",
    "physics mean": "f_p + delta(x): the physics, and a bias that depends on the inputs",
    "CKA": "rho(x) f_p + delta(x): a scale and a bias that depend on the inputs",
    "calibrated physics": "f_p with fitted parameters, and nothing else",
    ALONE: "f_p as it is, with noise that the other observations tell; no candidate",
    STACKED: "the mixture of all structures with the weights of the table",
}
_ERRORS = {ALONE: "your formula", "calibrated physics": "your formula, calibrated"}
_BANDS = "Solid lines are means; bands hold 95 % of the function, without measurement noise."
_APART = (
    "Observations are of rho f_p + delta alone: how much of it is rho's and how much delta's the "
    "data tell far less surely than their sum."
)
_NONE = "There is no physics that could be adjusted, trusted or overridden."
_WORST = 5
_LEVELS = (0.5, 0.8, 0.95)
_MADE = ("BlackBoxPhysics", "FormulaPhysics", "Unknown")
_LIBRARIES = ("torch", "gpytorch", "botorch", "numpy")


@dataclass(frozen=True)
class Origin:
    """Origin of a report's subject, as far as the model does not know it.

    Attributes:
        settings: Names and values of settings.
        remarks: Sentences on the data.
        notes: Sentences on the fit, such as warnings.
        physics: Python expressions of the physics by their names, for whoever loads the model; one
            of the name ``""`` if there is one physics. None: as far as the model's file knows.
        modules: The modules that these expressions need.
        how: Code or a command that compares the model with others.
    """

    settings: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    physics: Mapping[str, str] | None = None
    modules: tuple[str, ...] = ()
    how: str = COMPARE


def verdicts(subject: Subject, how: str = COMPARE) -> Markup:
    """The verdict on each output, below the errors of formula, adjustment and data.

    A subject that was not compared is told ``how``, code or a command that compares.
    """
    cards = []
    for j, name in enumerate(subject.outputs):
        answer, sentences = verdict(subject, j, how)
        kind = {"Yes": "yes", "No": "no"}.get(answer, "open")
        heading = [tag("h3", name)] if len(subject.outputs) > 1 else []
        body = [tag("p", sentence.replace("+-", "±")) for sentence in sentences]
        big = tag("p", answer, class_="answer")
        cards.append(tag("div", *heading, *_errors(subject, j), big, *body, class_=f"card {kind}"))
    return tag("div", *cards, class_="cards")


def headline(subject: Subject, how: str = COMPARE) -> str:
    """The errors and the answer of each output, a line each, for the terminal."""
    lines = []
    for j, name in enumerate(subject.outputs):
        answer, (first, *_) = verdict(subject, j, how)
        told = "; ".join(f"{what}: {value}" for what, value in errors(subject, j).items())
        kind = "Errors" if subject.comparison is None else "Left-out errors"
        lines.append(f"{kind} of {name}, {told}." if told else f"{name}:")
        lines[-1] += f"\n{answer}. {first}" if len(subject.outputs) == 1 else f" {answer}."
    return "\n".join(lines)


def verdict(subject: Subject, output: int, how: str = COMPARE) -> tuple[str, list[str]]:
    """The answer for an output, and sentences: those of the comparison, if any."""
    name, comparison = subject.outputs[output], subject.comparison
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
    gain, found = comparison.gain[name], comparison.errors()[name]
    sentences = gain.sentences(name)
    if gain.shown > 0 and found.get("adjusted", 0.0) > found.get("data alone", math.inf):
        sentences.append(
            "Its error is not the smaller one: what the physics helps with is how sure one is."
        )
    return gain.answer, sentences


def recommendation(subject: Subject) -> Markup:
    """The recommended model, and the reason."""
    comparison = subject.comparison
    if comparison is None:
        return tag(
            "p",
            f"This page is of a given model, {subject.model!r}. It was not compared with others.",
        )
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
    first = tag("p", "Recommended: ", mixture, f". {why}")
    return join([first, tag("p", f"Its weights are {'; '.join(weights)}.")])


def structures(subject: Subject) -> Markup:
    """The table of each output, and what the structures are."""
    comparison = subject.comparison
    if comparison is None:
        return _weights(subject)
    parts = []
    for j, output in enumerate(comparison.table):
        head = ["structure", "elpd", "less the best", "its error", "weight"]
        head += [with_unit("RMSE", output, "{} [{}]"), "RMSE / sd", "in 95 %"]
        spread = spread_of(subject.Y[:, j])
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
    words = (
        "elpd is the log density of left-out observations, summed, in nats: higher is better. A "
        "difference of less than two of its errors shows nothing. RMSE is of the left-out "
        "predictions, sd is that of the observations, and the last column is the share of left-out "
        "observations within their 95 % intervals. Weights are those of the mixture that predicts "
        "left-out observations best: of structures that predict alike one may have all of it, also "
        "one that is not the first."
    )
    return join([*parts, tag("p", words), tag("dl", *terms)])


def advice(subject: Subject, notes: list[str]) -> Markup:
    """Further sentences of the comparison, and warnings of the fit."""
    told = [] if subject.comparison is None else subject.comparison.advice
    sentences = [text.replace("+-", "±") for text in (*told, *notes)]
    return bullets(sentences) if sentences else Markup()


def errors(subject: Subject, output: int) -> dict[str, str]:
    """The errors of the formula, its adjustment and the data alone, with the unit."""
    name = subject.outputs[output]
    if subject.comparison is not None:
        found = subject.comparison.errors()[name]
    else:
        Y, shown = subject.judged[:, output], subject.physics_at(subject.X, output)
        found = {
            ALONE if len(shown) == 1 else f"{ALONE} of {physics}": float(
                (Y - values).square().nanmean().sqrt()
            )
            for physics, values in shown.items()
        }
        own = "adjusted" if subject.has_physics else "data alone"
        found[own] = float(subject.loo.score().rmse[output])
    fitted = ", with fitted parameters" if subject.as_it_is != "as it is" else ""
    told = {}
    for what, rmse in found.items():
        short, of, physics = what.partition(" of ")
        label = _ERRORS.get(short, short) + (fitted if short == ALONE else "")
        which = f" ({physics.removeprefix('physics ')})" * bool(of)
        told[f"{label}{which}"] = with_unit(number(rmse), name)
    return told


def _errors(subject: Subject, output: int) -> list[Markup]:
    """The :func:`errors`, in large numbers."""
    shown = errors(subject, output)
    note = "root mean square errors of left-out observations"
    if subject.comparison is None and len(shown) > 1:
        note += "; the formula's at the data, with the model's parameters if it has unknown ones"
    elif subject.batches:
        note += "; each with an offset for each batch"
    return large_numbers(shown, note) if shown else []


def large_numbers(shown: Mapping[str, str], note: str) -> list[Markup]:
    """Numbers above their names, and a note below them."""
    each = [tag("div", tag("dt", what), tag("dd", value)) for what, value in shown.items()]
    return [tag("dl", *each, class_="errors"), tag("p", note, class_="note")]


def _weights(subject: Subject) -> Markup:
    """The weights of a mixture that came without a comparison."""
    if not isinstance(subject.model, StackedGP):
        return Markup()
    rows = [[name, *map("{:.2f}".format, w)] for name, w in subject.model.weights.items()]
    return table("Weights of the mixture", ["structure", *subject.outputs], rows)


def _what(name: str) -> str:
    """The description of a structure, with the physics if it is of one of several."""
    short, of, physics = name.partition(" of ")
    return _WHAT.get(short, "a structure of your own") + f" ({physics})" * bool(of)


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
    held = figures.held(subject, inputs)
    return join([tag("p", held, class_="note") if held else Markup(), *parts])


def trusted(subject: Subject) -> Markup:
    """Shares of the predictions that rest on the physics, on data, or on neither."""
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
        return join([*parts, *([] if parts else [tag("p", _NONE)])])
    rows = []
    for name, shown, found in shares:
        three = (found.physics, found.data, found.neither)
        rows.append(
            [name, shown.structure, *(percent(float(each[shown.output])) for each in three)]
        )
    head = ["output", "by the model", "physics", "data", "neither"]
    points = f"{len(shares[0][2].X):,}"
    words = (
        f"Of {points} points spread over the box of the data: the share at which the prediction "
        "rests on the physics (its interval holds f_p, and is narrower than the discrepancies that "
        "were seen), on the data (its interval excludes f_p: the model is sure that the physics is "
        "wrong there), or on neither (too few data to tell)."
    )
    parts += [tag("p", words), table("Basis of the predictions", head, rows)]
    inputs = figures.inputs_drawn(subject)
    for name, shown, found in shares:
        parts.append(drawn(partial(figures.trusts, found, shown.output, inputs, name)))
    several = len(subject.inputs) > 1
    over = "Along each input, for all values of the others" if several else "Along the input"
    colors = "blue where it rests on the physics, orange on the data, grey on neither"
    parts.append(tag("p", f"{over}: {colors}.", class_="note"))
    return join(parts)


def _words(subject: Subject, shown: Adjusted | None, output: int) -> list[str]:
    """The words above the figures of an output."""
    if shown is None:
        return [f"{_NONE} The figures show the prediction. {_BANDS}"]
    name = subject.outputs[output]
    found = []
    for physics, values in subject.physics_at(subject.X, output).items():
        off = subject.judged[:, output] - values
        off = off[~off.isnan()]
        rms, mean = float(off.square().mean().sqrt()), float(off.mean())
        found.append(
            f"At the data, the {physics} ({subject.as_it_is}) is off by "
            f"{with_unit(number(rms), name)} (root mean square; observed less physics is "
            f"{with_unit(number(mean), name)} in the mean)."
        )
    top = "the prediction of what is recommended, and dashed the physics"
    if subject.comparison is None:
        top = "the prediction, and dashed the physics"
    if len(subject.inputs) == 1:
        top += ", with the data"
    found.append(f"Topmost: {top}.")
    if terms := shown.terms:
        weight = "" if shown.weight == 1 else f" (weight {shown.weight:.2f})"
        back = [f"{term} = {number(unadjusted(shown.model, term))}" for term in terms]
        found.append(
            f"Below: {listed(terms)} of {shown.structure}{weight}, with ticks at the data; dashed, "
            f"what they fall back to without data, {listed(back)}."
        )
        if len(terms) > 1:
            found.append(_APART)
    return [*found, _BANDS]


def predictions(subject: Subject) -> Markup:
    """Each observation predicted from all others, and those that are predicted worst."""
    parts: list[str] = [tag("p", _how(subject))]
    scores = subject.loo.score()
    for j, name in enumerate(subject.outputs):
        rmse = float(scores.rmse[j])
        words = (
            f"{name}: {plural(subject.counts[j], 'observation')}, root mean square error "
            f"{with_unit(number(rmse), name)}, {percent(rmse / spread_of(subject.Y[:, j]))} of the "
            "standard deviation of the observations."
        )
        if out := subject.outliers(j):
            are = "is taken for an outlier" if len(out) == 1 else "are taken for outliers"
            words += f" {listed(out)} {are}: errors and coverage on this page leave them out."
        drawing = drawn(partial(figures.left_out, subject, j))
        parts += [tag("p", words), drawing, _worst(subject, j)]
    return join(parts)


def coverage(subject: Subject) -> Markup:
    """Coverage of the intervals of left-out observations."""
    rows, parts = [], []
    held_by = {level: subject.loo.score(level).coverage for level in _LEVELS}
    for j, name in enumerate(subject.outputs):
        n = subject.counts[j]
        for level in _LEVELS:
            share = float(held_by[level][j])
            low, high = (int(binom.ppf(p, n, level)) for p in (0.025, 0.975))
            held = round(share * n)
            says = "too narrow" if held < low else "too wide" if held > high else "in that range"
            cells = [f"{held} of {n}", percent(share), f"{low} to {high} of {n}", says]
            rows.append([f"{name}, {percent(level)}", *cells])
        parts.append(drawn(partial(figures.coverage, subject, j)))
    head = ["interval", "holds", "share", "if they hold", "the intervals are"]
    words = (
        "If intervals are honest, those of 95 % hold 95 % of left-out observations, but for "
        "chance: the fourth column has the range that 95 of 100 honest models would be in. The "
        "values of the histogram (PIT: where each observation fell within its prediction) are "
        "then evenly spread; a U is too sure, a hill too careful."
    )
    return join([tag("p", words), table("Coverage of left-out intervals", head, rows), *parts])


def _how(subject: Subject) -> str:
    """Return the way in which observations were left out."""
    first = "Each observation is predicted by a model that has not seen it"
    if subject.comparison is not None:
        return (
            f"{first}, as in the table above. Of a mixture its weights, which have seen all, stay."
        )
    if isinstance(subject.model, GP) and len(subject.model.u) == 1:
        return (
            "Each observation is predicted from all others; hyper-parameters (and fitted "
            "parameters of the physics) stay as they are, and have seen it: with few data the "
            "errors are too small."
        )
    return f"{first}, nor have its hyper-parameters: their samples are weighted again for each."


def _worst(subject: Subject, j: int) -> Markup:
    """The observations that are farthest from their predictions, in standard deviations."""
    loo, name = subject.loo, subject.outputs[j]
    sure = loo.residuals[:, j].abs().nan_to_num(nan=-1.0)
    if loo.is_outlier is not None:
        sure = sure.masked_fill(loo.is_outlier[:, j], torch.inf)
    order = [i for i in sure.argsort(descending=True).tolist() if sure[i] >= 0][:_WORST]
    few = len(subject.inputs) <= 4
    said = [with_unit(what, name, "{} [{}]") for what in ("observed", "predicted")]
    head = ["", *said, "95 %", "residual / sd", *(subject.inputs if few else ())]
    rows, outliers = [], {*subject.outliers(j)}
    for i in order:
        half = quantile(0.95) * float(loo.variance[i, j].sqrt())
        mean = float(loo.mean[i, j])
        cells = [number(float(loo.Y[i, j]), 4), number(mean, 4)]
        cells += [f"{number(mean - half, 4)} to {number(mean + half, 4)}"]
        cells += [f"{float(loo.residuals[i, j]):+.1f}"]
        cells += figures.point(subject, subject.X[i]) if few else []
        row = subject.rows[i]
        rows.append([f"{row} (outlier)" if row in outliers else row, *cells])
    caption = f"The {len(rows)} observations of {name} that are farthest from their predictions"
    return table(caption, head, rows)


def parameters(subject: Subject) -> Markup:
    """The unknown parameters of the physics: prior and posterior; nothing if there are none."""
    parts = []
    seen: set[str] = set()
    for shown in subject.adjusted:
        if shown is None or not shown.model.physics_parameters or shown.structure in seen:
            continue  # outputs share them
        seen.add(shown.structure)
        caption = f"Parameters of the physics, by {shown.structure}"
        parts.append(parameter_table(caption, shown.model.physics_parameters))
    models = {} if subject.comparison is None else subject.comparison.models
    for name, model in models.items():
        if isinstance(model, CalibratedPhysics) and name not in seen:
            caption = f"Parameters of the physics by itself, with noise ({name})"
            parts.append(parameter_table(caption, model.physics_parameters))
    if not parts:
        return Markup()
    words = (
        "A bias that is free to vary leaves open which values are the true ones: these describe "
        "the system best together with it. Compare 'known before' with the interval: where they "
        "are alike, the data say next to nothing."
    )
    return join([*parts, tag("p", words)])


def parameter_table(caption: str, known: PhysicsParameters) -> Markup:
    """A table of unknown parameters: the posterior, and what was known before."""
    low, high = known.interval()
    rows = []
    for i, (name, unknown) in enumerate(known.unknowns.items()):
        mean, spread = number(float(known.mean[i]), 4), ["-", "-"]
        if known.sd[i] > 0:  # not of a point fit
            interval = f"{number(float(low[i]), 4)} to {number(float(high[i]), 4)}"
            spread = [number(float(known.sd[i])), interval]
        rows.append([name, mean, *spread, unknown.prior_text, unknown.unit or "-"])
    head = ["parameter", "mean", "sd", "95 % interval", "known before", "unit"]
    return table(caption, head, rows)


def summary(subject: Subject) -> Markup:
    """The summary of what predicts, in the user's units."""
    words = (
        "In the units of the data; of samples the median, and the range of 95 % of them. A "
        "lengthscale is the distance over which a function changes, sd how much. Means are those "
        "of the prior; what was learnt of rho and delta is in the figures."
    )
    title, text = tag("summary", "All hyper-parameters"), code(subject.model.summary())
    return join([tag("p", words), tag("details", title, text, open="")])


def data(subject: Subject, origin: Origin) -> Markup:
    """An overview of the columns, and what is missing or repeated."""
    rows: list[list[str]] = []
    kinds = (("input", subject.inputs, subject.X), ("output", subject.outputs, subject.Y))
    for kind, names, values in kinds:
        for name, column in zip(names, values.unbind(-1), strict=True):
            seen = column[~column.isnan()]
            short, unit = name_and_unit(name)
            ends = (seen.min(), seen.quantile(0.5), seen.max())
            is_name = kind == "input" and len(rows) in subject.names  # of which none is the least
            numbers = ["-"] * 3 if is_name else [number(float(end), 4) for end in ends]
            rows.append([short, kind, unit or "-", *numbers, str(len(column) - len(seen))])
    head = ["column", "is", "unit", "least", "median", "most", "missing"]
    remarks = [f"{plural(len(subject.X), 'row')} of data.", *_repeats(subject), *origin.remarks]
    remarks.append(_assumed(subject.model))
    return join([table("Columns", head, rows), bullets(remarks)])


def _assumed(model: GP | StackedGP) -> str:
    """Return what a model takes its data for, in a sentence."""
    one: Any = model.models[0] if isinstance(model, StackedGP) else model
    data, noise, levels = one.data, one.noise, levels_of(one)
    outputs = listed(name_and_unit(name)[0] for name in data.output_names)
    found: list[str] = []
    while isinstance(noise, RowNoise):
        if isinstance(noise, HeavyTails):
            found.insert(0, "noise with heavy tails, so that outliers count for little")
        if isinstance(noise, NoisyInputs):
            sds = noise.settings["variances"].mean(0).sqrt().tolist()
            noisy = [pair for pair in zip(data.input_names, sds, strict=True) if pair[1] > 0]
            each = [f"{name_and_unit(n)[0]} by {with_unit(number(sd), n)}" for n, sd in noisy]
            found.append(f"inputs that are noisy themselves: {listed(each)} (standard deviations)")
        noise = noise.base
    if isinstance(noise, RelativeNoise):
        found.insert(0, "noise that grows with the physics, beside a constant one (relative)")
    if isinstance(noise, KnownNoise):
        found.insert(0, "noise of known variance")
    if (link := getattr(one, "link", None)) is not None:
        below = f" and below {link.upper:g}" * math.isfinite(link.upper)
        found.append(f"{outputs} above {link.lower:g}{below}")
    batches = data.transform.batches if isinstance(data.transform, Categories) else []
    if plain := [data.input_names[i] for i in levels if i not in batches]:
        found.append(f"categories in {listed(plain)}")
    if batches:
        names = listed(data.input_names[i] for i in batches)
        found.append(f"offsets of {names}, whatever the other inputs are")
    if not found:
        return "Assumed: noise of one size, exact inputs, numbers that may be of any size."
    return f"Assumed: {'; '.join(found)}."


def _repeats(subject: Subject) -> list[str]:
    """The number of rows with the inputs of another, and the spread of their outputs."""
    _, index = subject.X.unique(dim=0, return_inverse=True)
    counts = index.bincount()
    repeated = int(counts[counts > 1].sum())
    if not repeated:
        return ["No two rows have the same inputs."]
    told = []
    for name, y in zip(subject.outputs, subject.Y.unbind(-1), strict=True):
        sd = _pooled_sd(y, index)
        told += [] if sd is None else [f"{with_unit(number(sd), name)} ({name_and_unit(name)[0]})"]
    by = f", and their outputs differ by a standard deviation of {', '.join(told)}"
    differ = by if told else ""
    return [f"{plural(repeated, 'row')} share their inputs with another{differ}."]


def _pooled_sd(y: Tensor, index: Tensor) -> float | None:
    """The standard deviation within groups of the same inputs."""
    squares, freedom = 0.0, 0
    for group in index.unique():
        own = y[(index == group) & ~y.isnan()]
        if len(own) > 1:
            squares += float((own - own.mean()).square().sum())
            freedom += len(own) - 1
    return (squares / freedom) ** 0.5 if freedom else None


def settings(subject: Subject, origin: Origin) -> Markup:
    """The settings, versions, and the date."""
    physics = ", ".join(f"{name} ({type(each).__name__})" for name, each in subject.physics.items())
    rows = [[name, value] for name, value in origin.settings.items()]
    rows += [
        ["model", repr(subject.model)],
        ["physics", physics or ("known through samples" if subject.has_physics else "none")],
    ]
    return settings_table(rows)


def settings_table(rows: list[list[str]]) -> Markup:
    """A table of settings, with versions and the date."""
    versions = [f"{name} {version(name)}" for name in _LIBRARIES]
    own = f"gpadjust {gpadjust.__version__}"
    rows = [*rows, ["versions", ", ".join([own, f"Python {platform.python_version()}", *versions])]]
    rows.append(["date", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")])
    return table("How this page came about", ["setting", "value"], rows, kind="words")


def loading(subject: Subject, saved: Saved | str, origin: Origin) -> Markup:
    """Code that loads the model beside the page and predicts; or why no model was saved."""
    if isinstance(saved, str):
        return tag("p", f"The model could not be saved: {saved}", class_="caution")
    file, missing = saved.path.name, saved.missing
    words = [f"The model is in {file}, beside this page; run this in its folder."]
    imports, arguments = ["import torch"], []
    if origin.physics is not None:
        imports += [f"import {module}" for module in origin.modules]
        if any(needs_inf(each) for each in origin.physics.values()):
            imports.insert(0, "from math import inf\n")
        made = [f"{n}, " for n in _MADE if any(f"{n}(" in each for each in origin.physics.values())]
        imports.append(f"from gpadjust import {''.join(made)}load")
        where = f"module{'s' * (len(origin.modules) > 1)} {listed(origin.modules)}"
        words.append(f"Python has to find the {where}: there, or in a folder on PYTHONPATH.")
        arguments.append(f"physics={_expression(origin.physics)}")
        missing = tuple(name for name in missing if name != "physics")
    else:
        imports.append("from gpadjust import load")
        if "physics" in missing:
            words.append(
                "The file could not hold the physics, which has no name in a module, or is known "
                "by runs: give what the model was built with as f_p."
            )
        elif saved.physics:
            by = [name for name in saved.physics if not is_formula(name)]
            told = f"The physics is found by its name: Python has to find {', '.join(by)}."
            words.append(told if by else "The file holds the formula.")
            arguments += ["trusted=True"] * bool(by)
    arguments += [f"{name}={'f_p' if name == 'physics' else name}" for name in missing]
    call = ", ".join([repr(file), *arguments])
    point = ", ".join(f"{x:.6g}" for x in subject.base.tolist())
    numbered = []
    for i, own in subject.names.items():
        each = [f"{k} is {name}" for k, name in enumerate(own)]
        each += ["any other number is a new one"] if i in subject.batches else []
        numbered.append(f"# {subject.inputs[i]}: {', '.join(each)}")
    lines = [
        *imports,
        "",
        f"model = load({call})",
        f"# a row for each point: {', '.join(map(repr, subject.inputs))}",
        *numbered,
        f"X = torch.tensor([[{point}]], dtype=torch.float64)",
        "",
        f"mean, variance = model.predict(X)  # of {', '.join(map(repr, subject.outputs))}",
        "lower, upper = model.interval(X, level=0.95)  # where the function is",
        "lower, upper = model.interval(X, level=0.95, observation_noise=True)  # a measurement",
    ]
    return join([tag("p", " ".join(words)), code("\n".join(lines))])


def _expression(physics: Mapping[str, str]) -> str:
    if [*physics] == [""]:
        return physics[""]
    return f"{{{', '.join(f'{name!r}: {each}' for name, each in physics.items())}}}"
