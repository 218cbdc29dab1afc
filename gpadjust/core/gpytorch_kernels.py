"""Kernels of GPyTorch in a model of this library."""

from __future__ import annotations

import math
from copy import deepcopy
from functools import partial
from itertools import product
from typing import Any

import torch
from gpytorch.kernels import Kernel as AnyGPyTorchKernel
from torch import Tensor
from torch.func import functional_call

from gpadjust.core.kernels import DELTA, LENGTH_FACTOR, Kernel
from gpadjust.core.unknowns import LogNormal, Row, Values


class OfGPyTorch(Kernel):
    """A GPyTorch kernel without batch shape, with its constraints and priors.

    A parameter without a prior is known to a factor (or, if it may be negative, with a standard
    deviation of 1) around its value in the kernel, in units of the targets; an ``outputscale``
    without one has the prior of the term.
    """

    def __init__(self, kernel: AnyGPyTorchKernel, outputscale: LogNormal = DELTA) -> None:
        if not isinstance(kernel, AnyGPyTorchKernel):
            raise TypeError(
                "Expected a kernel of gpadjust.core or GPyTorch, such as Stationary(MATERN52) or "
                f"ScaleKernel(MaternKernel()); found {kernel!r}."
            )
        if kernel.batch_shape:
            raise ValueError(f"Expected a kernel without batch shape; found {kernel.batch_shape}.")
        self.outputscale = outputscale
        self.kernel = deepcopy(kernel).double()
        self.kernel.requires_grad_(False).eval()
        self._as_batch: bool | None = None

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return a row for each parameter that is learnt."""
        priors = {}
        for _, module, prior, closure, _ in self.kernel.named_priors():
            for name, parameter in self.kernel.named_parameters():
                with torch.enable_grad():  # a prior is of the parameter that its value depends on
                    parameter.requires_grad_(True)
                    if closure(module).requires_grad:
                        priors[name] = prior
                    parameter.requires_grad_(False)
        rows = []
        for name, raw, constraint in self.kernel.named_parameters_and_constraints():
            value, factor, is_positive = raw, math.e, False
            if constraint is not None:
                value = constraint.transform(raw)
                is_positive = bool((constraint.lower_bound >= 0).all())
            if is_positive:
                factor = LENGTH_FACTOR
            prior, density = priors.get(name), None
            if prior is not None:
                density = partial(_log_density, prior, raw.shape)
            elif name.endswith("raw_outputscale"):
                value = torch.full_like(value, self.outputscale.median)
                factor = self.outputscale.factor
            if is_positive:
                value = value.clamp_min(1e-12).log()
            location = value.reshape(-1).expand(num_outputs, -1)
            rows.append(Row(name, location, math.log(factor), is_positive, log_density=density))
        return rows

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the kernel's covariances, a batch at once where the kernel can."""
        lead = next((value.shape[:-1] for value in own.values()), torch.Size([1, 1]))
        if self._as_batch is None:
            self._as_batch = self._is_the_same_as_a_batch(own, x, lead)
        evaluate = self._of_batch if self._as_batch else self._one_by_one
        if other is None:
            other = x
        return evaluate(own, x, other, lead)

    def _dense(self, kernel: AnyGPyTorchKernel, values: Values, x: Tensor, other: Tensor) -> Tensor:
        """Return covariances of a kernel at values of its parameters."""
        raw = {}
        for name, old, constraint in self.kernel.named_parameters_and_constraints():
            value = values[name].reshape((*values[name].shape[:-1], *old.shape))
            if constraint is not None:
                low, high = constraint.lower_bound.to(value), constraint.upper_bound.to(value)
                value = value.maximum(low + 1e-12 * low.abs().nan_to_num(posinf=0.0))
                value = value.minimum(high - 1e-12 * high.abs().nan_to_num(posinf=0.0))
                value = constraint.inverse_transform(value)
            raw[f"kernel.{name}"] = value
        return functional_call(_Dense(kernel), raw, (x, other))

    def _of_batch(self, own: Values, x: Tensor, other: Tensor, lead: torch.Size) -> Tensor:
        kernel = deepcopy(self.kernel)
        for module in kernel.modules():
            if isinstance(module, AnyGPyTorchKernel):
                module.batch_shape = lead
        shape = torch.broadcast_shapes(lead, x.shape[:-2], other.shape[:-2])
        x, other = (v.expand(*shape, *v.shape[-2:]) for v in (x, other))
        return self._dense(kernel, own, x, other)

    def _one_by_one(self, own: Values, x: Tensor, other: Tensor, lead: torch.Size) -> Tensor:
        x, other = (v.expand(*v.shape[:-4], *lead, *v.shape[-2:]) for v in (x, other))
        parts = []
        for i, j in product(*map(range, lead)):
            one = {name: value[i, j] for name, value in own.items()}
            kernel = deepcopy(self.kernel)  # some cache what they have computed
            parts.append(self._dense(kernel, one, x[..., i, j, :, :], other[..., i, j, :, :]))
        return torch.stack(parts, -3).unflatten(-3, lead)

    def _is_the_same_as_a_batch(self, own: Values, x: Tensor, lead: torch.Size) -> bool:
        """Return whether evaluating a batch gives what each of its elements gives."""
        few = {name: value.detach()[:2].repeat(2, 1, 1)[:2] for name, value in own.items()}
        size = torch.Size([2, lead[1]])
        x = x.detach().reshape(-1, *x.shape[-2:])[0, :5].reshape(1, 1, -1, x.shape[-1])
        expected = self._one_by_one(few, x, x, size)
        try:
            batch = self._of_batch(few, x, x, size)
        except Exception:
            return False
        return batch.shape == expected.shape and torch.allclose(batch, expected, rtol=1e-9)

    def __repr__(self) -> str:
        return repr(self.kernel).replace("\n", " ")


class _Dense(torch.nn.Module):
    """A kernel whose matrix is computed at the call, with the parameters of the call."""

    def __init__(self, kernel: AnyGPyTorchKernel) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, x: Tensor, other: Tensor) -> Tensor:
        return self.kernel(x, other).to_dense()


def _log_density(prior: Any, shape: torch.Size, theta: Tensor) -> Tensor:
    """Return the log density of numbers ``... x k`` by a prior of GPyTorch."""
    value = theta.reshape(*theta.shape[:-1], *shape)
    is_possible = prior.support.check(value)
    log_prob = prior.log_prob(value.where(is_possible, torch.as_tensor(prior.mean).to(value)))
    log_prob = log_prob.masked_fill(~is_possible, -math.inf)
    return log_prob.reshape(*theta.shape[:-1], -1).sum(-1)
