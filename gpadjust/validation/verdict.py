"""The verdict on a physics, in words: should one use it, as it is or corrected?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP, FitResult
from gpadjust.kinds.categories import Levels, levels_of, numbers_of, on_levels
from gpadjust.physics import PhysicsError
from gpadjust.validation.faults import Fault, is_constant, rms
from gpadjust.validation.trust import physics_at
from gpadjust.words import bare, listed, number, with_unit

ALONE, CALIBRATED, ADJUSTED = "physics alone", "calibrated physics", "adjusted"
DATA = "data alone"
AS_IS, CORRECTED = "Use your formula as it is", "Use it corrected"
NOT, OPEN = "Do not use it", "These data do not tell"
FAULTY = "Correct your formula"
_ROUNDING = 1e-9  # relative; less is rounding
_SURE = 2.0  # standard errors that a difference takes to be real
_ENOUGH = 8  # observations of different inputs, for any answer
_LEAST = 1.0  # nats; a smaller difference shows nothing
_SURELY = 0.95  # probability with which nested models decide
_EVEN = 0.5  # probability below which a correction is not believed for a smaller error alone
_LARGER = 1.1  # times as large; by less, errors are equal
_HARDLY = 10.0  # times the error of the data alone: a formula that hardly describes them
_TINY_SHARE = 0.05  # of the median size of f_p: less is too little for a share of it
_POINTS = 256  # among which the next observation is looked for
_APART_BY = 0.3  # standard deviations: predictions that are nearer are the same
_NAMED = 3  # inputs of a point that a sentence has room for
_NEGLIGIBLE = 0.1  # of the error; a smaller offset is not named
COUNTS = 0.05  # weight with which a structure is a part of what is recommended


class Candidate(NamedTuple):
    """Quality of the predictions of an output's left-out observations by a structure.

    Attributes:
        structure: Its name.
        elpd: Expected log predictive density, the sum over the observations, in nats.
        elpd_diff: Difference from the elpd of the best structure; 0 for the best.
        se_diff: The standard error of this difference.
        weight: Its weight in the stacked model; NaN of a physics alone, which has none.
        rmse: Root mean square error, relative to the standard deviation of the observations.
        coverage: Share of the observations within their 95 % intervals.
        error: Root mean square error, in the output's units.
        log_evidence: The log evidence of the fit; NaN if unknown.
        of_use: Probability that the physics is of use, by nested models; NaN if unknown.
        kind: ``"physics alone"``, ``"calibrated physics"``, ``"adjusted"`` or ``"data alone"``.
    """

    structure: str
    elpd: float
    elpd_diff: float
    se_diff: float
    weight: float
    rmse: float
    coverage: float
    error: float
    log_evidence: float
    of_use: float
    kind: str


class Verdict(NamedTuple):
    """The verdict on a physics for an output: should one use it?

    Attributes:
        answer: ``"Use your formula as it is"``, ``"Use it corrected"``, ``"Do not use it"``,
            ``"These data do not tell"``, or of an obvious fault ``"Correct your formula: "`` with
            its cause, such as ``"it is about 1,000 times too large"``.
        reasons: The reasons, in sentences.
        factor: Factor of the formula where it is used as it is.
        offset: Its offset then, in the unit of the output.
    """

    answer: str
    reasons: list[str]
    factor: float = 1.0
    offset: float = 0.0


class Evidence(NamedTuple):
    """The evidence for a verdict on an output; errors are root mean squares of left-out ones."""

    name: str  # of the output, with its unit
    number: int  # of observations, those of the same inputs taken together
    of_use: float  # probability by nested models with and without the physics; NaN without these
    gain: float  # of the expected log predictive density by the physics, in nats
    se: float  # its standard error
    adjusted: float  # error by the best structure that adjusts the formula
    data: float  # error by the best structure without it
    alone: float = math.nan  # error by the formula, its parameters fitted; NaN of several
    line: float = math.nan  # error by the formula up to the factor and offset
    factor: float = math.nan  # of the straight line through observations over the formula
    offset: float = math.nan  # of this line
    fault: Fault | None = None  # the obvious fault of the formula
    is_surpassed: bool = False  # whether densities show that the correction is needed
    correction_needed: float = math.nan  # probability by nested models; NaN without these

    def in_unit(self, error: float) -> str:
        """Return an error with the unit of the output."""
        return with_unit(number(error), self.name)


def name_of(kind: str, physics: str) -> str:
    """Return the name of a structure of one of several physics, such as ``CKA of coarse``."""
    return f"{kind} of {physics}" if physics else kind


def difference(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Return the difference of two elpd, and its standard error (Vehtari et al. 2017, eq. 24)."""
    gains = first - second
    # sqrt(n) times the standard deviation of the n differences
    return gains.sum().item(), math.sqrt(len(gains)) * gains.std(correction=0).item()


def formulas_of(comparison: Any, names: Sequence[str], j: int) -> dict[str, Tensor]:
    """Return output j of each physics at the data, with unknown parameters as they were fitted."""
    rows = [*comparison.table.values()][j]
    values = {}
    for name in names:
        alone = [name_of(kind, name) for kind in (ALONE, CALIBRATED)]
        predicted = [comparison.left_out[key] for key in alone if key in comparison.left_out]
        adjusted = [comparison.models[row.structure] for row in rows if row.kind == ADJUSTED]
        models = [model for model in adjusted if len(model.physics) == 1]
        if predicted:
            values[name] = predicted[0].mean[:, j]
        elif models and not name:  # its parameters are those of the best structure
            (f,) = physics_at(models[0], models[0].data.X).values()
            values[name] = f[:, j]
    return values


def verdict_of(c: Any, j: int, f: Tensor | None, fault: Fault | None) -> Verdict | None:
    """Return the verdict on output j, of a physics with values f; None if nothing is compared."""
    output, rows = [*c.table.items()][j]
    rows = [row for row in rows if row.structure in c.models]
    best = next((row for row in rows if row.kind != DATA), None)
    without = next((row for row in rows if row.kind == DATA), None)
    if best is None or without is None:
        return None
    adjusted = next((row for row in rows if row.kind == ADJUSTED), best)
    model = c.models[adjusted.structure]
    densities = {name: loo.densities_of(j) for name, loo in c.left_out.items()}
    errors = c.errors()[output]
    gain, se = difference(densities[best.structure], densities[without.structure])
    of_use = best.of_use
    if math.isnan(of_use):
        of_use = max((row.of_use for row in rows if not math.isnan(row.of_use)), default=math.nan)
    evidence = Evidence(
        output,
        number=len(densities[without.structure]),
        of_use=of_use,
        gain=gain,
        se=se,
        adjusted=errors.get(ADJUSTED, best.error),
        data=errors[DATA],
        fault=fault,
        correction_needed=_correction_needed(model, c.results[adjusted.structure], j),
    )
    correction = ""
    if f is not None:  # of several physics there is no error of the formula
        y = c.left_out[best.structure].judged[:, j]
        is_judged = ~y.isnan()
        factor, offset, line = straight_line(y[is_judged], f[is_judged])
        alone = rms((y - f)[is_judged])
        evidence = evidence._replace(alone=alone, line=line, factor=factor, offset=offset)
        formula = densities.get(ALONE, densities.get(CALIBRATED))
        if formula is not None:
            corrected = difference(densities[adjusted.structure], formula)
            evidence = evidence._replace(is_surpassed=is_clear(*corrected))
        # That of the recommended model, if it is one that adjusts the formula.
        names = {row.structure for row in rows if row.kind == ADJUSTED}
        correction = correction_of(c.models[c.chosen] if c.chosen in names else model, j, f)
    return verdict_on(evidence, correction, next_point(model, c.models[without.structure], j))


def _correction_needed(model: GP, result: FitResult, j: int) -> float:
    """Return the probability that f_p of output j needs a correction; NaN if unknown."""
    for choice in model.table.choices:
        if not choice.zeros and choice.text in result.probabilities:
            return result.probabilities[choice.text][j]
    return math.nan


def verdict_on(e: Evidence, correction: str, next_point: str) -> Verdict:
    """Return the verdict that evidence allows.

    The probability of nested models decides whether the formula is of use, unless left-out
    observations contradict it; their errors decide whether it needs a correction. The largest
    correction and the most useful next point are in words, or empty.
    """
    if e.fault is not None:
        return _faulty(e.fault)
    where = " Observe where the formula has other values."
    if next_point:
        where = f" More observations would tell, the first one {next_point}."
    return _undecided(e, where) or _as_it_is(e) or _corrected(e, correction)


def _faulty(fault: Fault) -> Verdict:
    """Return the verdict on a formula with an obvious fault."""
    reason = fault.text[0].upper() + fault.text[1:]
    way_out = "Correct it and run again; no other answer is worth much."
    return Verdict(f"{FAULTY}: {fault.cause}", [reason, way_out])


def _undecided(e: Evidence, where: str) -> Verdict | None:
    """Return the verdict if the data do not tell, or tell that the formula is of no use."""
    if e.number < _ENOUGH:
        few = f"It takes at least {_ENOUGH} observations of different inputs, and there are"
        return Verdict(OPEN, [f"{few} {e.number}.{where}"])
    if e.factor == 0:
        same = "Your formula has the same value at all observations, so they cannot judge it."
        return Verdict(OPEN, [f"{same} Observe where it differs."])

    compared = f"Without it the error is {e.in_unit(e.data)}, with it {e.in_unit(e.adjusted)}"
    is_better = is_clear(e.gain, e.se)
    is_worse = is_clear(-e.gain, e.se)
    of_use = e.of_use
    if math.isnan(of_use):  # left-out observations alone decide
        of_use = 0.5
        if is_better:
            of_use = 1.0
        elif is_worse:
            of_use = 0.0
    if of_use < 1 - _SURELY and not is_better:
        alone = f"and the formula alone is off by {e.in_unit(e.alone)}"
        return Verdict(NOT, [f"{compared}, {alone}."])
    if e.adjusted > _LARGER * e.data:
        return Verdict(OPEN, [f"{compared}.{where}"])
    if of_use <= _SURELY or is_worse:
        return Verdict(OPEN, [f"{compared}: too near one another to tell.{where}"])
    return None


def _as_it_is(e: Evidence) -> Verdict | None:
    """Return the verdict if the formula is right as it is, or up to a factor and an offset."""
    simple = e.line if e.alone > _LARGER * e.line else e.alone  # NaN of several
    is_as_good = simple <= _LARGER * min(e.adjusted, e.data) or e.correction_needed < _EVEN
    if not is_as_good or (e.is_surpassed and simple == e.alone):
        return None
    alone, adjusted = map(e.in_unit, (e.alone, e.adjusted))
    if simple == e.alone:
        reason = f"Its error is {alone}, corrected {adjusted}, of the data alone"
        return Verdict(AS_IS, [f"{reason} {e.in_unit(e.data)}."])
    line = f"{number(e.factor)} times your formula"
    if abs(e.offset) > _NEGLIGIBLE * e.line:
        sign = "plus" if e.offset > 0 else "less"
        line += f" {sign} {e.in_unit(abs(e.offset))}"
    reason = f"Take {line}: its error is {e.in_unit(e.line)}, as it is {alone}"
    return Verdict(AS_IS, [f"{reason}, corrected {adjusted}."], e.factor, e.offset)


def _corrected(e: Evidence, correction: str) -> Verdict:
    """Return the verdict on a formula that needs a correction, unless it hardly fits the data."""
    alone, adjusted, data = map(e.in_unit, (e.alone, e.adjusted, e.data))
    if e.alone > _HARDLY * e.data and e.line > _LARGER * e.data:
        by_itself = f"By itself your formula is off by {alone}, the data alone {data}"
        input_only = f"As an input of a model it lowers the error to {adjusted}"
        return Verdict(OPEN, [f"{by_itself}. {input_only}; check whether it is the right formula."])
    falls = f"Errors fall from {alone} to {adjusted}"
    if math.isnan(e.alone):
        falls = f"The error is {adjusted}, of the data alone {data}"
    elif e.adjusted >= e.alone:
        falls = (
            f"The error is {adjusted}, as it is {alone}, but most observations are predicted "
            "better with the correction"
        )
    if correction:
        falls = f"{falls}; {correction}"
    reasons = [f"{falls}."]
    if e.data <= _LARGER * e.adjusted:
        reasons.append(
            f"Among these data the data alone do as well ({data}); the formula counts where there "
            "are none."
        )
    return Verdict(CORRECTED, reasons)


def is_clear(gain: float, se: float) -> bool:
    """Return whether a gain is more than a nat and than two standard errors."""
    return gain > max(_SURE * se, _LEAST)


def straight_line(y: Tensor, f: Tensor) -> tuple[float, float, float]:
    """Return factor and offset of y over f by least squares, and the error of left-out ``n``."""
    columns = [torch.ones_like(f)]
    if not is_constant(f):
        columns.insert(0, f)
    basis = torch.stack(columns, -1)
    q, r = torch.linalg.qr(basis)
    solution = torch.linalg.solve_triangular(r, q.mT @ y.unsqueeze(-1), upper=True).squeeze(-1)
    # The error at a point that is left out is the residual over 1 - h, h the diagonal of Q Q'.
    remainder = (1 - q.square().sum(-1)).clamp_min(_ROUNDING)
    error = rms((y - basis @ solution) / remainder)
    *factors, offset = solution.tolist()
    return sum(factors), offset, error  # 0 of a constant, which has no factor


@torch.no_grad()
def correction_of(model: GP, j: int, f: Tensor) -> str:
    """Return the largest correction of a formula's values at the data, in words."""
    X = model.data.X
    corrections = model.predict(X).mean[:, j] - f
    is_share = has_one_sign(f)
    is_large = f.abs() > _TINY_SHARE * f.abs().median()  # where a share says something
    sizes = torch.where(is_large, corrections / f.abs(), 0.0) if is_share else corrections
    i = int(sizes.abs().argmax())
    size = f"{100 * sizes[i]:+.0f} %"
    if not is_share:
        sign = "+" if sizes[i] > 0 else ""
        size = with_unit(f"{sign}{number(sizes[i])}", model.data.output_names[j])
    return f"the largest correction at the data is {size}{_at(model, X[i])}"


def has_one_sign(f: Tensor) -> bool:
    """Return whether values are all positive or all negative, so that they have shares."""
    return bool((f > 0).all() or (f < 0).all())


@torch.no_grad()
def next_point(first: GP, second: GP, j: int) -> str:
    """Return where two models' predictions of output j are farthest apart; empty if nowhere."""
    low, high = first.data.X.amin(0), first.data.X.amax(0)
    unit = torch.quasirandom.SobolEngine(len(low)).draw(_POINTS, dtype=low.dtype)
    X = on_levels(first, low + unit * (high - low))
    try:
        a, b = first.predict(X), second.predict(X)
    except PhysicsError:
        return ""
    # squared distance of the means over the sum of the variances
    apart = (a.mean - b.mean)[:, j].square() / (a.variance + b.variance)[:, j]
    i = int(apart.argmax())
    if apart[i] < _APART_BY**2:
        return ""
    name = first.data.output_names[j]
    values = [with_unit(number(mean[i, j]), name) for mean in (a.mean, b.mean)]
    where = f"where it is {values[0]} with the formula, {values[1]} without"
    return f"{_at(first, X[i]).strip()}, {where}".removeprefix(", ")


def _at(model: GP, x: Tensor) -> str:
    """Return the inputs of a point, ``d``, in words; nothing of more than three."""
    names = model.data.input_names
    if len(names) > _NAMED:
        return ""
    return f" at {listed(named_point(names, x, levels_of(model)))}"


def named_point(names: Sequence[str], x: Tensor, levels: Levels) -> list[str]:
    """Return the inputs of a point, ``d``, with their names and units, such as ``x = 0.5 m``."""
    texts = zip(names, point_in_words(x, levels), strict=True)
    return [f"{bare(name)} = {with_unit(text, name)}" for name, text in texts]


def point_in_words(x: Tensor, levels: Levels, digits: int = 3) -> list[str]:
    """Return the inputs of a point, ``d``, as numbers, and as names of categories by column."""
    texts = []
    for i, value in enumerate(x.tolist()):
        text = number(value, digits)
        if i in levels:
            text = str(levels[i][numbers_of(levels[i]).index(value)])
        texts.append(text)
    return texts


def unsampled(
    table: Mapping[str, Sequence[Candidate]], results: Mapping[str, FitResult]
) -> list[str]:
    """Return a warning of structures with weight that have other results by other seeds."""
    names = {row.structure for rows in table.values() for row in rows if row.weight > COUNTS}
    names &= {name for name, result in results.items() if not result.converged}
    if not names:
        return []
    return [
        f"Results of {', '.join(sorted(names))} depend on the seed: doubt the intervals, and fit "
        "again with more num_draws or narrower priors."
    ]
