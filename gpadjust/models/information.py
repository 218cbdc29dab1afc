"""What observations would tell of what a model does not know."""

from __future__ import annotations

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.settings import min_variance
from linear_operator.operators import DiagLinearOperator
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor

from gpadjust.models.conditional_covariance import ConditionalCovariance
from gpadjust.models.multi_output_gp import MultiOutputGP


def information_gain(
    model: MultiOutputGP,
    X: Tensor,
    unknown: ConditionalCovariance,
    remaining: ConditionalCovariance | None = None,
    counted: Tensor | None = None,
) -> Tensor:
    r"""The information of noisy observations at a batch of points, in nats.

    With the covariance C of what is unknown at the points X and the noise variances S it is
    :math:`\tfrac{1}{2} \log\det(I + S^{-1/2} C S^{-1/2})`, which is never singular, less the same
    for what would remain unknown; summed over the independent outputs.

    Args:
        model: The model, in eval mode.
        X: Raw inputs, ``batch_shape x q x d``.
        unknown: What the data leave unknown.
        remaining: What would be unknown if the function in question were known. Default: nothing.
        counted: Which observations are made, ``batch_shape x q`` booleans. Default: all.

    Returns:
        The information, ``batch_shape``; of a model that holds samples of its hyper-parameters, of
        each of these, ``batch_shape x S``.
    """
    inputs = model.transform_inputs(model._for_samples(X))
    inputs = inputs.unsqueeze(-3) if model.num_outputs > 1 else inputs
    batch_shape = torch.broadcast_shapes(inputs.shape[:-2], model.train_inputs[0].shape[:-2])
    inputs = inputs.expand(*batch_shape, *inputs.shape[-2:])
    noise = _noise(model, inputs)
    if counted is not None:
        for _ in range(noise.dim() - counted.dim()):
            counted = counted.unsqueeze(-2)
        noise = noise.masked_fill(~counted, torch.inf)  # such an observation tells nothing
    information = _log_sds(unknown(inputs), noise)
    if remaining is not None:
        information = information - _log_sds(remaining(inputs), noise)
    return information.sum(-1) if model.num_outputs > 1 else information


def _noise(model: MultiOutputGP, inputs: Tensor) -> Tensor:
    """The noise variances of observations at transformed inputs, ``... x q``."""
    nothing = torch.zeros_like(inputs[..., 0])
    silent = MultivariateNormal(nothing, DiagLinearOperator(nothing))
    with min_variance(double_value=0.0):
        noise: Tensor = model._apply_noise(inputs, silent, True).variance
    return noise


def _log_sds(covariance: Tensor, noise: Tensor) -> Tensor:
    """Half the log-determinant of noisy observations' covariance, in units of their noise."""
    sd = noise.sqrt()
    scaled = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    chol = psd_safe_cholesky(scaled + torch.eye(sd.shape[-1], dtype=sd.dtype, device=sd.device))
    log_sds: Tensor = chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    return log_sds
