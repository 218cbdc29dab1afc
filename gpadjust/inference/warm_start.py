"""Hyper-parameters of a model that another one of the same structure starts from."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch

from gpadjust.gp import AppendedPhysics
from gpadjust.models import TermsGP, TermsModel, VariationalCKA
from gpadjust.models.hyperparameter_samples import adjusts, uses_physics
from gpadjust.models.parameters import hyperparameters


def warm_start(model: TermsModel, previous: TermsModel) -> None:
    """Give a model the hyper-parameters of an earlier one of the same structure.

    They are the same in the user's units: lengthscales, centers, unknown parameters of the physics,
    and the variance of a scaling of it, stay; the other variances follow the units that the outcome
    transforms put the targets in, which change with the data. Of a model that holds samples it is
    their mean.

    Args:
        model: The model to start, changed in place.
        previous: The model with the hyper-parameters, of other data.
    """
    if isinstance(previous, TermsGP) and previous.num_samples is not None:
        previous = _mean_of_samples(previous)
    ratio = 2 * (previous.units()[1] / model.units()[1]).log().squeeze(-1)  # ... x (m)
    source = dict(previous.named_parameters())
    with torch.no_grad():
        if model.has_unknowns and previous.has_unknowns:
            model.train()  # its inputs are then transformed again
            known, now = (each.input_transform.coordinates for each in (previous, model))
            now.copy_(known.where(known.isfinite(), now))
        for row in hyperparameters(model):
            if not row.raw.requires_grad:
                continue
            value: Any = source[row.name]
            if isinstance(row.owner, AppendedPhysics) and row.kind == "constant":
                earlier: Any = previous.get_submodule(row.name.rpartition(".")[0])
                value = row.owner.center_at(earlier.origin)
            if row.kind in ("outputscale", "noise"):
                factor = ratio[(..., *[None] * (value.dim() - ratio.dim()))].exp()
                value = row.constraint.inverse_transform(row.parameter(value) * factor)
            row.raw.copy_(value.where(value.isfinite(), row.raw))
    if isinstance(model, VariationalCKA):
        model.forget()
        if model.has_unknowns:
            model.ask_physics()


def _mean_of_samples(model: TermsGP) -> TermsGP:
    """A copy with the means of the raw parameters that a model holds samples of.

    Samples without the physics, or of it alone, do not count; NaN where there are no others.
    """
    held, counts = dict(model.named_parameters()), (uses_physics(model) & adjusts(model)).double()
    weights, shape = counts / counts.sum(0), counts.shape
    model = deepcopy(model)
    model.release_samples()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            values = held[name]
            if values.shape[: len(shape)] == shape:
                own = weights.reshape(*shape, *[1] * (values.dim() - len(shape)))
                parameter.copy_((own * values).sum(0).reshape(parameter.shape))
            elif values.dim() > parameter.dim():
                parameter.copy_(values.mean(0).reshape(parameter.shape))
    return model
