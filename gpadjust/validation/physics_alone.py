"""The physics alone, as it is: what its left-out predictions are."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor
from torch.distributions import StudentT

from gpadjust.models.training_data import TrainingData
from gpadjust.physics import JoinedPhysics, Physics
from gpadjust.validation.leave_one_out import LeaveOneOut, log_densities
from gpadjust.validation.structures import ALONE

_ROUNDING = 1e-8  # of the observations' standard deviation; to predict better shows nothing


def physics_alone(physics: Physics, data: TrainingData) -> dict[str, LeaveOneOut]:
    r"""Each physics as it is, with noise whose variance the other observations tell.

    Nothing is fitted, :math:`y_i = f_p(x_i) + \epsilon_i`. With a prior of the variance that does
    not depend on units, an observation that is left out has Student's distribution about f_p with
    the mean square error at the others and ``n - 1`` degrees of freedom (Gelman et al. 2013,
    section 3.2); with known variances it is Gaussian.

    Args:
        physics: The physics, or several. Those with unknown parameters are left out: alone, they
            are :class:`~gpadjust.CalibratedPhysics`.
        data: Of one data set.

    Returns:
        The predictions by ``"physics alone"``, of several physics ``"physics alone of coarse"`` and
        so on.
    """
    named = {ALONE: physics}
    if isinstance(physics, JoinedPhysics):
        parts = cast(Iterable[Physics], physics.parts)
        each = zip(physics.names, parts, strict=True)
        named = {f"{ALONE} of {name}": part for name, part in each}
    return {name: _left_out(part, data) for name, part in named.items() if not part.unknowns}


@torch.no_grad()
def _left_out(physics: Physics, data: TrainingData) -> LeaveOneOut:
    mean: Tensor = physics(data.X)
    if data.Yvar is not None:
        variance = data.Yvar.expand_as(mean)
        density = log_densities(mean.unsqueeze(-3), variance.unsqueeze(-3), data.Y).squeeze(-3)
        return LeaveOneOut(data.X, data.Y, mean, variance, density, data.output_names)
    squares = (data.Y - mean).square()
    freedom = (~data.Y.isnan()).sum(0) - 1
    others = squares.nansum(0) - squares.nan_to_num(nan=0.0)
    spread = (data.Y - data.Y.nanmean(0)).square().nanmean(0)
    scale = torch.maximum(others.clamp_min(0) / freedom, _ROUNDING**2 * spread).sqrt()
    student = StudentT(freedom.to(mean), mean, scale, validate_args=False)
    variance = student.variance.nan_to_num(nan=torch.inf)
    density = student.log_prob(data.Y)
    return LeaveOneOut(data.X, data.Y, mean, variance, density, data.output_names)
