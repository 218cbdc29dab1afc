"""Mean and covariance of a model's targets as functions of its hyper-parameters, for any model."""

from __future__ import annotations

from collections.abc import Callable

import gpytorch
import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from linear_operator import to_dense
from torch import Tensor

from gpadjust.gp import SumOfTerms
from gpadjust.gp.gaussian import cholesky, least_squares, noise_variances, nugget
from gpadjust.inference.log_parameters import LogParameters, Parameters

_VAGUE = 1e4  # the prior variance of an unknown constant mean, in squared standard errors


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
        self._model = model
        self._inputs = inputs
        self._parameters = parameters
        self._known_noise = known_noise
        self._marginal = marginal
        self._targets = targets

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n``, which may be overwritten."""
        with gpytorch.settings.lazily_evaluate_kernels(False):
            moments: tuple[Tensor, Tensor] = self._parameters.call_at(parameters, self._moments)
        return moments

    def _moments(self) -> tuple[Tensor, Tensor]:
        """Mean and covariance at the model's parameters."""
        model, inputs, noise = self._model, self._inputs, self._known_noise
        if self._parameters.learns_inputs:
            inputs = model.transform_inputs(inputs)
        if self._marginal or not isinstance(model.covar_module, SumOfTerms):
            covariance = to_dense(model.covar_module(inputs))
        else:
            covariance = model.covar_module.covariance(inputs, known_means=True)
        noise = noise_variances(model.likelihood, inputs) if noise is None else noise
        noise = noise.expand(torch.broadcast_shapes(noise.shape, covariance.shape[:-1]))
        mean = model.mean_module(inputs).expand(noise.shape)
        covariance = covariance + torch.diag_embed(noise)
        if self._targets is not None:
            basis = model.covar_module.basis_of_means(inputs)
            residual = self._targets - mean.detach()
            # The estimate minimises the objective, so that no derivative goes through it.
            best, _ = constant_means(residual, covariance.detach().clone(), basis.detach())
            mean = mean + (basis @ best.unsqueeze(-1)).squeeze(-1)
        return mean, covariance

    def with_pull_back(
        self, parameters: Parameters
    ) -> tuple[Tensor, Tensor, Callable[[Tensor, Tensor], Parameters]]:
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


@torch.no_grad()
def constant_means(residual: Tensor, covariance: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Estimate unknown constant means by generalised least squares.

    Args:
        residual: Targets less the rest of their mean, ``... x n``; NaN where there is none.
        covariance: Their covariance, ``... x n x n``; it is overwritten.
        basis: The bases of the means, ``... x n x q``.

    Returns:
        The estimates, and vague prior variances around them, ``... x q`` both.
    """
    observed = ~residual.isnan()
    chol, _ = cholesky(covariance, None if observed.all() else observed)
    basis = (basis * observed.unsqueeze(-1)).expand(*chol.shape[:-1], -1)
    means, errors = least_squares(chol, residual.nan_to_num(nan=0.0), basis)
    vague = _VAGUE * errors.diagonal(dim1=-1, dim2=-2)
    # A wider prior would drown the smallest pivot in rounding errors.
    pivot = chol.diagonal(dim1=-1, dim2=-2).amin(-1, keepdim=True).square()
    size = basis.square().amax(-2).clamp_min(torch.finfo(chol.dtype).tiny)
    return means, vague.minimum(pivot / (nugget(chol.shape[-1]) * size))
