"""Mean and covariance of a model's targets as functions of its hyper-parameters, for any model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import gpytorch
import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from linear_operator import to_dense
from torch import Tensor
from torch.func import functional_call
from torch.nn import Module

from gpadjust.gp import SumOfTerms
from gpadjust.gp.gaussian import cholesky, least_squares, noise_variances
from gpadjust.inference.log_parameters import LogParameters, Parameters

# Maps derivatives by mean and covariance to those by the (logarithmic) parameters.
PullBack = Callable[[Tensor, Tensor], Parameters]


class TargetDistribution(Protocol):
    """Mean and covariance of the targets, noise included, as functions of the parameters."""

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n``, which may be overwritten."""

    def with_pull_back(self, parameters: Parameters) -> tuple[Tensor, Tensor, PullBack]:
        """As calling it, with the function that carries derivatives back to the parameters."""


class ModuleDistribution:
    """The distribution by the model's own modules, differentiated by autograd.

    It serves every kernel, mean and likelihood. Autograd does not see the factorisation: it starts
    from the derivatives by mean and covariance, which are known in closed form.

    Args:
        model: The model, in train mode.
        inputs: Its training inputs, or some rows of them; transformed, unless the input transform
            is to be evaluated each time, as its parameters are among those that are learnt.
        parameters: Its learnable parameters.
        known_noise: The noise variances of these inputs, if they are known.
        marginal: Whether the prior variances of unknown constants count.
        targets: The targets, for a mean with the unknown constants at their least squares estimate.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        parameters: LogParameters,
        known_noise: Tensor | None,
        marginal: bool,
        targets: Tensor | None,
    ) -> None:
        self._noisy_prior = _NoisyPrior(model, inputs, parameters, known_noise, marginal, targets)
        self._parameters = parameters

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n``, noise included."""
        raw = self._parameters.to_raw(parameters)
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

        return mean.detach(), covariance.detach().clone(), pull_back


class _NoisyPrior(Module):
    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        parameters: LogParameters,
        known_noise: Tensor | None,
        marginal: bool,
        targets: Tensor | None,
    ) -> None:
        super().__init__()
        self.model = model
        self.inputs = inputs
        self.known_noise = known_noise
        self.targets = targets
        self.transforms = any(name.startswith("input_transform.") for name in parameters.names)
        kernel = model.covar_module
        self.known_means = isinstance(kernel, SumOfTerms) and not marginal

    def forward(self) -> tuple[Tensor, Tensor]:
        model = self.model
        inputs = model.transform_inputs(self.inputs) if self.transforms else self.inputs
        if self.known_means:
            covariance = model.covar_module.covariance(inputs, known_means=True)
        else:
            covariance = to_dense(model.covar_module(inputs))
        noise = self.known_noise
        noise = noise_variances(model.likelihood, inputs) if noise is None else noise
        noise = noise.expand(torch.broadcast_shapes(noise.shape, covariance.shape[:-1]))
        mean = model.mean_module(inputs).expand(noise.shape)
        covariance = covariance + torch.diag_embed(noise)
        if self.targets is not None:
            basis = model.covar_module.basis_of_means(inputs)
            # The estimate minimises the objective, so that no derivative goes through it.
            best = self._constants(self.targets - mean.detach(), covariance, basis)
            mean = mean + (basis @ best.unsqueeze(-1)).squeeze(-1)
        return mean, covariance

    @staticmethod
    @torch.no_grad()
    def _constants(residual: Tensor, covariance: Tensor, basis: Tensor) -> Tensor:
        observed = ~residual.isnan()
        chol, _ = cholesky(covariance.clone(), None if observed.all() else observed)
        basis = (basis * observed.unsqueeze(-1)).expand(*chol.shape[:-1], -1)
        return least_squares(chol, residual.nan_to_num(nan=0.0), basis)[0]
