"""What a model uses where the user says nothing: kernels, likelihood, and their bookkeeping."""

from __future__ import annotations

from collections.abc import Callable

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.constraints import GreaterThan, Positive
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood, Likelihood
from torch import Size, Tensor

from gpadjust.gp import FourierFeatures

NOISE_FLOOR = 1e-6  # of the residual's mean square; higher ones cap the accuracy


def log_positive() -> Positive:
    """A positivity constraint by the exponential: steps in it are relative, whatever the units."""
    return Positive(transform=torch.exp, inv_transform=torch.log)


def scaled_rbf(num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """An RBF kernel with one lengthscale per input and an outputscale."""
    base = RBFKernel(
        ard_num_dims=num_inputs, batch_shape=batch_shape, lengthscale_constraint=log_positive()
    )
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=log_positive())


def default_likelihood(
    train_Yvar: Tensor | None, residual: Tensor, batch_shape: Size
) -> Likelihood | None:
    """A Gaussian likelihood with learnt noise above a floor relative to the residual.

    Args:
        train_Yvar: Known variances; with them the result is None, and BoTorch's default applies.
        residual: ``y - f_p`` in the units of the targets, ``... x n x m``.
        batch_shape: The model's batch shape, the outputs last.
    """
    if train_Yvar is not None:
        return None
    power = residual.square().mean(-2)
    power = power.where(power > 0, torch.ones_like(power)).reshape(*batch_shape, 1)
    constraint = GreaterThan(0.0, transform=torch.exp, inv_transform=torch.log)
    constraint.lower_bound = NOISE_FLOOR * power
    return GaussianLikelihood(batch_shape=batch_shape, noise_constraint=constraint)


def make_kernel(
    kernel: Kernel | Callable[[int, Size], Kernel], name: str, num_inputs: int, batch_shape: Size
) -> Kernel:
    """Return a user's kernel, after checking its batch shape, or make the default one.

    Args:
        kernel: The kernel, or a function of ``num_inputs`` and ``batch_shape`` that makes it.
        name: What to call it in an error.
        num_inputs: Number of inputs after their transform.
        batch_shape: The model's batch shape, the outputs last.
    """
    if not isinstance(kernel, Kernel):
        if isinstance(kernel, torch.nn.Module) or not callable(kernel):
            raise TypeError(f"Expected {name} to be a GPyTorch kernel, got {kernel!r}.")
        return kernel(num_inputs, batch_shape)
    if kernel.batch_shape != batch_shape:
        raise ValueError(
            f"Expected {name} with batch_shape {tuple(batch_shape)}, one for each output, got "
            f"{tuple(kernel.batch_shape)}; pass `batch_shape=torch.Size({list(batch_shape)})` to "
            "it and to the kernels inside it."
        )
    return kernel


def output_dimensions(model: BatchedMultiOutputGPyTorchModel) -> dict[str, int]:
    """Where in each batched parameter and buffer the outputs lie, for ``subset_output``."""
    batch_shape = model._aug_batch_shape
    if model.num_outputs == 1:
        return {}
    shared = {
        f"{name}.{buffer}"
        for name, module in model.named_modules()
        if isinstance(module, FourierFeatures)
        for buffer, _ in module.named_buffers()
    }
    dimensions = {}
    for part in ("mean_module", "covar_module", "likelihood"):
        module = getattr(model, part)
        for name, tensor in [*module.named_parameters(), *module.named_buffers()]:
            full_name = f"{part}.{name}"
            if tensor.shape[: len(batch_shape)] == batch_shape and full_name not in shared:
                dimensions[full_name] = len(batch_shape) - 1 - tensor.dim()
    return dimensions
