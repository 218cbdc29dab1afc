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
from gpadjust.physics.import_path import is_formula
from gpadjust.report import figures
from gpadjust.report import markup as html
from gpadjust.report.inputs import imports_of
from gpadjust.report.markup import Markup, join, table, tag
from gpadjust.report.subject import Origin, Subject
from gpadjust.validation.comparison import STACKED, spread_of
from gpadjust.validation.verdict import ALONE
from gpadjust.words import bare, listed, name_and_unit, number, percent, plural, with_unit

_STRUCTURES = {
    "zero mean": "no physics: a Gaussian process of the data alone",
    "physics mean": "f_p + delta(x): the physics, and a bias that depends on the inputs",
    "CKA": "rho(x) f_p + delta(x): a scale and a bias that depend on the inputs",
    "calibrated physics": "f_p with fitted parameters, and nothing else",
    ALONE: "f_p as it is, with noise that the other observations tell; no candidate",
    STACKED: "the mixture of all structures with the weights of the table",
}
_ELPD = (
    "elpd is the log density of left-out observations, summed, in nats: higher is better. A "
    "difference of less than two of its errors shows nothing. RMSE is of the left-out "
    "predictions, sd is that of the observations, 'in 95 %' the share of left-out observations "
    "within their 95 % intervals, and 'of use' the probability that the formula is of use, by "
    "nested models with and without it. Weights are those of the mixture that predicts left-out "
    "observations best: of structures that predict alike one may have all of it, also one that is "
    "not the first."
)
_COVERAGE = (
    "If intervals are honest, those of 95 % hold 95 % of left-out observations, but for chance: "
    "the fourth column has the range that 95 of 100 honest models would be in. The values of the "
    "histogram (PIT: where each observation fell within its prediction) are then evenly spread; a "
    "U is too sure, a hill too careful."
)
_PARAMETERS = (
    "Values are means on the scale of what was known before (of a factor, geometric means). "
    "A bias that is free to vary leaves open which values are the true ones: these describe the "
    "system best together with it."
)
_UNTOLD = "By {}, the data say next to nothing of {}, which {} as known before."
_SUMMARY = (
    "In the units of the data; of samples the median, and the range of 95 % of them. A lengthscale "
    "is the distance over which a function changes, sd how much. Means are those of the prior; "
    "what was learnt of rho and delta is in the figures."
)
_NOISES: dict[type[Noise], str] = {
    KnownNoise: "noise of known variance",
    RelativeNoise: "noise that grows with the physics, beside a constant one (relative)",
    HeavyTails: "noise with heavy tails, so that outliers count for little",
}
_WORST = 5
_LEVELS = (0.5, 0.8, 0.95)


def described(structure: str) -> str:
    """Return the description of a structure, with the physics if it is of one of several."""
    short, of, physics = structure.partition(" of ")
    return _STRUCTURES.get(short, "a structure of your own") + f" ({physics})" * bool(of)


def structures(subject: Subject) -> Markup:
    """Return the table of each output, and descriptions; or the weights of a mixture."""
    comparison, model = subject.comparison, subject.model
    if comparison is None:
        weights = model.weights if isinstance(model, StackedGP) else {}
        rows = [[name, *map("{:.2f}".format, own)] for name, own in weights.items()]
        head = ["structure", *subject.outputs]
        return table("Weights of the mixture", head, rows) if rows else Markup()
    parts, names = [], dict[str, None]()
    for output in comparison.table:
        head = ["structure", "elpd", "less the best", "its error", "weight"]
        head += [with_unit("RMSE", output, "{} [{}]"), "RMSE / sd", "in 95 %", "of use"]
        rows = []
        for row in comparison.table[output]:
            weight = "-" if math.isnan(row.weight) else f"{row.weight:.2f}"
            elpd = [f"{row.elpd:.4g}", f"{row.elpd_diff:.3g}", f"{row.se_diff:.2g}", weight]
            rmse = [number(row.error), f"{row.rmse:.3g}", percent(row.coverage)]
            of_use = "-" if math.isnan(row.of_use) else f"{row.of_use:.2f}"
            rows.append([row.structure, *elpd, *rmse, of_use])
            names[row.structure] = None
        parts.append(table(f"Left-out predictions of {output}, best first", head, rows, marked=0))
    terms = [join([tag("dt", name), tag("dd", described(name))]) for name in names]
    return join([*parts, tag("p", _ELPD), tag("dl", *terms)])


def predictions(subject: Subject) -> Markup:
    """Return the errors of left-out predictions, and the observations predicted worst."""
    how = "Each observation is predicted by a model that has not seen it"
    if subject.comparison is not None:
        how += ", as in the table above. Of a mixture its weights, which have seen all, stay."
    elif isinstance(subject.model, GP) and len(subject.model.u) == 1:
        how = (
            "Each observation is predicted from all others; hyper-parameters (and fitted "
            "parameters of the physics) stay as they are, and have seen it: with few data the "
            "errors are too small."
        )
    else:
        how += ", nor have its hyper-parameters: their samples are weighted again for each."
    parts = [tag("p", how)]
    counts = (~subject.judged.isnan()).sum(0).tolist()
    for j, name in enumerate(subject.outputs):
        rmse = float(subject.loo.score().rmse[j])
        share = percent(rmse / spread_of(subject.Y[:, j]))
        words = (
            f"{name}: {plural(counts[j], 'observation')}, root mean square error "
            f"{with_unit(number(rmse), name)}, {share} of the standard deviation of the "
            "observations."
        )
        if out := subject.outliers(j):
            are = "is taken for an outlier" if len(out) == 1 else "are taken for outliers"
            words += f" {listed(out)} {are}: errors and coverage on this page leave them out."
        parts += [tag("p", words), figures.left_out(subject, j), _worst(subject, j)]
    return join(parts)


def _worst(subject: Subject, j: int) -> Markup:
    """Return the observations that are farthest from their predictions, in standard deviations."""
    loo, name, outliers = subject.loo, subject.outputs[j], {*subject.outliers(j)}
    distance = loo.residuals[:, j].abs().nan_to_num(nan=-1.0)
    if loo.is_outlier is not None:
        distance = distance.masked_fill(loo.is_outlier[:, j], torch.inf)
    order = [i for i in distance.argsort(descending=True).tolist() if distance[i] >= 0][:_WORST]
    inputs = subject.inputs if len(subject.inputs) <= 4 else ()
    head = ["", *(with_unit(what, name, "{} [{}]") for what in ("observed", "predicted"))]
    rows, (low, high) = [], loo.interval()
    for i in order:
        observed, mean = (number(each[i, j], 4) for each in (loo.Y, loo.mean))
        interval = f"{number(low[i, j], 4)} to {number(high[i, j], 4)}"
        cells = [observed, mean, interval, f"{loo.residuals[i, j]:+.1f}"]
        cells += figures.point(subject, subject.X[i]) if inputs else []
        rows.append([subject.rows[i] + " (outlier)" * (subject.rows[i] in outliers), *cells])
    caption = f"The {len(rows)} observations of {name} that are farthest from their predictions"
    return table(caption, [*head, "95 %", "residual / sd", *inputs], rows)


def coverage(subject: Subject) -> Markup:
    """Return the coverage of the intervals of left-out observations."""
    rows, images = [], []
    shares = {level: subject.loo.score(level).coverage for level in _LEVELS}
    counts = (~subject.judged.isnan()).sum(0).tolist()
    for j, (name, n) in enumerate(zip(subject.outputs, counts, strict=True)):
        for level, share in shares.items():
            low, high = (int(binom.ppf(p, n, level)) for p in (0.025, 0.975))
            held = round(float(share[j]) * n)
            says = "too narrow" if held < low else "too wide" if held > high else "in that range"
            cells = [f"{held} of {n}", percent(share[j]), f"{low} to {high} of {n}", says]
            rows.append([f"{name}, {percent(level)}", *cells])
        images.append(figures.coverages(subject, j))
    head = ["interval", "holds", "share", "if they hold", "the intervals are"]
    return join([tag("p", _COVERAGE), table("Coverage of left-out intervals", head, rows), *images])


def parameters(subject: Subject) -> Markup:
    """Return prior and posterior of the physics' unknown parameters; nothing if it has none."""
    by, shown = "Parameters of the physics, by {}".format, [own for own in subject.adjusted if own]
    known = {by(own.structure): (own.structure, own.model.physics_parameters) for own in shown}
    for name, model in ({} if subject.comparison is None else subject.comparison.models).items():
        if isinstance(model, CalibratedPhysics) and by(name) not in known:
            caption = f"Parameters of the physics by itself, with noise ({name})"
            known[caption] = name, model.physics_parameters
    parts: list[Markup] = []
    for caption, (structure, own) in known.items():
        if own:
            parts += [html.parameter_table(caption, own), figures.densities(own)]
            if own.untold:
                stay = "stays" if len(own.untold) == 1 else "stay"
                parts.append(tag("p", _UNTOLD.format(structure, listed(own.untold), stay)))
    return join([*parts, tag("p", _PARAMETERS)]) if parts else Markup()


def summary(subject: Subject) -> Markup:
    """Return the summary of what predicts, in the user's units."""
    title, text = tag("summary", "All hyper-parameters"), html.code(subject.model.summary())
    return join([tag("p", _SUMMARY), tag("details", title, text, open="")])


def data(subject: Subject, remarks: tuple[str, ...]) -> Markup:
    """Return an overview of the columns, and what is missing, repeated or assumed."""
    rows: list[list[str]] = []
    kinds = (("input", subject.inputs, subject.X), ("output", subject.outputs, subject.Y))
    for kind, names, values in kinds:
        for name, column in zip(names, values.unbind(-1), strict=True):
            known = column[~column.isnan()]
            short, unit = name_and_unit(name)
            numbers = [number(end, 4) for end in (known.min(), known.quantile(0.5), known.max())]
            if kind == "input" and len(rows) in subject.levels:  # of which none is the least
                numbers = ["-"] * 3
            rows.append([short, kind, unit or "-", *numbers, str(len(column) - len(known))])
    head = ["column", "is", "unit", "least", "median", "most", "missing"]
    first = [f"{plural(len(subject.X), 'row')} of data.", _repeats(subject)]
    items = html.bullets([*first, *remarks, _assumed(subject.model)])
    return join([table("Columns", head, rows), items])


def _repeats(subject: Subject) -> str:
    """Return the number of rows with the inputs of another, and the spread of their outputs."""
    _, index = subject.X.unique(dim=0, return_inverse=True)
    counts = index.bincount()
    repeated = int(counts[counts > 1].sum())
    if not repeated:
        return "No two rows have the same inputs."
    spreads = []
    for name, y in zip(subject.outputs, subject.Y.unbind(-1), strict=True):
        groups = [y[(index == group) & ~y.isnan()] for group in range(len(counts))]
        groups = [group - group.mean() for group in groups if len(group) > 1]
        if groups:
            sd = (torch.cat(groups).square().sum() / sum(len(g) - 1 for g in groups)).sqrt()
            spreads.append(f"{with_unit(number(sd), name)} ({bare(name)})")
    by = f", and their outputs differ by a standard deviation of {', '.join(spreads)}"
    differ = by if spreads else ""
    return f"{plural(repeated, 'row')} share their inputs with another{differ}."


def _assumed(model: GP | StackedGP) -> str:
    """Return what a model takes its data for, in a sentence."""
    one: Any = model.models[0] if isinstance(model, StackedGP) else model
    inputs, transform = one.data.input_names, one.data.transform
    noises = [one.noise]
    while isinstance(noises[-1], RowNoise):
        noises.append(noises[-1].base)
    words = [_NOISES[kind] for kind in _NOISES if any(isinstance(noise, kind) for noise in noises)]
    for noise in noises:
        if isinstance(noise, NoisyInputs):
            pairs = zip(inputs, noise.settings["variances"].mean(0).sqrt(), strict=True)
            sds = [f"{bare(n)} by {with_unit(number(s), n)}" for n, s in pairs if s > 0]
            noisy = f"inputs that are noisy themselves: {listed(sds)} (standard deviations)"
            words.append(noisy)
    if (link := getattr(one, "link", None)) is not None:
        outputs = listed(bare(name) for name in one.data.output_names)
        below = f" and below {link.upper:g}" * math.isfinite(link.upper)
        words.append(f"{outputs} above {link.lower:g}{below}")
    if isinstance(transform, Categories):
        batches = [inputs[i] for i in transform.batches]
        plain = [inputs[i] for i in transform.levels if i not in transform.batches]
        words += [f"categories in {listed(plain)}"] * bool(plain)
        offsets = f"offsets of {listed(batches)}, whatever the other inputs are"
        words += [offsets] * bool(batches)
    default = "noise of one size, exact inputs, numbers that may be of any size"
    return f"Assumed: {'; '.join(words or [default])}."


def loading(subject: Subject, saved: Saved | str, origin: Origin) -> Markup:
    """Return code that loads the model beside the page; or the reason why no model was saved."""
    if isinstance(saved, str):
        return tag("p", f"The model could not be saved: {saved}", class_="caution")
    file, missing = saved.path.name, [*saved.missing]
    words = [f"The model is in {file}, beside this page; run this in its folder."]
    arguments = [repr(file)]
    if origin.physics:
        where = f"module{'s' * (len(origin.modules) > 1)} {listed(origin.modules)}"
        words.append(f"Python has to find the {where}: there, or in a folder on PYTHONPATH.")
        arguments.append(f"physics={origin.physics}")
        missing = [name for name in missing if name != "physics"]
    elif "physics" in missing:
        words.append(
            "The file could not hold the physics, which has no name in a module, or is known by "
            "runs: give what the model was built with as f_p."
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
    for i, own in subject.levels.items():
        levels = [f"{k} is {name}" for k, name in enumerate(own)]
        if i in subject.batches:
            levels.append("any other number is a new one")
        lines.append(f"# {subject.inputs[i]}: {', '.join(levels)}")
    point = ", ".join(f"{x:.6g}" for x in subject.base.tolist())
    lines += [
        f"X = torch.tensor([[{point}]], dtype=torch.float64)",
        "",
        f"mean, variance = model.predict(X)  # of {', '.join(map(repr, subject.outputs))}",
        "lower, upper = model.interval(X, level=0.95)  # where the function is",
        "lower, upper = model.interval(X, level=0.95, observation_noise=True)  # a measurement",
    ]
    return join([tag("p", " ".join(words)), html.code("\n".join(lines))])
