"""Hyper-parameters of a model that another one of the same structure starts from."""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor

from gpadjust.gp import AppendedPhysics
from gpadjust.models import ExactGPBase, TermsModel, VariationalCKA
from gpadjust.models.hyperparameters import constraint_of, is_rho, kernels_of, kind_of


def warm_start(model: TermsModel, previous: TermsModel) -> None:
    """Give a model the hyper-parameters of an earlier one of the same structure.

    They are the same in the user's units: lengthscales, centres, unknown parameters of the physics,
    and the variance of a scaling of it, stay; the other variances follow the units that the outcome
    transforms put the targets in, which change with the data. Of a model that holds samples it is
    their mean.

    Args:
        model: The model to start, changed in place.
        previous: The model with the hyper-parameters, of other data.
    """
    if isinstance(model, VariationalCKA) and isinstance(previous, VariationalCKA):
        model, previous = model.start, previous.start
    unitless = [path for path, _, _, basis in kernels_of(model) if is_rho(basis)]
    if previous.num_samples is not None:
        previous = _mean_of_samples(previous)
    ratio = 2 * (previous._units()[1] / model._units()[1]).log().squeeze(-1)  # ... x (m)
    source = dict(previous.named_parameters())
    with torch.no_grad():
        if model.has_unknowns and previous.has_unknowns:
            model.train()  # its inputs are then transformed again
            model.input_transform.coordinates.copy_(previous.input_transform.coordinates)
        for name, parameter in model.named_parameters():
            if not parameter.requires_grad:
                continue
            value: Tensor = source[name]
            constraint = constraint_of(model, name)
            basis = model.get_submodule(name.rpartition(".")[0])
            earlier = previous.get_submodule(name.rpartition(".")[0])
            if isinstance(basis, AppendedPhysics) and isinstance(earlier, AppendedPhysics):
                value = basis.center_at(earlier.origin)
            follows = kind_of(name) in ("outputscale", "noise") and constraint is not None
            if follows and not any(name.startswith(f"{path}.") for path in unitless):
                factor = ratio[(..., *[None] * (value.dim() - ratio.dim()))].exp()
                value = constraint.inverse_transform(constraint.transform(value) * factor)
            parameter.copy_(value)


def _mean_of_samples(model: ExactGPBase) -> ExactGPBase:
    """A copy with the means of the raw parameters that a model holds samples of."""
    held = dict(model.named_parameters())
    model = deepcopy(model)
    model.release_samples()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if held[name].dim() > parameter.dim():
                parameter.copy_(held[name].mean(0).reshape(parameter.shape))
    return model
