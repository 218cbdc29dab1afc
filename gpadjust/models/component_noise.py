"""Noise of several variances, of which each observation has a share."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from gpytorch.likelihoods.noise_models import MultitaskHomoskedasticNoise
from linear_operator.operators import DiagLinearOperator
from torch import Size, Tensor

from gpadjust.models.parameters import LogInterval


class ComponentNoise(_GaussianLikelihoodBase):
    r"""Gaussian noise of variances :math:`\sum_k h_k(x) \sigma_k^2`, the :math:`\sigma_k^2` learnt.

    A subclass says the shares h: which of several instruments an input belongs to, or 1 and the
    square of the physics for errors that are partly relative. Fits know its derivatives in closed
    form, and it broadcasts over the batches that fantasies add.

    Args:
        num_variances: Number ``K`` of variances.
        batch_shape: That of the model with its outputs last.
    """

    def __init__(self, num_variances: int, batch_shape: Size) -> None:
        noise = MultitaskHomoskedasticNoise(
            num_variances, noise_constraint=LogInterval(), batch_shape=batch_shape
        )
        super().__init__(noise)

    @abstractmethod
    def selection(self, inputs: Tensor) -> Tensor:
        """The shares h at transformed inputs ``... x n x (d + k)``, ``... x n x K``."""

    @property
    def noise(self) -> Tensor:
        """The variances, ``batch_shape x K``."""
        noise: Tensor = self.noise_covar.noise
        return noise

    def _shaped_noise_covar(
        self, base_shape: Size, *params: Any, **kwargs: Any
    ) -> DiagLinearOperator:
        if kwargs.get("noise") is not None:
            return DiagLinearOperator(kwargs["noise"])
        inputs = params[0] if isinstance(params[0], Tensor) else params[0][0]
        noise = (self.selection(inputs) * self.noise.unsqueeze(-2)).sum(-1)
        return DiagLinearOperator(noise.expand(torch.broadcast_shapes(noise.shape, base_shape)))
