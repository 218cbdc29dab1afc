"""How well transitions are predicted."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.transitions import Transitions
from gpadjust.models import Prediction
from gpadjust.states import StateSpec
from gpadjust.validation import coverage, nlpd, rmse


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


def score_transitions(
    spec: StateSpec, prediction: Prediction, data: Transitions
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
