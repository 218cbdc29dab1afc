"""Going on from the hyper-parameters of an earlier fit."""

from __future__ import annotations

from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from torch import Tensor

from gpadjust.gp import PhysicsScaledKernel
from gpadjust.inference.parameters import LogScale
from gpadjust.models.parameter_scales import kind


def warm_start(
    model: BatchedMultiOutputGPyTorchModel, previous: BatchedMultiOutputGPyTorchModel
) -> None:
    """Give a model the hyper-parameters of an earlier one of the same structure.

    They are the same in the user's units: lengthscales, and the variance of a scaling of the
    physics, stay; the other variances follow the units that the outcome transforms put the
    targets in, which change with the data.

    Args:
        model: The model to start, changed in place.
        previous: The model with the hyper-parameters, of other data.
    """
    ratio = 2 * (_log_scale(previous) - _log_scale(model))  # shape: (m)
    unitless = {
        f"{path}.{name}"
        for path, module in model.named_modules()
        if isinstance(module, PhysicsScaledKernel)
        for name, _ in module.named_parameters()
    }
    source, target = LogScale(previous), LogScale(model)
    values = {}
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        value = source.current(name)
        if kind(name) in ("outputscale", "noise") and name not in unitless and target.covers(name):
            value = value + ratio[(..., *[None] * (value.dim() - ratio.dim()))]
        values[name] = value
    target.assign(values)


def _log_scale(model: BatchedMultiOutputGPyTorchModel) -> Tensor:
    """The logarithm of each output's unit, of the model's batch shape."""
    transform = getattr(model, "outcome_transform", None)
    if transform is None:
        return model.train_targets.new_zeros(model._aug_batch_shape)
    stdvs: Tensor = transform.stdvs.squeeze(-2)
    return (stdvs if model.num_outputs > 1 else stdvs.squeeze(-1)).log()
