"""The densities of the priors on a model's hyper-parameters."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.priors import LogNormalPrior, NormalPrior
from torch import Tensor

from gpadjust.inference.log_parameters import LogParameters


class LogPriors:
    """The sum of the log densities of the priors registered on a model, at vectors of it.

    They are densities of the hyper-parameters themselves, as GPyTorch has it, or of the vectors,
    their logarithms: the log determinant between the two is the sum of the latter. Where all of
    them are log-normal (or normal, of a parameter that is not taken as its logarithm) they are
    computed and differentiated by hand.

    Args:
        model: The model.
        parameters: Its learnable parameters.
        of_logs: Whether densities are those of the vectors' elements.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        parameters: LogParameters,
        of_logs: bool = False,
    ) -> None:
        self._model = model
        self._parameters = parameters
        # What the density of the logarithms has in addition, by each of them.
        self._slope = parameters.mask(lambda name: of_logs and parameters.is_log(name))
        self._normal = _normals(model, parameters)

    def __call__(self, vectors: Tensor) -> Tensor:
        """Return the log density at ``vectors`` (``k x B x p``) as ``k x B``."""
        between = (self._slope * vectors).sum(-1)
        if self._normal is not None:
            return self._normal.log_density(vectors) + between
        values = self._parameters.unflatten(vectors)
        densities: list[Tensor] = self._parameters.call_at(values, self._densities)
        batch = (len(vectors), *self._parameters.batch_shape)
        total = vectors.new_zeros(batch)
        for density, own in zip(densities, self._densities(), strict=True):
            # That of a parameter which is not learnt has no dimension of vectors.
            shape = batch if density.dim() > own.dim() else batch[1:]
            shape = shape if density.dim() >= len(shape) else ()
            total = total + density.reshape(*shape, -1).sum(-1)
        return total.reshape(len(vectors), -1) + between

    def with_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log density and its gradient, ``k x B`` and ``k x B x p``."""
        if self._normal is not None:
            return self(vectors), self._normal.gradient(vectors) + self._slope
        leaf = vectors.detach().requires_grad_()
        with torch.enable_grad():
            total = self(leaf)
        if not total.requires_grad:
            return total, torch.zeros_like(vectors)
        return total.detach(), torch.autograd.grad(total, leaf, torch.ones_like(total))[0]

    def _densities(self) -> list[Tensor]:
        """The log density of each prior at the model's parameters."""
        return [
            prior.log_prob(closure(module))
            for _, module, prior, closure, _ in self._model.named_priors()
        ]


class _Normal(NamedTuple):
    """Normal densities of values, or log-normal ones where a value is a logarithm, ``B x p``.

    Attributes:
        location: Means.
        precision: Inverse variances; 0 where there is no prior.
        of_log: 1 for a prior of the value's exponential, 0 otherwise.
    """

    location: Tensor
    precision: Tensor
    of_log: Tensor

    def log_density(self, value: Tensor) -> Tensor:
        """The log density at values ``k x B x p``, ``k x B``."""
        constant = (self.precision / (2 * math.pi)).where(
            self.precision > 0, torch.ones_like(self.precision)
        )
        square = self.precision * (value - self.location).square()
        return (0.5 * (constant.log() - square) - self.of_log * value).sum(-1)

    def gradient(self, value: Tensor) -> Tensor:
        """Its gradient, ``k x B x p``."""
        return self.precision * (self.location - value) - self.of_log


def _normals(model: BatchedMultiOutputGPyTorchModel, parameters: LogParameters) -> _Normal | None:
    """The priors; None if one is of another form, or of a parameter that is not learnt."""
    zero = {name: torch.zeros_like(parameters.value(name)) for name in parameters.names}
    location, precision, logs = zero.copy(), zero.copy(), zero.copy()
    for full_name, module, prior, closure, _ in model.named_priors():
        path, _, leaf = full_name.removesuffix("_prior").rpartition(".")
        name = f"{path}.raw_{leaf}" if f"{path}.raw_{leaf}" in zero else f"{path}.{leaf}"
        of_log = type(prior) is LogNormalPrior
        if name not in zero or type(prior) not in (LogNormalPrior, NormalPrior):
            return None
        value, read = parameters.value(name), closure(module).detach()
        if (
            parameters.is_log(name) != of_log
            or read.shape != value.shape
            or not torch.allclose(read, value.exp() if of_log else value)
            or torch.broadcast_shapes(prior.loc.shape, value.shape) != value.shape
        ):
            return None
        location[name] = prior.loc.expand_as(value)
        precision[name] = prior.scale.square().reciprocal().expand_as(value)
        logs[name] = torch.full_like(value, of_log)
    return _Normal(*(parameters.flatten(each)[0] for each in (location, precision, logs)))
