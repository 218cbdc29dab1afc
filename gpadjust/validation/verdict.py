"""What data show of a physics, in words: whether it helps, and whether it is obviously off."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import FitResult
from gpadjust.core.data import Data
from gpadjust.physics import Physics

ALONE, CALIBRATED, ADJUSTED = "physics alone", "calibrated physics", "adjusted"
DATA = "data alone"
_SURE = 2.0  # standard errors that a difference takes to be real
_ENOUGH = 8  # observations of different inputs, for a difference to be shown
_LEAST = 1e-6  # nats; less is rounding
_COUNTS = 0.05  # weight with which a structure is a part of what is recommended

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
_SURELY = 0.9  # correlation that shows what the size of the error does not
_SHOWN = 3.0  # standard errors of a correlation
_ROUNDING = 1e-9
_STANDARD = 1e-6
_ANSWERS = {1: "Yes", 0: "Not shown", -1: "No"}


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


class Gain(NamedTuple):
    """The gain of predictions of an output by the physics, and the verdict on it.

    Attributes:
        elpd: The difference of expected log predictive densities, the sum over the observations, in
            nats.
        se: Its standard error.
        structure: The structure with the physics.
        without: The structure without the physics.
        shown: 1 if the physics is shown to help, by two standard errors and by the evidence of
            models that were weighed without it; -1 if it is shown to make predictions worse, where
            no model leaves it out by itself; 0 if neither is, or there are observations of fewer
            than eight different inputs.
        by_evidence: Whether a difference of more than two standard errors shows nothing because of
            models that were weighed without the physics.
        number: The number of observations, those of the same inputs taken together.
    """

    elpd: float
    se: float
    structure: str
    without: str
    shown: int
    by_evidence: bool = False
    number: int = _ENOUGH

    @property
    def answer(self) -> str:
        """``"Yes"``, ``"Not shown"`` or ``"No"``: does the physics help?"""
        return _ANSWERS[self.shown]

    def sentences(self, output: str) -> list[str]:
        """Return the verdict on an output in words, with its number, and why no more is shown."""
        verdict = {
            1: f"The physics helps to predict {output}",
            0: f"These data do not show whether the physics helps to predict {output}",
            -1: f"With the physics, {output} is predicted worse than without it",
        }
        text = _elpd(self.elpd, self.se, self.structure, "without it", self.without)
        ratio = math.exp(max(-50.0, min(50.0, self.elpd / self.number)))
        each = f"each of {self.number} left-out observations is {ratio:.3g} times as likely"
        finding = f"{verdict[self.shown]}: {text}; {each} in geometric mean."
        return [finding] if self.shown else [finding, self._reason()]

    def _reason(self) -> str:
        """Return why the physics is neither shown to help nor to do harm."""
        if self.number < _ENOUGH:
            return (
                f"Of fewer than {_ENOUGH} observations the standard error is itself unknown: "
                "neither is it shown that the physics helps, nor that it does not."
            )
        if not self.by_evidence:
            return (
                "That is not to say that it does not help: the difference is within two standard "
                "errors, and more observations may show one."
            )
        if self.elpd > 0:
            return (
                f"{self.structure} is better by more than two standard errors, but by the evidence "
                "of a model with and without the physics it is of no use: as the two do not agree, "
                "nothing is shown."
            )
        return (
            f"{self.structure} is worse by more than two standard errors, but among those "
            "compared is a model that leaves a physics of no use out by itself: so none is said to "
            "do harm."
        )


def difference(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Return the difference of two elpd, and its standard error (Vehtari et al. 2017, eq. 24)."""
    each = first - second
    return each.sum().item(), math.sqrt(len(each)) * each.std(correction=0).item()


def _sign_of(value: float, error: float) -> int:
    """Return the sign that a difference is shown to have, or 0."""
    if abs(value) <= max(_SURE * error, _LEAST):
        return 0
    return 1 if value > 0 else -1


def gain_of(rows: Sequence[Candidate], densities: Mapping[str, Tensor]) -> Gain | None:
    """Return the gain by the physics; None if no structure uses it, or all do.

    Args:
        rows: The structures, best first. For one that is not averaged with a model without the
            physics the highest probability that it is of use counts: one of several physics may be
            of use, and others not.
        densities: Log predictive densities of left-out observations by name, ``n`` each.
    """
    best = next((row for row in rows if row.kind != DATA), None)
    without = next((row.structure for row in rows if row.kind == DATA), None)
    if best is None or without is None:
        return None
    number = len(densities[without])
    elpd, se = difference(densities[best.structure], densities[without])
    sign = _sign_of(elpd, se) if number >= _ENOUGH else 0
    probabilities = [row.of_use for row in rows if not math.isnan(row.of_use)]
    of_use = max(probabilities, default=1.0) if math.isnan(best.of_use) else best.of_use
    is_doubted = of_use <= 0.5 if sign > 0 else bool(probabilities)
    by_evidence = bool(sign) and is_doubted
    shown = 0 if by_evidence else sign
    return Gain(elpd, se, best.structure, without, shown, by_evidence, number)


def advice(
    rows: Sequence[Candidate],
    scaling: Collection[str],
    densities: Mapping[str, Tensor],
    gain: Gain | None,
) -> list[str]:
    """Return findings on an output in addition to the verdict, in sentences.

    ``scaling`` are the names of structures that do more than to take the physics as the mean.
    """
    best, *others = rows
    sentence = f"{best.structure} predicts left-out observations best (weight {best.weight:.2f})"
    if near := [row.structure for row in others if not _sign_of(row.elpd_diff, row.se_diff)]:
        sentence += (
            f"; not shown to be worse, within {_SURE:.0f} standard errors: {', '.join(near)}"
        )
    sentences = [f"{sentence}."]
    using = [row.structure for row in rows if row.kind != DATA]
    scaled = next((name for name in using if name in scaling), None)
    unscaled = next((name for name in using if name not in scaling), None)
    if scaled and unscaled and (gain is None or gain.shown > 0):
        value, error = difference(densities[scaled], densities[unscaled])
        says = "helps" if _sign_of(value, error) > 0 else "is not shown to help"
        text = _elpd(value, error, scaled, "with the physics as a mean", unscaled)
        sentences.append(f"Scaling the physics {says}: {text}.")
    return sentences + [
        f"By the evidence of {row.structure} with and without it, f_p is of use: {row.of_use:.2f}."
        for row in rows
        if not math.isnan(row.of_use)
    ]


def unsampled(
    table: Mapping[str, Sequence[Candidate]], results: Mapping[str, FitResult]
) -> list[str]:
    """Return which structures with weight have other results by other seeds."""
    names = {row.structure for rows in table.values() for row in rows if row.weight > _COUNTS}
    low = [name for name, result in results.items() if name in names and not result.converged]
    if not low:
        return []
    return [
        f"Results of {', '.join(low)} depend on the seed: doubt the intervals, and fit again "
        "with more num_draws or narrower priors."
    ]


def _elpd(value: float, error: float, better: str, otherwise: str, worse: str) -> str:
    nats = f"{round(value, 1) + 0.0:+.1f} +- {error:.1f} nats"
    return f"elpd {nats} ({better}) over that {otherwise} ({worse})"


@torch.no_grad()
def complaint(physics: Physics, data: Data) -> str:
    """Return the obvious faults of a physics, of each output; empty if there are none.

    There are none of a physics with unknown parameters, of which the guesses may be wrong.
    """
    if physics.unknowns:
        return ""
    m, sentences = data.Y.shape[-1], []
    for name, y, f in zip(data.output_names, data.Y.mT, physics(data.X).mT, strict=True):
        seen = ~y.isnan()
        text = _of_output(data.X, y[seen], f[seen]) if int(seen.sum()) >= _SAID else ""
        sentences += [f"{name}: {text}" if m > 1 else text] * bool(text)
    return " ".join(sentences)


def _of_output(X: Tensor, y: Tensor, f: Tensor) -> str:
    """Return the fault of f_p for the ``n`` observations of an output."""
    sd = float(y.std())
    cause = _cause(X, y, f) if sd > _ROUNDING * _rms(y) else ""
    if cause and _is_standardised(y.unsqueeze(-1)):
        cause += " The targets were standardised; f_p has to return what they are in."
    return cause and (
        f"at the training inputs f_p has a root mean square error of {_number(_rms(y - f))}, where "
        f"the targets have a standard deviation of {_number(sd)}: {cause}"
    )


def _cause(X: Tensor, y: Tensor, f: Tensor) -> str:
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
    is_worse = n >= _MANY and rmse > _WORSE * sd and r < -_SURELY
    if is_opposite and (is_off or is_worse) and _rms(f + y) < (1.0 if is_off else _LIKE) * rmse:
        large = f", and {_times(factor)}" if abs(factor) > _FACTOR else ""
        return f"f_p is of the opposite sign (correlation {r:.2f}){large}."
    is_tiny = n >= _MANY and r > _SURELY and 0 < factor < 1 / _TINY
    if not is_off and not is_tiny:
        return ""
    offset = float((f - y).mean())
    by_offset = _rms(f - y - offset)
    if rmse > _APART * sd and by_offset < _EXPLAINS * rmse and by_offset <= by_factor:
        where = "above" if offset > 0 else "below"
        return f"f_p is about {_number(abs(offset))} {where} the targets."
    if factor > 0 and not 1 / _FACTOR < factor < _FACTOR:
        return f"f_p is {_times(factor)}; are its units those of the targets?"
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
    return f"about {_number(max(abs(factor), 1 / abs(factor)), 2)} times too {size}"


def _number(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits, without an exponent up to ten million."""
    text = f"{value:.{digits}g}"
    return f"{float(text):,.0f}" if "e+" in text and value < 1e7 else text
