"""The negative log marginal likelihood of many hyper-parameter settings at once."""

from __future__ import annotations

import math
from typing import Any

import gpytorch
import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.distributions import MultivariateNormal
from torch import Size, Tensor
from torch.func import functional_call
from torch.nn import Module

from gpadjust.physics import PhysicsError

_JITTER = 1e-8  # of the mean diagonal, for a covariance that is not positive definite without


class Objective:
    r"""Negative log marginal likelihood, less the log priors, of settings of a model.

    .. math:: \tfrac12 (y - m)^T K^{-1} (y - m) + \tfrac12 \log|K| + \tfrac n2 \log 2\pi

    A model's outputs (and batches) have their own hyper-parameters each, and are ``B`` problems
    apart; the model is evaluated at ``k`` settings of all of them in one batch. Where parameters
    are shared, by several outputs or with the input transform (a physics that learns), the outputs
    make up one problem, ``B = 1``, and the settings are evaluated one after the other.

    Attributes:
        names: The names of the model's learnable parameters.
        num_problems: Number ``B`` of problems.
        num_parameters: Number ``p`` of parameters of each.
        batch_shape: The shape whose elements are the problems.
    """

    def __init__(self, model: BatchedMultiOutputGPyTorchModel) -> None:
        model.train()
        self.model = model
        parameters = {n: p for n, p in model.named_parameters() if p.requires_grad}
        if not parameters:
            raise ValueError(
                "The model has no learnable parameter: all have `requires_grad=False`."
            )
        outputs = model._aug_batch_shape
        learns_inputs = any(name.startswith("input_transform.") for name in parameters)
        own = all(p.shape[: len(outputs)] == outputs for p in parameters.values())
        self.is_batched = own and not learns_inputs
        self.batch_shape = outputs if self.is_batched else Size()
        self.num_problems = self.batch_shape.numel()
        self.names = list(parameters)
        self.shapes = [p.shape[len(self.batch_shape) :] for p in parameters.values()]
        self.num_parameters = sum(shape.numel() for shape in self.shapes)
        inputs = model.train_inputs[0]
        if not learns_inputs:
            with torch.no_grad():
                inputs = model.transform_inputs(inputs)
        self._covariance = _NoisyPrior(model, inputs, transform=learns_inputs)

    def flatten(self, values: dict[str, Tensor]) -> Tensor:
        """Pack one tensor per parameter name, ``k x`` its shape, into ``k x B x p``."""
        parts = [
            values[name].reshape(-1, self.num_problems, shape.numel())
            for name, shape in zip(self.names, self.shapes, strict=True)
        ]
        return torch.cat(parts, dim=-1)

    def unflatten(self, settings: Tensor) -> dict[str, Tensor]:
        """The reverse of :meth:`flatten`."""
        sizes = [shape.numel() for shape in self.shapes]
        parts = settings.split(sizes, dim=-1)
        return {
            name: part.reshape(-1, *self.batch_shape, *shape)
            for name, part, shape in zip(self.names, parts, self.shapes, strict=True)
        }

    def current(self) -> Tensor:
        """The model's own setting, ``1 x B x p``."""
        named = dict(self.model.named_parameters())
        return self.flatten({name: named[name].detach().unsqueeze(0) for name in self.names})

    def assign(self, setting: Tensor) -> None:
        """Give the model a setting, ``B x p``."""
        named = dict(self.model.named_parameters())
        with torch.no_grad():
            for name, value in self.unflatten(setting.unsqueeze(0)).items():
                named[name].copy_(value.squeeze(0))

    def __call__(self, settings: Tensor) -> Tensor:
        """Return the objective at ``settings`` (``k x B x p``) as ``k x B``.

        It is infinite where the covariance has no Cholesky factor.
        """
        if self.is_batched:
            return self._evaluate(self.unflatten(settings)).reshape(-1, self.num_problems)
        return torch.stack([self._evaluate_together(setting) for setting in settings])

    def _evaluate_together(self, setting: Tensor) -> Tensor:
        """The objective of a model whose outputs share parameters, ``1``."""
        parameters = {name: v[0] for name, v in self.unflatten(setting.unsqueeze(0)).items()}
        try:
            return self._evaluate(parameters).sum().reshape(1)
        except PhysicsError:
            # Parameters that the physics cannot run with are a bad setting, not the end of a fit.
            return setting.new_full((1,), math.inf)

    def value_and_gradient(self, settings: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective and its gradient, ``k x B`` and ``k x B x p``."""
        settings = settings.detach().requires_grad_()
        with torch.enable_grad():
            values = self(settings)
            finite = values.isfinite()
            total = torch.where(finite, values, torch.zeros_like(values)).sum()
            # The second term keeps the graph where no setting is feasible.
            (gradient,) = torch.autograd.grad(total + 0 * settings.sum(), settings)
        return values.detach(), gradient

    def best_scale(self, settings: Tensor) -> Tensor:
        r"""The factor of all variances that maximises the likelihood, ``k x B``.

        With :math:`c K` in place of :math:`K` it is :math:`(y - m)^T K^{-1} (y - m) / n`.
        """
        if not self.is_batched:
            return torch.ones_like(settings[..., 0])
        _, square = self._terms(self.unflatten(settings))
        return (square / self.model.train_targets.shape[-1]).reshape(-1, self.num_problems)

    def _evaluate(self, parameters: dict[str, Tensor]) -> Tensor:
        return self._terms(parameters)[0]

    def _terms(self, parameters: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        named = {f"model.{name}": value for name, value in parameters.items()}
        with gpytorch.settings.lazily_evaluate_kernels(False):
            mean, covariance, log_prior = functional_call(self._covariance, named, ())
        residual = (self.model.train_targets - mean).unsqueeze(-1)
        chol, failed = _cholesky(covariance)
        white = torch.linalg.solve_triangular(chol, residual, upper=False).squeeze(-1)
        log_det = 2 * chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
        n = residual.shape[-2]
        square = white.square().sum(-1)
        nll = 0.5 * (square + log_det + n * math.log(2 * math.pi)) - log_prior
        bad = failed | ~nll.isfinite()
        return torch.where(bad, torch.full_like(nll, math.inf), nll), square


class _NoisyPrior(Module):
    """Mean and covariance of the targets, and the log prior density of the parameters."""

    def __init__(
        self, model: BatchedMultiOutputGPyTorchModel, inputs: Tensor, transform: bool
    ) -> None:
        super().__init__()
        self.model = model
        self.inputs = inputs
        self.transform = transform

    def forward(self) -> tuple[Tensor, Tensor, Tensor]:
        model = self.model
        inputs = model.transform_inputs(self.inputs) if self.transform else self.inputs
        covariance = model.covar_module(inputs)
        mean = model.mean_module(inputs).expand(covariance.shape[:-1])
        noisy = model.likelihood(MultivariateNormal(mean, covariance), inputs)
        batch = noisy.batch_shape
        log_prior: Any = mean.new_zeros(batch)
        for _, module, prior, closure, _ in model.named_priors():
            density = prior.log_prob(closure(module))
            log_prior = log_prior + density.reshape(*density.shape[: len(batch)], -1).sum(-1)
        return noisy.mean, noisy.lazy_covariance_matrix.to_dense(), log_prior


def _cholesky(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors, with jitter where they need it, and which of them failed all the same."""
    chol, info = torch.linalg.cholesky_ex(covariance)
    if not info.any():
        return chol, info > 0
    identity = torch.eye(covariance.shape[-1], dtype=chol.dtype, device=chol.device)
    size = covariance.diagonal(dim1=-1, dim2=-2).mean(-1)[..., None, None]
    bad = (info > 0)[..., None, None]
    covariance = torch.where(bad, covariance + _JITTER * size * identity, covariance)
    _, info = torch.linalg.cholesky_ex(covariance.detach())
    failed = info > 0
    # An identity in place of the failed ones keeps the gradients of the others finite.
    safe = torch.where(failed[..., None, None], identity, covariance)
    return torch.linalg.cholesky(safe), failed
