"""Sections of words and tables of a page about a model or a comparison."""

from __future__ import annotations

import math
from typing import Any

import torch
from scipy.stats import binom

from gpadjust.core import GP, CalibratedPhysics, KnownNoise, Noise, StackedGP
from gpadjust.core.saving import Saved
from gpadjust.kinds import Categories, HeavyTails, NoisyInputs, RelativeNoise
from gpadjust.kinds.heavy_tails import RowNoise
from gpadjust.kinds.links import Link
from gpadjust.physics import PhysicsParameters
from gpadjust.physics.import_path import is_formula
from gpadjust.report import figures
from gpadjust.report import markup as html
from gpadjust.report.inputs import imports_of
from gpadjust.report.markup import Markup, join, table, tag
from gpadjust.report.subject import Origin, Subject
from gpadjust.validation.comparison import STACKED, cells_of, spread_of
from gpadjust.validation.verdict import ALONE, point_in_words
from gpadjust.words import bare, listed, name_and_unit, noted, number, percent, plural, with_unit

_STRUCTURES = {
    "zero mean": "no physics: a Gaussian process of the data alone",
    "physics mean": "formula + delta(x): the formula, and a bias that depends on the inputs",
    "CKA": "rho(x) formula + delta(x): a scale and a bias that depend on the inputs",
    "calibrated physics": "the formula with fitted parameters, and nothing else",
    ALONE: "the formula as it is, with noise fitted to the other observations; not a candidate",
    STACKED: "the mixture of all structures with the weights of the table",
}
_ELPD = (
    "elpd: log density of left-out observations, summed, in nats; higher is better, and a "
    "difference of less than two of its errors shows nothing. RMSE: of left-out predictions; sd: "
    "of the observations. In 95 %: share of left-out observations within their 95 % intervals. Of "
    "use: probability that the formula is of use, by nested models. Weights: of the mixture that "
    "predicts left-out observations best; of structures that predict alike one may have all of it."
)
_COVERAGE = (
    "The 95 % intervals of a right model cover 95 % of left-out observations, but for chance: the "
    "fourth column has the range of 95 of 100 such models. Below the diagonal of the figure "
    "intervals are too narrow, above it too wide."
)
_PARAMETERS = (
    "Values are means on the scale of the prior (of a factor, geometric means). With a bias that "
    "is free to vary the true values remain open: these describe the system best together with it."
)
_UNKNOWN = "By {}, the data barely constrain {}: the posterior is about the prior."
_SUMMARY = (
    "In the units of the data; the median of draws, and the range of 95 % of them. A lengthscale "
    "is the distance over which a function changes, sd its size. Means are those of the prior; the "
    "figures show rho and delta as fitted."
)
_NOISES: dict[type[Noise], str] = {
    KnownNoise: "noise of known variance",
    RelativeNoise: "noise that grows with the formula, in addition to a constant one (relative)",
    HeavyTails: "noise with heavy tails, so that outliers count for little",
}
_WORST = 5  # observations in a table
_LEVELS = (0.5, 0.8, 0.95)


def described(structure: str, link: Link | None) -> str:
    """Return the description of a structure, with its scale, and its physics if one of several."""
    kind, _, physics = structure.partition(" of ")
    text = _STRUCTURES.get(kind, "your own structure")
    if link is not None and "delta(x)" in text:
        text += f", on the scale of {link.formula}"
    return noted(text, physics)


def structures(subject: Subject) -> Markup:
    """Return the table of each output, and descriptions; or the weights of a mixture."""
    comparison = subject.comparison
    model = subject.model
    if comparison is None:
        if not isinstance(model, StackedGP):
            return Markup()
        weights = model.weights.items()
        rows = [[name, *map("{:.2f}".format, shares)] for name, shares in weights]
        return table("Weights of the mixture", ["structure", *subject.outputs], rows)
    parts = []
    names = dict[str, None]()
    for output, candidates in comparison.table.items():
        head = ["structure", "elpd", "less the best", "its error", "weight"]
        head += [with_unit("RMSE", output, "{} [{}]"), "RMSE / sd", "in 95 %", "of use"]
        rows = []
        for row in candidates:
            *first, weight, relative, _, of_use = cells_of(row).values()
            errors = [number(row.error), relative, percent(row.coverage)]
            rows.append([row.structure, *first, weight, *errors, of_use])
            names[row.structure] = None  # in their order, each once
        parts.append(table(f"Left-out predictions of {output}, best first", head, rows, marked=0))
    terms = [join([tag("dt", name), tag("dd", described(name, subject.link))]) for name in names]
    return join([*parts, tag("p", _ELPD), tag("dl", *terms)])


def predictions(subject: Subject) -> Markup:
    """Return the errors of left-out predictions, and the observations predicted worst."""
    how = "Each observation is predicted by a model that has not seen it"
    if subject.comparison is not None:
        how += ", as in the table of structures."
        if subject.comparison.chosen == STACKED:
            how += " The weights of the mixture have seen all of them."
    elif isinstance(subject.model, GP) and len(subject.model.u) == 1:
        how = (
            "Each observation is predicted from all others; hyper-parameters (and fitted "
            "parameters of the physics) stay as they are, and have seen it: with few data the "
            "errors are too small."
        )
    else:
        how += ", nor have its hyper-parameters: their draws are weighted again for each."
    parts = [tag("p", how)]
    counts = (~subject.loo.judged.isnan()).sum(0).tolist()  # without missing ones and outliers
    for j, name in enumerate(subject.outputs):
        rmse = float(subject.loo.score().rmse[j])
        share = percent(rmse / spread_of(subject.Y[:, j]))
        words = (
            f"{name}: {plural(counts[j], 'observation')}, root mean square error "
            f"{with_unit(number(rmse), name)}, {share} of the standard deviation of the "
            "observations."
        )
        if rows := subject.outliers(j):
            words += f" Taken for outliers, and not in errors and coverage here: {listed(rows)}."
        parts += [tag("p", words), figures.left_out(subject, j), _worst(subject, j)]
    return join(parts)


def _worst(subject: Subject, j: int) -> Markup:
    """Return the observations that are farthest from their predictions, in standard deviations."""
    loo = subject.loo
    name = subject.outputs[j]
    outliers = subject.outliers(j)
    distance = loo.residuals[:, j].abs().nan_to_num(nan=-1.0)  # a missing one is the last
    if loo.is_outlier is not None:  # an outlier is farther than all others
        distance = distance.masked_fill(loo.is_outlier[:, j], math.inf)
    order = [i for i in distance.argsort(descending=True).tolist() if distance[i] >= 0][:_WORST]
    has_room = len(subject.inputs) <= 4
    head = ["", with_unit("observed", name, "{} [{}]"), with_unit("predicted", name, "{} [{}]")]
    head += ["95 %", "residual / sd"]
    if has_room:
        head += subject.inputs
    low, high = loo.interval()
    rows = []
    for i in order:
        interval = f"{number(low[i, j], 4)} to {number(high[i, j], 4)}"
        cells = [number(loo.Y[i, j], 4), number(loo.mean[i, j], 4), interval]
        cells.append(f"{loo.residuals[i, j]:+.1f}")
        if has_room:
            cells += point_in_words(subject.X[i], subject.levels, 4)
        row = subject.rows[i]
        if row in outliers:
            row = noted(row, "outlier")
        rows.append([row, *cells])
    caption = f"The {len(rows)} observations of {name} that are farthest from their predictions"
    return table(caption, head, rows)


def coverage(subject: Subject) -> Markup:
    """Return the coverage of the intervals of left-out observations."""
    rows, images = [], []
    shares = {level: subject.loo.score(level).coverage for level in _LEVELS}
    counts = (~subject.loo.judged.isnan()).sum(0).tolist()
    for j, (name, n) in enumerate(zip(subject.outputs, counts, strict=True)):
        for level, share in shares.items():
            # 95 % of the counts of n observations that are each covered with this probability
            low, high = (int(binom.ppf(p, n, level)) for p in (0.025, 0.975))
            covered = round(float(share[j]) * n)
            verdict = "in that range"
            if not low <= covered <= high:
                verdict = "too narrow" if covered < low else "too wide"
            cells = [f"{covered} of {n}", percent(share[j]), f"{low} to {high} of {n}", verdict]
            rows.append([f"{name}, {percent(level)}", *cells])
        images.append(figures.coverages(subject, j))
    head = ["interval", "covers", "share", "if right", "the intervals are"]
    return join([tag("p", _COVERAGE), table("Coverage of left-out intervals", head, rows), *images])


def parameters(subject: Subject) -> Markup:
    """Return prior and posterior of the physics' unknown parameters; nothing if it has none."""
    caption = "Parameters of the physics, by {}"
    tables: dict[str, tuple[str, PhysicsParameters]] = {}
    # Of the model that adjusts the physics, and of the physics calibrated by itself.
    for shown in subject.adjusted:
        if shown is not None:
            by = caption.format(shown.structure)
            tables[by] = shown.structure, shown.model.physics_parameters
    for name, model in getattr(subject.comparison, "models", {}).items():
        if isinstance(model, CalibratedPhysics) and caption.format(name) not in tables:
            by = f"Parameters of the physics by itself, with noise ({name})"
            tables[by] = name, model.physics_parameters
    parts: list[Markup] = []
    for by, (structure, posterior) in tables.items():
        if posterior:
            parts += [html.parameter_table(by, posterior), figures.densities(posterior)]
            if names := posterior.untold:
                parts.append(tag("p", _UNKNOWN.format(structure, listed(names))))
    if parts:
        parts.append(tag("p", _PARAMETERS))
    return join(parts)


def summary(subject: Subject) -> Markup:
    """Return the summary of the model, in the user's units."""
    title = tag("summary", "All hyper-parameters")
    text = html.code(subject.model.summary())
    return join([tag("p", _SUMMARY), tag("details", title, text, open="")])


def data(subject: Subject, remarks: tuple[str, ...]) -> Markup:
    """Return an overview of the columns, remarks on the rows, and assumptions."""
    rows: list[list[str]] = []
    kinds = (("input", subject.inputs, subject.X), ("output", subject.outputs, subject.Y))
    for kind, names, values in kinds:
        for name, column in zip(names, values.unbind(-1), strict=True):
            numbers = column[~column.isnan()]
            short, unit = name_and_unit(name)
            ends = [number(x, 4) for x in (numbers.min(), numbers.quantile(0.5), numbers.max())]
            if kind == "input" and len(rows) in subject.levels:  # categories have no order
                ends = ["-"] * 3
            rows.append([short, kind, unit or "-", *ends, str(len(column) - len(numbers))])
    head = ["column", "is", "unit", "least", "median", "most", "missing"]
    first = f"{plural(len(subject.X), 'row')} of data. {_repeats(subject)}"
    items = html.bullets([first, *remarks, _assumed(subject)])
    return join([table("Columns", head, rows), items])


def _repeats(subject: Subject) -> str:
    """Return the number of rows with the inputs of another, and the spread of their outputs."""
    _, index, counts = subject.X.unique(dim=0, return_inverse=True, return_counts=True)
    repeated = counts > 1
    if not repeated.any():
        return "No two rows have the same inputs."
    spreads = []
    for name, y in zip(subject.outputs, subject.Y.unbind(-1), strict=True):
        groups = [y[(index == group) & ~y.isnan()] for group in repeated.nonzero()]
        errors = [group - group.mean() for group in groups if len(group) > 1]
        if errors:
            # s^2 = sum (y - mean of its group)^2 / (n - groups)
            sd = (torch.cat(errors).square().sum() / sum(len(e) - 1 for e in errors)).sqrt()
            spreads.append(f"{with_unit(number(sd), name)} ({bare(name)})")
    same = f"{plural(int(counts[repeated].sum()), 'row')} share their inputs with another"
    if not spreads:
        return f"{same}."
    return f"{same}, and their outputs differ by a standard deviation of {', '.join(spreads)}."


def _assumed(subject: Subject) -> str:
    """Return the assumptions of a model on its data, in a sentence."""
    part: Any = getattr(subject.model, "models", [subject.model])[0]
    inputs = subject.inputs
    transform = part.data.transform
    noises = [part.noise]
    while isinstance(noises[-1], RowNoise):
        noises.append(noises[-1].base)
    words = [_NOISES[kind] for kind in _NOISES if any(isinstance(noise, kind) for noise in noises)]
    for noise in noises:  # one within the other
        if isinstance(noise, NoisyInputs):
            pairs = zip(inputs, noise.settings["variances"].mean(0).sqrt(), strict=True)
            sds = [f"{bare(n)} by {with_unit(number(s), n)}" for n, s in pairs if s > 0]
            words.append(f"inputs that are noisy themselves: {listed(sds)} (standard deviations)")
    if (link := subject.link) is not None:
        bounds = f"{listed(map(bare, subject.outputs))} above {link.lower:g}"
        if math.isfinite(link.upper):
            bounds += f" and below {link.upper:g}"
        words.append(bounds)
    if isinstance(transform, Categories):
        batches = [inputs[i] for i in transform.batches]
        plain = [inputs[i] for i in transform.levels if i not in transform.batches]
        if plain:
            words.append(f"categories in {listed(plain)}")
        if batches:
            words.append(f"offsets of {listed(batches)}, whatever the other inputs are")
    default = "noise of one size, exact inputs, numbers that may be of any size"
    return f"Assumed: {'; '.join(words or [default])}."


def loading(subject: Subject, saved: Saved | str, origin: Origin) -> Markup:
    """Return code that loads the model beside the page; or the reason why no model was saved."""
    if isinstance(saved, str):
        return tag("p", f"The model could not be saved: {saved}", class_="caution")
    file = saved.path.name
    missing = [*saved.missing]
    words = [f"The model is in {file}, beside this page; run this in its folder."]
    arguments = [repr(file)]
    # The file may hold the physics, or its name, or neither.
    if origin.physics:
        words.append(f"Python imports {listed(origin.modules)} from there, or from PYTHONPATH.")
        arguments.append(f"physics={origin.physics}")
        missing = [name for name in missing if name != "physics"]
    elif "physics" in missing:
        words.append(
            "The file could not hold the physics, which has no name in a module, or is known by "
            "runs: give the physics with which the model was built as f_p."
        )
    elif paths := [path for path in saved.physics if not is_formula(path)]:
        words.append(f"The physics is found by its name: Python has to find {', '.join(paths)}.")
        arguments.append("trusted=True")
    elif saved.physics:
        words.append("The file holds the formula.")
    arguments += [f"{name}={'f_p' if name == 'physics' else name}" for name in missing]
    lines = [
        imports_of(origin.physics, origin.modules, "load"),
        "",
        f"model = load({', '.join(arguments)})",
        f"# a row for each point: {', '.join(map(repr, subject.inputs))}",
    ]
    for i, names in subject.levels.items():
        levels = [f"{k} is {name}" for k, name in enumerate(names)]
        if i in subject.batches:
            levels.append("any other number is a new one")
        lines.append(f"# {subject.inputs[i]}: {', '.join(levels)}")
    point = ", ".join(f"{x:.6g}" for x in subject.base.tolist())  # in the middle of the data
    lines += [
        f"X = torch.tensor([[{point}]], dtype=torch.float64)",
        "",
        f"mean, variance = model.predict(X)  # of {', '.join(map(repr, subject.outputs))}",
        "lower, upper = model.interval(X, level=0.95)  # of the function",
        "lower, upper = model.interval(X, level=0.95, observation_noise=True)  # of a measurement",
    ]
    return join([tag("p", " ".join(words)), html.code("\n".join(lines))])
