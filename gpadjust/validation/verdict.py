"""The verdict on a physics, in words: should one use it, as it is or corrected?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP, FitResult
from gpadjust.kinds.categories import levels_of, on_levels
from gpadjust.physics import PhysicsError
from gpadjust.validation.faults import rms
from gpadjust.words import bare, listed, number, with_unit

ALONE, CALIBRATED, ADJUSTED = "physics alone", "calibrated physics", "adjusted"
DATA = "data alone"
AS_IS, CORRECTED = "Use your formula as it is", "Use it corrected"
NOT, OPEN = "Do not use it", "These data do not tell"
_ROUNDING = 1e-9  # relative; less is rounding
_SURE = 2.0  # standard errors that a difference takes to be real
_ENOUGH = 8  # observations of different inputs, for any answer
_LEAST = 1.0  # nats; a smaller difference says nothing
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
        correction_needed: Its probability by nested models; NaN if none were fitted.
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
    correction_needed: float = math.nan


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
    is_as_good = simple <= _LARGER * min(e.adjusted, e.data) or e.correction_needed < _EVEN
    if is_as_good and not (e.is_surpassed and simple == e.alone):
        if simple == e.alone:
            reason = f"Its error is {error(e.alone)}, corrected {error(e.adjusted)}"
            return Verdict(AS_IS, [f"{reason}, of the data alone {error(e.data)}."])
        line = f"{number(e.factor)} times your formula"
        if abs(e.offset) > _NEGLIGIBLE * e.line:
            sign = "plus" if e.offset > 0 else "less"
            line += f" {sign} {error(abs(e.offset))}"
        reason = f"Take {line}: its error is {error(e.line)}, as it is {error(e.alone)}, corrected"
        return Verdict(AS_IS, [f"{reason} {error(e.adjusted)}."], e.factor, e.offset)
    if e.alone > _HARDLY * e.data and e.line > _LARGER * e.data:
        alone = f"By itself your formula is off by {error(e.alone)}, the data alone {error(e.data)}"
        input_only = f"As an input of a model it lowers the error to {error(e.adjusted)}"
        return Verdict(OPEN, [f"{alone}. {input_only}; look whether it is the right formula."])
    falls = f"Errors fall from {error(e.alone)} to {error(e.adjusted)}"
    if e.adjusted >= e.alone:
        falls = (
            f"The error is {error(e.adjusted)}, as it is {error(e.alone)}, but most observations "
            "are predicted better with the correction"
        )
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
    varies = float(f.std()) > _ROUNDING * rms(f)
    basis = torch.stack([f, torch.ones_like(f)] if varies else [torch.ones_like(f)], -1)
    q, r = torch.linalg.qr(basis)
    solution = torch.linalg.solve_triangular(r, q.mT @ y.unsqueeze(-1), upper=True).squeeze(-1)
    left = (1 - q.square().sum(-1)).clamp_min(_ROUNDING)  # of the errors, if a point is left out
    error = rms((y - basis @ solution) / left)
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
