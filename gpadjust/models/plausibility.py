"""Check of a physics at the training inputs: is it obviously off, and why?"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.models.training_data import TrainingData

_LEAST = 5  # observations, for anything to be said
_GOOD = 0.9  # standard deviations of the targets; a physics that is as good is looked at no more
_FAR = 3.0  # standard deviations of the targets, beyond which a physics is off
_NEAR = 0.5  # of the targets' root mean square; a physics that is nearer is crude, no more
_WORSE = 1.5  # standard deviations, where the cause is plain
_APART = 12.0  # standard deviations of the targets; a smaller offset is crudeness
_FACTOR = 10.0  # a smaller factor is crudeness
_TINY = 20.0  # times too small: next to nothing, so that the error is that of no physics
_HUGE = 100.0  # times as large as the targets, whatever its shape
_EXPLAINS = 1 / 3  # of the error is left, where its cause is found
_FITS = 0.6  # standard deviations of the targets, that a factor below 100 leaves
_LIKE = 0.8  # of the error is left by the opposite, at most
_FOLLOWS = 0.5  # correlation of a physics that has anything to do with the targets
_SHOWN = 3.0  # standard errors of a correlation
_SURELY = 0.9  # correlation that shows what the size of the error does not
_MANY = 8  # observations for that
_ROUNDING = 1e-9
_STANDARD = 1e-6


class _Fit(NamedTuple):
    """Relation of f_p to the targets of one output.

    Attributes:
        n: Number of observations.
        sd: Standard deviation of the targets.
        size: Their root mean square.
        rmse: Root mean square error of f_p.
        left: That without an offset, if the model learns one.
        correlation: Of targets and f_p; 0 of a constant f_p.
        factor: How many times too large f_p is by least squares; 0 if that says nothing.
        by_factor: The error without that factor.
        offset: How far f_p is above the targets, in the mean.
        by_offset: The error without that offset.
        flipped: As ``left``, of the opposite.
    """

    n: int
    sd: float
    size: float
    rmse: float
    left: float
    correlation: float
    factor: float
    by_factor: float
    offset: float
    by_offset: float
    flipped: float


def complaint(data: TrainingData, f: Tensor, scaled: bool, shifted: bool) -> str:
    """Return the obvious faults of a physics, of each output; empty if there are none.

    Args:
        data: The data.
        f: The prior mean by the physics, ``batch_shape x n x m``.
        scaled: Whether a factor of f_p is learnt.
        shifted: Whether an offset is.
    """
    m = data.Y.shape[-1]
    mean = data.Y.nanmean(-2, keepdim=True)
    errors, spreads = ((data.Y - v).square().nanmean(-2) for v in (f, mean))
    if not scaled and (errors < _GOOD**2 * spreads).all():
        return ""
    X = data.X.reshape(-1, *data.X.shape[-2:])
    Y, values = (t.expand(data.Y.shape).reshape(-1, *data.Y.shape[-2:]) for t in (data.Y, f))
    told = []
    for j, name in enumerate(data.output_names):
        sets = zip(X, Y[..., j], values[..., j], strict=True)
        found = [text for each in sets if (text := _said(*each, scaled, shifted))]
        of = f"{name}: " if m > 1 else ""
        many = f" So in {len(found)} of {len(X)} data sets." if len(X) > 1 else ""
        told += [f"{of}{found[0]}{many}"] if found else []
    return " ".join(told)


def is_standardised(values: Tensor) -> bool:
    """Return whether each column of ``n x d`` is standardised, as by a scaler.

    A column that is 0 throughout may be among them: a scaler makes that of a constant.
    """
    if len(values) < _LEAST:
        return False
    mean, sd = values.mean(0), values.std(0, correction=0)
    ones = torch.stack([(sd - 1).abs(), (values.std(0) - 1).abs()]).amin(0) < _STANDARD
    return bool((mean.abs() < _STANDARD).all() & (ones | (sd == 0)).all() & ones.any())


def _said(X: Tensor, y: Tensor, f: Tensor, scaled: bool, shifted: bool) -> str:
    """Return the fault of one output of one data set."""
    seen = ~y.isnan()
    if int(seen.sum()) < _LEAST:
        return ""
    fit = _fit(y[seen], f[seen], scaled, shifted)
    if fit.sd <= _ROUNDING * fit.size:
        return ""
    cause = _of_inputs(X, fit) or _of_values(fit, scaled, shifted)
    if cause and is_standardised(y[seen].unsqueeze(-1)):
        cause += " The targets were standardised; f_p has to return what they are in."
    return cause and (
        f"at the training inputs f_p has a root mean square error of {_number(fit.rmse)}, where "
        f"the targets have a standard deviation of {_number(fit.sd)}: {cause}"
    )


def _of_inputs(X: Tensor, fit: _Fit) -> str:
    """Return a complaint if f_p is evaluated at scaled inputs."""
    most = _WORSE if fit.correlation > _FOLLOWS else 1.0
    if fit.rmse <= most * fit.sd or not is_standardised(X):
        return ""
    return (
        "are the inputs scaled? Each column of them has mean 0 and standard deviation 1, and the "
        f"correlation of f_p with the targets is {fit.correlation:.2f}. f_p reads raw units: give "
        "the model raw inputs; its input_transform may scale them, and shows f_p raw ones."
    )


def _of_values(fit: _Fit, scaled: bool, shifted: bool) -> str:
    """Return a complaint if f_p has a wrong sign, factor or offset."""
    apart = fit.rmse > _NEAR * fit.size
    off = apart and fit.left > _FAR * fit.sd
    sure = apart and fit.n >= _MANY
    r = fit.correlation
    opposite = r < -_FOLLOWS and r**2 * (fit.n - 2) > _SHOWN**2 * (1 - r**2)
    worse = sure and fit.left > _WORSE * fit.sd and r < -_SURELY
    better = fit.flipped < (1.0 if off else _LIKE) * fit.left
    if not scaled and opposite and better and (off or worse):
        large = f", and {_times(fit.factor)}" if abs(fit.factor) > _FACTOR else ""
        return f"f_p is of the opposite sign (correlation {r:.2f}){large}."
    tiny = sure and r > _SURELY and 0 < fit.factor < 1 / _TINY
    if not (off or tiny):
        return ""
    by_offset = not shifted and fit.rmse > _APART * fit.sd and fit.by_offset < _EXPLAINS * fit.rmse
    if by_offset and (scaled or fit.by_offset <= fit.by_factor):
        where = "above" if fit.offset > 0 else "below"
        return f"f_p is about {_number(abs(fit.offset))} {where} the targets."
    if not scaled and fit.factor > 0 and not 1 / _FACTOR < fit.factor < _FACTOR:
        return f"f_p is {_times(fit.factor)}; are its units those of the targets?"
    return ""


def _fit(y: Tensor, f: Tensor, scaled: bool, shifted: bool) -> _Fit:
    """Return the relation of f_p to targets, ``n`` each."""
    slope = float(f @ y / (f @ f)) if f.any() else 0.0
    if scaled:
        f = slope * f
        slope = 1.0
    y_c, f_c = y - y.mean(), f - f.mean()
    sd, spread, size = float(y.std()), float(f.std()), _rms(y)
    varies = spread > _ROUNDING * _rms(f) and sd > 0
    correlation = float(y_c @ f_c) / ((len(y) - 1) * sd * spread) if varies else 0.0
    by_factor, affine = _rms(y - slope * f), sd * max(0.0, 1 - correlation**2) ** 0.5
    if affine < _FITS * sd and by_factor > 1.5 * affine:  # beside an offset
        slope = correlation * sd / spread
    elif by_factor > _FITS * sd:
        slope = size / _rms(f) if _rms(f) > _HUGE * size else 0.0
        slope = -slope if correlation < -_FOLLOWS else slope
    factor = 1 / slope if slope else 0.0
    error, sum_of_both = f - y, f + y
    by_offset = _rms(error - error.mean())
    return _Fit(
        n=len(y),
        sd=sd,
        size=size,
        rmse=_rms(error),
        left=by_offset if shifted else _rms(error),
        correlation=correlation,
        factor=factor,
        by_factor=by_factor,
        offset=float(error.mean()),
        by_offset=by_offset,
        flipped=_rms(sum_of_both - sum_of_both.mean() * shifted),
    )


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def _times(factor: float) -> str:
    """Return a text for a factor, too large or too small."""
    large = abs(factor) >= 1
    times = abs(factor) if large else 1 / abs(factor)
    return f"about {_number(times, 2)} times too {'large' if large else 'small'}"


def _number(value: float, digits: int = 3) -> str:
    """With some significant digits, and without an exponent where it can be read so."""
    text = f"{value:.{digits}g}"
    return f"{float(text):,.0f}" if "e+" in text and value < 1e7 else text
