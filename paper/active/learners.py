"""Ways to choose where to measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from botorch.acquisition import AcquisitionFunction, qNegIntegratedPosteriorVariance
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from torch import Tensor

from gpadjust.active import qAdjustmentInformationGain
from gpadjust.active.adjustment_information_gain import About

Acquisition = Callable[[Any, Tensor], AcquisitionFunction]


@dataclass(frozen=True)
class Learner:
    """A way to choose, and the model that learns.

    Args:
        label: Its name in tables and figures.
        with_physics: Whether its model is CKA, or a Gaussian process without physics.
        design: How the points are drawn if no model chooses them.
        acquisition: What a fitted model and integration points make; None for a design.
    """

    label: str
    with_physics: bool
    design: Literal["random", "sobol"] | None = None
    acquisition: Acquisition | None = None


def integrated_variance(model: Any, points: Tensor) -> AcquisitionFunction:
    """Minus the variance of f_a that would be left, averaged over points.

    Of several outputs the sum, each in units of the standard deviation of what was measured: as
    the outputs are independent, it is the variance of their sum in these units.
    """
    if model.num_outputs == 1:
        return qNegIntegratedPosteriorVariance(model, mc_points=points)
    measured, _ = model.outcome_transform.untransform(model.train_targets.mT)
    in_units = ScalarizedPosteriorTransform(1 / measured.std(0))
    return qNegIntegratedPosteriorVariance(model, mc_points=points, posterior_transform=in_units)


def information(model: Any, points: Tensor, about: About) -> AcquisitionFunction:
    """The information about the adjustments; it needs no points to integrate over."""
    return qAdjustmentInformationGain(model, about=about)


LEARNERS = {
    "random": Learner("CKA, random points", True, design="random"),
    "sobol": Learner("CKA, Sobol points", True, design="sobol"),
    "gp": Learner("GP, integrated variance", False, acquisition=integrated_variance),
    "cka": Learner("CKA, integrated variance", True, acquisition=integrated_variance),
    "both": Learner(
        "CKA, information on both", True, acquisition=partial(information, about="both")
    ),
    "rho": Learner("CKA, information on rho", True, acquisition=partial(information, about="rho")),
}
LABELS = {name: learner.label for name, learner in LEARNERS.items()}
