"""Mean and covariance of models with sums of scaled RBF and Matern kernels."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.kernels import AdditiveKernel, Kernel, MaternKernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood, GaussianLikelihood
from torch import Tensor

from gpadjust.gp import InputsKernel, PhysicsColumn, PhysicsScaledKernel, UnknownMeanKernel
from gpadjust.inference.parameters import LogScale, Parameters
from gpadjust.inference.prior_moments import PullBack
from gpadjust.inference.stationary_term import MATERN, StationaryTerm, TermValue

_NOISE = "likelihood.noise_covar.raw_noise"


class StationaryMoments:
    r"""The moments of :math:`K = \sum_t s_t \, G_t k_t(X / \ell_t) G_t + \sigma^2 I`.

    Each term has an outputscale :math:`s`, lengthscales :math:`\ell` and a diagonal :math:`G`: the
    physics for the adjustment :math:`\rho`, or 1. There is no graph of autograd: the derivatives
    are those of :class:`~gpadjust.inference.stationary_term.StationaryTerm`.

    Args:
        model: The model.
        inputs: Its transformed training inputs.
        terms: The terms of its kernel.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        terms: list[StationaryTerm],
    ) -> None:
        log = LogScale(model)
        names = {_NOISE}.union(*(term.names for term in terms))
        self._own = {n: log.current(n) for n, _ in model.named_parameters() if n in names}
        self._terms = terms
        with torch.no_grad():
            self._mean = model.mean_module(inputs).expand(model.train_targets.shape)
            self._weights = [None if t.weight is None else t.weight(inputs) for t in terms]
            self._inputs = inputs - inputs.mean(-2, keepdim=True)
        self._known_noise = None
        if isinstance(model.likelihood, FixedNoiseGaussianLikelihood):
            self._known_noise = model.likelihood.noise

    @classmethod
    def of(
        cls,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        names: list[str],
        left_out: list[str],
    ) -> StationaryMoments | None:
        """The moments of a model, or None if it is of another form.

        Args:
            model: The model.
            inputs: Its transformed training inputs.
            names: The parameters that are learnt.
            left_out: The scales of terms that are left out.
        """
        likelihood = model.likelihood
        known = {_NOISE} if type(likelihood) is GaussianLikelihood else set()
        if not known and type(likelihood) is not FixedNoiseGaussianLikelihood:
            return None
        if getattr(likelihood, "second_noise_covar", None) is not None:
            return None
        every = StationaryTerm(inputs.shape[-1])
        try:
            terms = list(_terms(model.covar_module, "covar_module", every))
        except _AnotherFormError:
            return None
        if not known.union(*(term.names for term in terms)).issuperset(names):
            return None
        return cls(model, inputs, [term for term in terms if term.scale not in left_out])

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n``, noise included."""
        covariance, _ = self._evaluate(parameters, derivatives=False)
        return self._mean, covariance

    def with_pull_back(self, parameters: Parameters) -> tuple[Tensor, Tensor, PullBack]:
        """As calling it, with the function that carries derivatives back to the parameters."""
        covariance, values = self._evaluate(parameters, derivatives=True)
        shapes = {name: value.shape for name, value in parameters.items()}

        def pull_back(by_mean: Tensor, by_covariance: Tensor) -> Parameters:
            found: Parameters = {}
            if _NOISE in parameters:
                trace = by_covariance.diagonal(dim1=-1, dim2=-2).sum(-1, keepdim=True)
                found[_NOISE] = parameters[_NOISE].exp() * trace
            for value in values:
                found |= value.pull_back(by_covariance, shapes)
            return found

        return self._mean, covariance, pull_back

    def _evaluate(
        self, parameters: Parameters, derivatives: bool
    ) -> tuple[Tensor, list[TermValue]]:
        every = {**self._own, **parameters}
        values = [
            TermValue(term, self._inputs[..., : term.num_inputs], weight, every, derivatives)
            for term, weight in zip(self._terms, self._weights, strict=True)
        ]
        noise = every[_NOISE].exp() if self._known_noise is None else self._known_noise
        first, *others = (value.covariance for value in values)
        total = sum(others, first)
        if total.dim() < noise.dim() + 1:  # only the noise is learnt
            total = total.expand(*noise.shape[:-1], *total.shape[-2:])
        total = total if others else total.clone()
        total.diagonal(dim1=-1, dim2=-2).add_(noise)
        return total, values


class _AnotherFormError(Exception):
    pass


def _terms(kernel: Kernel, name: str, outside: StationaryTerm) -> Iterator[StationaryTerm]:
    """Walk down a kernel and yield the terms of the sum that it is."""
    kind, base = type(kernel), f"{name}.base_kernel"
    if kernel.active_dims is not None:
        raise _AnotherFormError
    if kind is AdditiveKernel:
        for i, part in enumerate(kernel.kernels):
            yield from _terms(part, f"{name}.kernels.{i}", outside)
    elif kind is PhysicsScaledKernel and outside.weight is None:
        if not isinstance(kernel.physics, PhysicsColumn):
            raise _AnotherFormError
        yield from _terms(kernel.base_kernel, base, outside.but(weight=kernel.physics))
    elif kind is InputsKernel:
        yield from _terms(kernel.base_kernel, base, outside.but(num_inputs=kernel.num_inputs))
    elif kind is ScaleKernel and outside.scale is None:
        scale = f"{name}.raw_outputscale"
        yield from _terms(kernel.base_kernel, base, outside.but(scale=scale))
    elif kind is UnknownMeanKernel and outside.scale is None:
        yield outside.but(scale=f"{name}.raw_constant")
    elif kind in (RBFKernel, MaternKernel):
        if kernel.ard_num_dims not in (None, outside.num_inputs):
            raise _AnotherFormError
        profile = None if kind is RBFKernel else MATERN[kernel.nu]
        yield outside.but(lengthscale=f"{name}.raw_lengthscale", profile=profile)
    else:
        raise _AnotherFormError
