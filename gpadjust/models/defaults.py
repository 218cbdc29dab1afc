"""What a model uses where the user says nothing: kernels and likelihood.

Their initial values and bounds follow the data, see :mod:`gpadjust.models.parameter_scales`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood, Likelihood
from torch import Size, Tensor

from gpadjust.gp import DataInterval


def scaled_rbf(num_inputs: int, batch_shape: Size) -> ScaleKernel:
    """An RBF kernel with one lengthscale per input and an outputscale."""
    base = RBFKernel(
        ard_num_dims=num_inputs, batch_shape=batch_shape, lengthscale_constraint=DataInterval()
    )
    return ScaleKernel(base, batch_shape=batch_shape, outputscale_constraint=DataInterval())


def default_likelihood(train_Yvar: Tensor | None, batch_shape: Size) -> Likelihood | None:
    """Learnt Gaussian noise; or None, BoTorch's fixed noise, where the variances are known."""
    if train_Yvar is not None:
        return None
    return GaussianLikelihood(batch_shape=batch_shape, noise_constraint=DataInterval())


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
        if isinstance(kernel, torch.nn.Module | type) or not callable(kernel):
            raise TypeError(f"Expected {name} to be a GPyTorch kernel, got {kernel!r}.")
        return kernel(num_inputs, batch_shape)
    if kernel.batch_shape != batch_shape:
        raise ValueError(
            f"Expected {name} with batch_shape {tuple(batch_shape)}, one for each output, got "
            f"{tuple(kernel.batch_shape)}; pass `batch_shape=torch.Size({list(batch_shape)})` to "
            "it and to the kernels inside it."
        )
    return kernel
