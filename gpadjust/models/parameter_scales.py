"""Typical sizes of a model's hyper-parameters, read off its training data.

Initial values and search ranges are multiples of them, so that a fit does not depend on the units
of inputs, targets or physics.
"""

from __future__ import annotations

from typing import Any

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.constraints import Interval
from gpytorch.kernels import Kernel, ScaleKernel
from torch import Tensor

from gpadjust.gp import DataInterval, InputsKernel, PhysicsScaledKernel, UnknownMeanKernel

# Multiples of the typical sizes. Noise below a millionth of the residual's mean square is not
# told from none, and a higher floor would cap the accuracy.
INITIAL = {"lengthscale": 0.5, "outputscale": 0.5, "noise": 1e-2, "constant": 1e2}
BOUNDS = {
    "lengthscale": (1e-2, 1e3),
    "outputscale": (1e-6, 1e6),
    "noise": (1e-6, 1e1),
    "constant": (1e-100, 1e100),
}


def parameter_scales(model: BatchedMultiOutputGPyTorchModel) -> dict[str, Tensor]:
    """Return the typical value of each lengthscale, outputscale and noise of a model.

    The keys are names of raw parameters, the values tensors of the (transformed) parameter's
    shape: the range of the inputs for a lengthscale; the mean square of the targets' residual
    from the prior mean for noise and outputscales, divided by the mean square of the physics for
    the outputscale of a :class:`~gpadjust.gp.PhysicsScaledKernel`. Parameters of other kinds are
    left out.
    """
    inputs, targets = _training_set(model)
    with torch.no_grad():
        residual = targets - model.mean_module(inputs)
        unit = residual.square().mean(-1)
        unit = unit.where(unit > 0, torch.ones_like(unit))
        ranges = inputs.amax(-2, keepdim=True) - inputs.amin(-2, keepdim=True)
        ranges = ranges.where(ranges > 0, torch.ones_like(ranges))
        sizes: dict[str, Tensor] = {}
        _visit(model.covar_module, "covar_module", inputs, ranges, unit, sizes)
        for name, noise in model.likelihood.named_parameters():
            if name.endswith("raw_noise"):
                sizes[f"likelihood.{name}"] = unit.unsqueeze(-1).expand(noise.shape)
    return sizes


def set_initial_values(model: BatchedMultiOutputGPyTorchModel, *given: object) -> None:
    """Set initial values, and bounds of the search, to multiples of the typical sizes.

    Args:
        model: The model to initialise.
        given: Modules that the user brought, whose parameters stay as they are.
    """
    modules = [module for module in given if isinstance(module, torch.nn.Module)]
    keep = {id(p) for module in modules for p in module.parameters()}
    named = dict(model.named_parameters())
    for name, size in parameter_scales(model).items():
        if id(named[name]) in keep:
            continue
        lower, upper = BOUNDS[kind(name)]
        constraint = constraint_of(model, name)
        if isinstance(constraint, DataInterval):
            # One bound for all outputs, as BoTorch's optimiser wants it.
            constraint.lower_bound = lower * size.amin()
            constraint.upper_bound = upper * size.amax()
        with torch.no_grad():
            named[name].copy_(constraint.inverse_transform(INITIAL[kind(name)] * size))


def kind(name: str) -> str:
    """What a raw parameter is: ``"lengthscale"``, ``"outputscale"``, ``"noise"`` and so on."""
    return name.rsplit(".", 1)[-1].removeprefix("raw_")


def constraint_of(model: torch.nn.Module, name: str) -> Any:
    """The GPyTorch constraint of a parameter, by its name, or None."""
    path, _, leaf = name.rpartition(".")
    constraint = getattr(model.get_submodule(path), f"{leaf}_constraint", None)
    return constraint if isinstance(constraint, Interval) else None


def _training_set(model: BatchedMultiOutputGPyTorchModel) -> tuple[Tensor, Tensor]:
    """The transformed training inputs and targets, in whatever mode the model is."""
    inputs = model.train_inputs[0]
    if not model._has_transformed_inputs:
        with torch.no_grad():
            inputs = model.transform_inputs(inputs)
    return inputs, model.train_targets


def _visit(
    module: torch.nn.Module,
    name: str,
    inputs: Tensor,
    ranges: Tensor,
    scale: Tensor,
    sizes: dict[str, Tensor],
) -> None:
    """Walk down a kernel, following what each level does to its inputs and its scale."""
    if isinstance(module, PhysicsScaledKernel):
        power = module.physics(inputs).square().mean(-1)
        scale = (scale / power).where(power > 0, torch.ones_like(scale))
    if isinstance(module, Kernel) and module.active_dims is not None:
        ranges = ranges.index_select(-1, module.active_dims)
    if isinstance(module, ScaleKernel):
        sizes[f"{name}.raw_outputscale"] = scale.expand(module.raw_outputscale.shape)
    if isinstance(module, UnknownMeanKernel):
        sizes[f"{name}.raw_constant"] = scale.unsqueeze(-1).expand(module.raw_constant.shape)
    if isinstance(module, InputsKernel):
        ranges = ranges[..., : module.num_inputs]
    if isinstance(module, Kernel) and module.has_lengthscale:
        shape = module.raw_lengthscale.shape
        size = ranges if shape[-1] == ranges.shape[-1] else ranges.mean(-1, keepdim=True)
        sizes[f"{name}.raw_lengthscale"] = size.expand(shape)
    for child_name, child in module.named_children():
        _visit(child, f"{name}.{child_name}", inputs, ranges, scale, sizes)
