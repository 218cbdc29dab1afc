"""What data show of a physics, in words: whether it helps, and whether it is obviously off."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP, FitResult
from gpadjust.core.data import Data
from gpadjust.kinds.categories import levels_of, on_levels
from gpadjust.physics import PhysicsError
from gpadjust.validation.trust import physics_at
from gpadjust.words import bare, listed, name_and_unit, number, with_unit

ALONE, CALIBRATED, ADJUSTED = "physics alone", "calibrated physics", "adjusted"
DATA = "data alone"
AS_IS, CORRECTED = "Use your formula as it is", "Use it corrected"
NOT, OPEN = "Do not use it", "These data do not tell"
_SURE = 2.0  # standard errors that a difference takes to be real
_ENOUGH = 8  # observations of different inputs, for any answer
_LEAST = 1.0  # nats; a smaller difference says nothing
_SURELY = 0.95  # probability with which nested models decide
_LARGER = 1.1  # times as large; by less, errors are equal
_TINY_SHARE = 0.05  # of the median size of f_p: less is too little for a share of it
_POINTS = 256  # among which the next observation is looked for
_APART_BY = 0.3  # standard deviations: predictions that are nearer are the same
_NAMED = 3  # inputs of a point that a sentence has room for
_NEGLIGIBLE = 0.1  # of the error; a smaller offset is not named
COUNTS = 0.05  # weight with which a structure is a part of what is recommended

# Of the check of a physics at the training inputs.
_SAID = 5  # observations, for anything to be said
_MANY = 8  # observations, for the sign or a factor of a twentieth by correlation
_FAR = 3.0  # standard deviations of the targets, beyond which a physics is off
_NEAR = 0.5  # of the targets' root mean square; a physics that is nearer is crude, no more
_WORSE = 1.5  # standard deviations, where the cause is plain
_APART = 12.0  # standard deviations of the targets; a smaller offset is crudeness
_FACTOR = 10.0  # a smaller factor is crudeness
_TINY = 20.0  # times too small: next to nothing, so that the error is that of no physics
_HUGE = 100.0  # times as large as the targets, whatever its shape
_EXPLAINS = 1 / 3  # of the error is left, where its cause is found
_FITS = 0.6  # standard deviations of the targets that a factor leaves
_LIKE = 0.8  # of the error is left by the opposite, at most
_FOLLOWS = 0.5  # correlation of a physics that has anything to do with the targets
_TIGHT = 0.9  # correlation that shows what the size of the error does not
_SHOWN = 3.0  # standard errors of a correlation
_ROUNDING = 1e-9
_STANDARD = 1e-6


class Candidate(NamedTuple):
    """Quality of the predictions of an output's left-out observations by a structure.

    Attributes:
        structure: Its name.
        elpd: Expected log predictive density, the sum over the observations, in nats.
        elpd_diff: That less the best structure's; 0 for the best.
        se_diff: The standard error of this difference.
        weight: Its weight in the stacked model; NaN of a physics alone, which is no part of it.
        rmse: Root mean square error, relative to the standard deviation of the observations.
        coverage: Share of the observations within their 95 % intervals.
        error: Root mean square error, in the output's units.
        log_evidence: The log evidence of the fit; NaN if there is none.
        of_use: Probability that the physics is of use, by the evidence of nested models with and
            without it; NaN if there are none.
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
        answer: ``"Use your formula as it is"``, ``"Use it corrected"``, ``"Do not use it"`` or
            ``"These data do not tell"``.
        reasons: Why, in sentences.
        factor: By which the formula is to be multiplied where it is used as it is.
        offset: What is to be added then, in the unit of the output.
    """

    answer: str
    reasons: list[str]
    factor: float = 1.0
    offset: float = 0.0


class Evidence(NamedTuple):
    """What a verdict on an output is reached by.

    Attributes:
        name: The output, with its unit.
        number: Observations, those of the same inputs taken together.
        of_use: Probability that the physics is of use, by nested models with and without it; NaN if
            none were fitted.
        gain: The difference of expected log predictive densities with and without the physics, in
            nats.
        se: Its standard error.
        alone: Root mean square error of left-out observations by the formula, with fitted
            parameters if it has unknown ones; NaN of several.
        line: The same by the formula up to the factor and offset.
        adjusted: The same by the best structure that adjusts it.
        data: The same by the best structure without it.
        factor: Of the straight line through observations over the formula.
        offset: Likewise.
        fault: What is obviously wrong with the formula, in words.
        is_surpassed: Whether densities of left-out observations show that the correction is needed.
    """

    name: str
    number: int
    of_use: float
    gain: float
    se: float
    alone: float
    line: float
    adjusted: float
    data: float
    factor: float
    offset: float
    fault: str = ""
    is_surpassed: bool = False


def difference(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Return the difference of two elpd, and its standard error (Vehtari et al. 2017, eq. 24)."""
    each = first - second
    return each.sum().item(), math.sqrt(len(each)) * each.std(correction=0).item()


def verdict_on(e: Evidence, correction: str, next_point: str) -> Verdict:
    """Return the verdict that evidence allows.

    The probability of nested models decides whether the formula is of use, unless left-out
    observations contradict it; their errors decide whether it needs a correction.

    Args:
        e: The evidence.
        correction: The largest correction, in words; empty if there is none.
        next_point: Where one more observation would tell most; empty if none among the data would.
    """

    def error(value: float) -> str:
        return with_unit(number(value), e.name)

    without = f"without it the error is {error(e.data)}, with it {error(e.adjusted)}"
    where = " Observe where the formula has other values."
    if next_point:
        where = f" More observations would tell, the first one {next_point}."
    if e.fault:
        fault = f"Your formula seems to be wrong: {e.fault}"
        return Verdict(OPEN, [fault, "Mend it and ask again: until then no answer is worth much."])
    if e.number < _ENOUGH:
        few = f"It takes at least {_ENOUGH} observations of different inputs, and there are"
        return Verdict(OPEN, [f"{few} {e.number}.{where}"])
    if e.factor == 0:
        same = "Your formula has the same value at all observations, which tells nothing of it."
        return Verdict(OPEN, [f"{same} Observe where it differs."])
    is_better = e.gain > max(_SURE * e.se, _LEAST)
    is_worse = -e.gain > max(_SURE * e.se, _LEAST)
    of_use = e.of_use
    if math.isnan(of_use):
        of_use = 1.0 if is_better else 0.0 if is_worse else 0.5
    if of_use < 1 - _SURELY and not is_better:
        return Verdict(NOT, [f"{without[0].upper()}{without[1:]}, and the formula alone "
                             f"is off by {error(e.alone)}."])  # fmt: skip
    if of_use <= _SURELY or is_worse or e.adjusted > _LARGER * e.data:
        doubt = f"{without[0].upper()}{without[1:]}: too near one another to tell"
        if e.adjusted > _LARGER * e.data:
            doubt = f"{without[0].upper()}{without[1:]}"
        return Verdict(OPEN, [f"{doubt}.{where}"])
    simple = e.line if e.alone > _LARGER * e.line else e.alone  # NaN of several
    is_enough = not (e.is_surpassed and simple == e.alone)
    if simple <= _LARGER * min(e.adjusted, e.data) and is_enough:
        if simple == e.alone:
            reason = f"Its error is {error(e.alone)}, corrected {error(e.adjusted)}"
            return Verdict(AS_IS, [f"{reason}, of the data alone {error(e.data)}."])
        line = f"{number(e.factor)} times your formula"
        if abs(e.offset) > _NEGLIGIBLE * e.line:
            sign = "plus" if e.offset > 0 else "less"
            line += f" {sign} {error(abs(e.offset))}"
        reason = f"Take {line}: its error is {error(e.line)}, as it is {error(e.alone)}, corrected"
        return Verdict(AS_IS, [f"{reason} {error(e.adjusted)}."], e.factor, e.offset)
    falls = f"Errors fall from {error(e.alone)} to {error(e.adjusted)}"
    if math.isnan(e.alone):
        falls = f"The error is {error(e.adjusted)}, of the data alone {error(e.data)}"
    reasons = [f"{falls}{'; ' * bool(correction)}{correction}."]
    if e.data <= _LARGER * e.adjusted:
        reasons.append(
            f"Among these data the data alone do as well ({error(e.data)}); the formula counts "
            "where there are none."
        )
    return Verdict(CORRECTED, reasons)


def is_shown(first: Tensor, second: Tensor) -> bool:
    """Return whether densities of the first are better by a nat and by two standard errors."""
    gain, se = difference(first, second)
    return gain > max(_SURE * se, _LEAST)


def straight_line(y: Tensor, f: Tensor) -> tuple[float, float, float]:
    """Return factor and offset of y over f by least squares, and the error of left-out ``n``."""
    varies = float(f.std()) > _ROUNDING * _rms(f)
    basis = torch.stack([f, torch.ones_like(f)] if varies else [torch.ones_like(f)], -1)
    q, r = torch.linalg.qr(basis)
    solution = torch.linalg.solve_triangular(r, q.mT @ y.unsqueeze(-1), upper=True).squeeze(-1)
    left = (1 - q.square().sum(-1)).clamp_min(_ROUNDING)  # of the errors, if a point is left out
    error = _rms((y - basis @ solution) / left)
    factor, offset = solution.tolist() if varies else (0.0, *solution.tolist())
    return factor, offset, error


@torch.no_grad()
def correction_of(model: GP, j: int, f: Tensor) -> str:
    """Return the largest correction of a formula's values at the data, in words."""
    X = model.data.X
    off = model.predict(X).mean[:, j] - f
    is_share = bool((f > 0).all() or (f < 0).all())
    is_large = f.abs() > _TINY_SHARE * f.abs().median()  # where a share says something
    sizes = torch.where(is_large, off / f.abs(), 0.0) if is_share else off
    i = int(sizes.abs().argmax())
    size = f"{100 * sizes[i]:+.0f} %"
    if not is_share:
        size = with_unit(f"{'+' * bool(off[i] > 0)}{number(off[i])}", model.data.output_names[j])
    return f"the largest correction at the data is {size}{_at(model, X[i])}"


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
    apart = (a.mean - b.mean)[:, j].square() / (a.variance + b.variance)[:, j]
    i = int(apart.argmax())
    if apart[i] < _APART_BY**2:
        return ""
    name = first.data.output_names[j]
    values = [with_unit(number(each.mean[i, j]), name) for each in (a, b)]
    where = f"where it is {values[0]} with the formula, {values[1]} without"
    at = _at(first, X[i]).strip()
    return f"{at}, {where}" if at else where


def _at(model: GP, x: Tensor) -> str:
    """Return the inputs of a point, ``d``, in words; nothing of more than three."""
    names = model.data.input_names
    if len(names) > _NAMED or levels_of(model):
        return ""
    pairs = zip(names, x.tolist(), strict=True)
    return f" at {listed(f'{bare(n)} = {with_unit(number(v), n)}' for n, v in pairs)}"


def unsampled(
    table: Mapping[str, Sequence[Candidate]], results: Mapping[str, FitResult]
) -> list[str]:
    """Return which structures with weight have other results by other seeds."""
    names = {row.structure for rows in table.values() for row in rows if row.weight > COUNTS}
    low = [name for name, result in results.items() if name in names and not result.converged]
    if not low:
        return []
    return [
        f"Results of {', '.join(low)} depend on the seed: doubt the intervals, and fit again "
        "with more num_draws or narrower priors."
    ]


def fault_of(data: Data, output: int, f: Tensor) -> str:
    """Return what is obviously wrong with values ``n`` of f_p of an output; empty if nothing is."""
    y, X = data.Y[:, output], data.X
    seen = ~y.isnan() & f.isfinite()
    y, f = y[seen], f[seen]
    if len(y) < _SAID:
        return ""
    sd = float(y.std())
    cause = _cause(data, output, X[seen], y, f) if sd > _ROUNDING * _rms(y) else ""
    if cause and _is_standardised(y.unsqueeze(-1)):
        cause += " The targets were standardised; f_p has to return what they are in."
    name = data.output_names[output]
    errors = [with_unit(number(value), name) for value in (_rms(y - f), sd)]
    return cause and (
        f"at the training inputs f_p has a root mean square error of {errors[0]}, where the "
        f"targets have a standard deviation of {errors[1]}: {cause}"
    )


def faults(model: GP) -> list[str]:
    """Return what is obviously wrong with the physics of a fitted model, for each and output."""
    found = []
    for name, values in physics_at(model, model.data.X).items():
        for j, output in enumerate(model.data.output_names):
            if fault := fault_of(model.data, j, values[:, j]):
                where = f"{name}: " if len(model.physics) > 1 else ""
                found.append(
                    f"{where}{output}: {fault}" if model.num_outputs > 1 else where + fault
                )
    return found


def _cause(data: Data, output: int, X: Tensor, y: Tensor, f: Tensor) -> str:
    """Return what is wrong with f_p: scaled inputs, or a sign, an offset or a factor."""
    n, sd, size, rmse = len(y), float(y.std()), _rms(y), _rms(f - y)
    r = _correlation(y, f)
    if rmse > (_WORSE if r > _FOLLOWS else 1.0) * sd and _is_standardised(X):
        return (
            "are the inputs scaled? Each column of them has mean 0 and standard deviation 1, and "
            f"the correlation of f_p with the targets is {r:.2f}. f_p reads raw units: give the "
            "model raw inputs; its input_transform may scale them, and shows f_p raw ones."
        )
    if rmse <= _NEAR * size:
        return ""
    factor, by_factor = _factor(y, f, r)
    is_off = rmse > _FAR * sd
    is_opposite = r < -_FOLLOWS and r**2 * (n - 2) > _SHOWN**2 * (1 - r**2)
    is_worse = n >= _MANY and rmse > _WORSE * sd and r < -_TIGHT
    if is_opposite and (is_off or is_worse) and _rms(f + y) < (1.0 if is_off else _LIKE) * rmse:
        large = f", and {_times(factor)}" if abs(factor) > _FACTOR else ""
        return f"f_p is of the opposite sign (correlation {r:.2f}){large}."
    is_tiny = n >= _MANY and r > _TIGHT and 0 < factor < 1 / _TINY
    if not is_off and not is_tiny:
        return ""
    offset = float((f - y).mean())
    by_offset = _rms(f - y - offset)
    if rmse > _APART * sd and by_offset < _EXPLAINS * rmse and by_offset <= by_factor:
        where = "above" if offset > 0 else "below"
        return f"f_p is about {number(abs(offset))} {where} the targets."
    if factor > 0 and not 1 / _FACTOR < factor < _FACTOR:
        return f"f_p is {_times(factor)}; {_units(data, output)}"
    return ""


def _factor(y: Tensor, f: Tensor, r: float) -> tuple[float, float]:
    """Return how many times too large f_p is, 0 if that says nothing, and the error without."""
    sd, size = float(y.std()), _rms(y)
    slope = float(f @ y / (f @ f)) if f.any() else 0.0
    by_factor, affine = _rms(y - slope * f), sd * max(0.0, 1 - r**2) ** 0.5
    if affine < _FITS * sd and by_factor > 1.5 * affine:  # there is an offset, too
        slope = r * sd / float(f.std())
    elif by_factor > _FITS * sd:
        slope = size / _rms(f) if _rms(f) > _HUGE * size else 0.0
        slope = -slope if r < -_FOLLOWS else slope
    return (1 / slope if slope else 0.0), by_factor


def _correlation(y: Tensor, f: Tensor) -> float:
    """Return the correlation; 0 of a constant f_p."""
    if float(f.std()) <= _ROUNDING * _rms(f):
        return 0.0
    return float(torch.corrcoef(torch.stack([y, f]))[0, 1])


def _is_standardised(values: Tensor) -> bool:
    """Return whether a scaler made the columns of ``n x d``; it makes 0 of a constant one."""
    mean, sd = values.mean(0), values.std(0, correction=0)
    ones = torch.stack([(sd - 1).abs(), (values.std(0) - 1).abs()]).amin(0) < _STANDARD
    return bool((mean.abs() < _STANDARD).all() & (ones | (sd == 0)).all() & ones.any())


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def _times(factor: float) -> str:
    """Return a text for a factor, too large or too small."""
    size = "large" if abs(factor) >= 1 else "small"
    return f"about {float(f'{max(abs(factor), 1 / abs(factor)):.2g}'):,g} times too {size}"


def _units(data: Data, output: int) -> str:
    """Return the question for the units of f_p, with those that names have."""
    units = [" in ".join(name_and_unit(name)) for name in data.input_names if "[" in name]
    name, unit = name_and_unit(data.output_names[output])
    if not units or not unit:
        return "are its units those of the targets?"
    return f"does it give {name} in {unit}, and read {listed(units)}?"
