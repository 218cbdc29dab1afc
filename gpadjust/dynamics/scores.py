"""How well next states and free runs are predicted."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.models import Prediction
from gpadjust.states import StateSpec
from gpadjust.validation import coverage, nlpd, rmse

_CERTAIN = 1e-9  # of how far the means range: a spread that is one of rounding errors
_AT_ONCE = 64  # windows, of whose particles all pairs are compared at once


class TransitionScores(NamedTuple):
    r"""How well transitions were predicted, for each state that moves: ``len(spec.moving)``.

    These are the states that a model predicts and those integrated from them, in the spec's order;
    exogenous ones and previous values are left out. The variance of an integrated state is what
    the dynamics say, :math:`(h / 2)^2` times that of its velocity: the more certain the velocity,
    the more the trapezoid's own error counts in its ``nlpd`` and ``coverage``. Both are NaN where
    a variance is zero, which says nothing of errors.

    Args:
        nlpd: Mean negative log predictive density, in nats.
        coverage: Share of the next states in the central 95 % interval.
        rmse: Root mean square error, in the state's units.
    """

    nlpd: Tensor
    coverage: Tensor
    rmse: Tensor


class FreeRunScores(NamedTuple):
    r"""How well free runs predicted, over all windows, after ``H`` numbers of steps.

    They are NaN where nothing was measured. Of an unstable system a few runs that fall to the other
    side make up most of a mean square: look at the median beside it. Windows that overlap, and see
    the same functions, have scores that scatter more than those of as many independent predictions.

    Args:
        rmse: Root mean square error of the runs' means, in the state's units, ``H x state_dim``.
        median: Median absolute error of the same, in the state's units, ``H x state_dim``.
        coverage: Share of what was measured that lies between ``lower`` and ``upper``,
            ``H x state_dim``; of calibrated runs it is near their ``level``.
        nlpd: Mean negative log density of the Gaussian with the particles' mean and variance, in
            nats, ``H x state_dim``. (The plug-in of an estimated variance: with 39 particles some
            0.03 nats more than their number itself deserves.)
        energy: Mean energy score of all states that move together, ``H``,
            :math:`\frac1K \sum_i |x_i - y| - \frac{1}{2 K (K - 1)} \sum_{i \neq j} |x_i - x_j|` of
            ``K`` particles, each state in units of its typical change in a step (Gneiting and
            Raftery 2007, sec. 4.3; without bias of ``K``: Ferro 2014), over the windows in which
            all of them were measured. Lower is better; of dynamics without doubt it is the
            distance itself.

    ``coverage`` and ``nlpd`` are NaN, too, where the particles of a window have no spread, which
    says nothing of errors, and leave out windows of which a run says no interval.
    """

    rmse: Tensor
    median: Tensor
    coverage: Tensor
    nlpd: Tensor
    energy: Tensor


def score_transitions(
    spec: StateSpec, prediction: Prediction, data: Trajectories
) -> TransitionScores:
    """Compare predictions ``N x state_dim`` with what followed, angles the shortest way round."""
    mean, variance = (tensor[:, spec.moving] for tensor in prediction)
    found = mean + spec.change(prediction[0], data.next_states)[:, spec.moving]
    says = (variance > 0).all(0)
    silent = torch.full_like(says, torch.nan, dtype=mean.dtype)
    return TransitionScores(
        nlpd=nlpd(mean, variance, found).where(says, silent),
        coverage=coverage(mean, variance, found).where(says, silent),
        rmse=rmse(mean, found),
    )


def score_free_runs(
    mean: Tensor, interval: tuple[Tensor, Tensor], variance: Tensor, measured: Tensor
) -> dict[str, Tensor]:
    """The scores of each state, over the first dimension of tensors ``w x T x state_dim``.

    Args:
        mean: Means of the particles.
        interval: Lower and upper ends; NaN where there is none.
        variance: Variances of the particles; NaN where there is no interval.
        measured: What was measured, angles within half a turn of the mean; NaN where nothing was.
    """
    range_of_means = mean.amax((0, 1)) - mean.amin((0, 1))
    silent = (variance.sqrt() <= _CERTAIN * range_of_means).any(0)
    judged = measured.masked_fill(variance.isnan() | silent, torch.nan)
    inside = ((interval[0] <= judged) & (judged <= interval[1])).double()
    points = mean.transpose(0, 1), measured.transpose(0, 1)  # T x w x state_dim
    density = nlpd(points[0], variance.nan_to_num(nan=1.0).transpose(0, 1), judged.transpose(0, 1))
    return {
        "rmse": rmse(*points),
        "median": (measured - mean).abs().nanmedian(0).values,
        "coverage": inside.masked_fill(judged.isnan(), torch.nan).nanmean(0),
        "nlpd": density,
    }


def energy_scores(sample: Tensor, y: Tensor) -> Tensor:
    """Energy scores of samples ``K x ... x m`` at points ``... x m``; NaN where an entry is."""
    error = (sample - y).norm(dim=-1).mean(0)
    num, clouds = len(sample), sample.flatten(1, -2).transpose(0, 1)
    # Not by products, which cancel.
    mode = "donot_use_mm_for_euclid_dist"
    pairs = [torch.cdist(c, c, compute_mode=mode).sum((-2, -1)) for c in clouds.split(_AT_ONCE)]
    return error - torch.cat(pairs).view_as(error) / (2 * num * (num - 1))


def typical_change(spec: StateSpec, states: Tensor, next_states: Tensor) -> Tensor:
    """Root mean square change of each state in a step, ``state_dim``; 1 if it never changed.

    Args:
        spec: What the entries of states are.
        states: ``... x state_dim``.
        next_states: ``... x state_dim``; NaN where an entry was not measured.
    """
    change = spec.change(states, next_states).flatten(0, -2)
    size = change.square().nanmean(0).sqrt()
    return size.where(size > 0, torch.ones_like(size))
