"""Leave-one-out by fitting again without each observation."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from typing import Any, cast

import torch
from botorch.models.transforms.input import InputTransform
from botorch.posteriors.fully_bayesian import MCMC_DIM

from gpadjust.inference.fitting import fit
from gpadjust.models.training_data import TrainingData
from gpadjust.physics import FunctionPhysics, JoinedPhysics, Physics, as_physics
from gpadjust.validation.leave_one_out import LeaveOneOut, log_densities, mixture_of
from gpadjust.validation.structures import Structure

LEAST = 3  # observations of an output, for one to be left out


def refitted(
    structure: Structure,
    data: TrainingData,
    physics: Physics,
    input_transform: InputTransform | None,
    **options: Any,
) -> LeaveOneOut:
    """Predict each observation by full Bayes of all others.

    The ``n`` fits run in lockstep, as ``n m`` outputs of one model: the i-th copy of an output
    lacks its i-th observation. So the physics may have no unknown parameters, which outputs share.

    Args:
        structure: What to fit.
        data: Of one data set; at least three observations of each output.
        physics: The physics f_p.
        input_transform: As in :class:`~gpadjust.CKA`.
        options: Of :func:`~gpadjust.fit`.
    """
    X, Y = data.X, data.Y
    n, m = Y.shape
    one = torch.eye(n, dtype=torch.bool, device=Y.device).repeat(1, m)
    noise = None if data.Yvar is None else data.Yvar.repeat_interleave(n, -1)
    model = structure.build(
        X,
        Y.repeat_interleave(n, -1).masked_fill(one, torch.nan),
        noise,
        physics=_repeated(deepcopy(physics), n),
        input_transform=deepcopy(input_transform),
    )
    fit(model, "bayes", **options)
    with torch.no_grad():
        every = model.components(X, True if noise is None else noise)
        each = [moments.unflatten(-1, (m, n)) for moments in every]
        mean, variance = (moments.diagonal(dim1=-3, dim2=-1).mT for moments in each)
    density = log_densities(mean, variance, Y)
    weight = torch.full_like(mean, 1 / mean.shape[MCMC_DIM])
    return LeaveOneOut(X, Y, *mixture_of(mean, variance, density, weight), data.output_names)


def _repeated(physics: Physics, times: int) -> Physics:
    """A physics with each of its outputs so many times."""
    if isinstance(physics, JoinedPhysics):
        parts = zip(physics.names, cast(Iterable[Physics], physics.parts), strict=True)
        return as_physics({name: _repeated(part, times) for name, part in parts})
    return FunctionPhysics(lambda X: physics(X).repeat_interleave(times, -1))
