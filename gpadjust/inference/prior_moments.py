"""Mean and covariance of a model's targets at hyper-parameter settings, for any model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import gpytorch
import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.distributions import MultivariateNormal
from torch import Tensor
from torch.func import functional_call
from torch.nn import Module

from gpadjust.inference.parameters import LogScale, Parameters

# Maps derivatives by mean and covariance to those by the parameters.
PullBack = Callable[[Tensor, Tensor], Parameters]


class Moments(Protocol):
    """Mean and covariance of the targets, noise included, as functions of the parameters."""

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n``."""

    def with_pull_back(self, parameters: Parameters) -> tuple[Tensor, Tensor, PullBack]:
        """As calling it, with the function that carries derivatives back to the parameters."""


class ModuleMoments:
    """Moments computed by the model's own modules, and differentiated by autograd.

    It serves every kernel, mean and likelihood. Autograd does not see the factorisation: it starts
    from the derivatives by mean and covariance, which are known in closed form.

    Args:
        model: The model, in train mode.
        inputs: Its training inputs; transformed, unless ``transform``.
        left_out: Logarithms of variances that are to be zero.
        transform: Whether the model's input transform is to be evaluated each time, as its
            parameters are among those that are learnt.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        left_out: list[str],
        transform: bool = False,
    ) -> None:
        self._noisy_prior = _NoisyPrior(model, inputs, transform)
        self._scale = LogScale(model)
        self._zero = {
            name: torch.full_like(self._scale.current(name), -torch.inf) for name in left_out
        }

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n``, noise included."""
        raw = self._scale.to_raw({**parameters, **self._zero})
        named = {f"model.{name}": value for name, value in raw.items()}
        with gpytorch.settings.lazily_evaluate_kernels(False):
            moments: tuple[Tensor, Tensor] = functional_call(self._noisy_prior, named, ())
        return moments

    def with_pull_back(self, parameters: Parameters) -> tuple[Tensor, Tensor, PullBack]:
        """As calling it, with the function that carries derivatives back to the parameters."""
        leaves = {name: v.detach().requires_grad_() for name, v in parameters.items()}
        with torch.enable_grad():
            mean, covariance = self(leaves)

        def pull_back(by_mean: Tensor, by_covariance: Tensor) -> Parameters:
            moments, derivatives = [covariance], [by_covariance]
            if mean.requires_grad:
                moments.append(mean)
                derivatives.append(by_mean)
            found = torch.autograd.grad(
                moments, list(leaves.values()), derivatives, allow_unused=True
            )
            return {
                name: torch.zeros_like(leaf) if gradient is None else gradient
                for (name, leaf), gradient in zip(leaves.items(), found, strict=True)
            }

        return mean.detach(), covariance.detach(), pull_back


class _NoisyPrior(Module):
    def __init__(
        self, model: BatchedMultiOutputGPyTorchModel, inputs: Tensor, transform: bool
    ) -> None:
        super().__init__()
        self.model = model
        self.inputs = inputs
        self.transform = transform

    def forward(self) -> tuple[Tensor, Tensor]:
        model = self.model
        inputs = model.transform_inputs(self.inputs) if self.transform else self.inputs
        covariance = model.covar_module(inputs)
        mean = model.mean_module(inputs).expand(covariance.shape[:-1])
        noisy = model.likelihood(MultivariateNormal(mean, covariance), inputs)
        return noisy.mean, noisy.lazy_covariance_matrix.to_dense()
