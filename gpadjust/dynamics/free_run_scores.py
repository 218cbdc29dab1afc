"""How well free runs predict what was measured, step by step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.validation import nlpd, rmse

_CERTAIN = 1e-9  # of how far the means range: a spread that is one of rounding errors


class FreeRunScores(NamedTuple):
    """How well free runs predicted after 1 to ``T`` steps, over all windows: ``T x state_dim``.

    They are NaN where nothing was measured. Of an unstable system a few runs that fall to the other
    side make up most of a mean square: look at the median beside it.

    Args:
        rmse: Root mean square error of the runs' means, in the state's units.
        median: Median absolute error of the same, in the state's units.
        coverage: Share of what was measured that lies between ``lower`` and ``upper``; of
            calibrated runs it is near their ``level``.
        nlpd: Mean negative log density of the Gaussian with the particles' mean and variance, in
            nats. (The plug-in of an estimated variance, as in :class:`TrajectoryScores`.)

    ``coverage`` and ``nlpd`` are NaN, too, where the particles of a window have no spread, which
    says nothing of errors, and leave out windows of which a run says no interval.
    """

    rmse: Tensor
    median: Tensor
    coverage: Tensor
    nlpd: Tensor


def score_free_runs(
    mean: Tensor, interval: tuple[Tensor, Tensor], variance: Tensor, measured: Tensor
) -> FreeRunScores:
    """The scores, over the first dimension of tensors ``w x T x state_dim``.

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
    return FreeRunScores(
        rmse=rmse(*points),
        median=(measured - mean).abs().nanmedian(0).values,
        coverage=inside.masked_fill(judged.isnan(), torch.nan).nanmean(0),
        nlpd=density,
    )
