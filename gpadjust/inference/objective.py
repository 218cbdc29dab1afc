"""The negative log marginal likelihood of many hyper-parameter vectors at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.likelihoods import GaussianLikelihood
from torch import Tensor

from gpadjust.gp import SumOfTerms
from gpadjust.gp.gaussian import (
    LikelihoodValue,
    cholesky,
    known_noise,
    least_squares,
    negative_log_likelihood,
    nugget,
)
from gpadjust.gp.stationary import StationarySum, StationaryTerm, stationary_form
from gpadjust.inference.log_parameters import LogParameters, Parameters
from gpadjust.inference.log_priors import LogPriors
from gpadjust.inference.target_distribution import ModuleDistribution, TargetDistribution
from gpadjust.models.hyperparameters import kernels_of
from gpadjust.physics import PhysicsError

_NOISE = "likelihood.noise_covar.raw_noise"
_VAGUE = 1e4  # the prior variance of an unknown constant mean, in squared standard errors
_AT_ONCE = 2**20  # numbers in the covariances of a batch; larger ones make memory the bottleneck


class Objective:
    r"""Negative log marginal likelihood, less the log priors, of a model's hyper-parameters.

    .. math:: \tfrac12 (y - m)^T K^{-1} (y - m) + \tfrac12 \log|K| + \tfrac n2 \log 2\pi

    It is evaluated at ``k`` vectors of all ``B`` problems in one batch
    (:class:`~gpadjust.inference.log_parameters.LogParameters`); where outputs share parameters,
    one vector after the other.

    Where all variances are learnt without priors, their overall scale is *concentrated* out: it is
    at its optimum, in closed form, as far as the noise keeps to its least value. Unknown constant
    means are at their generalised least squares estimate.

    Args:
        model: The model; it is put in train mode.
        marginal: Take the model as it is, at its own scale and with unknown constant means
            integrated over their priors.
        of_logs: Take priors as densities of the logarithms of lengthscales and variances, instead
            of densities of these: what is to be sampled.
        autograd: Differentiate the kernel by autograd even where there is a closed form.
        rows: The observations that count, numbers of rows. Default: all.

    Attributes:
        parameters: The vectors and their bounds.
        concentrated: Whether the overall scale is concentrated out.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        marginal: bool = False,
        of_logs: bool = False,
        autograd: bool = False,
        rows: Tensor | None = None,
    ) -> None:
        model.train()
        self.model = model
        self.parameters = LogParameters(model)
        learns_inputs = any(name.startswith("input_transform.") for name in self.parameters.names)
        raw, noise = model.train_inputs[0], known_noise(model.likelihood)
        with torch.no_grad():
            inputs = model.transform_inputs(raw)
        self.targets = model.train_targets
        if rows is not None:
            raw, inputs, self.targets = (
                raw[..., rows, :],
                inputs[..., rows, :],
                self.targets[..., rows],
            )
            noise = None if noise is None else noise[..., rows]
        with torch.no_grad():
            basis = None if marginal else _basis_of_means(model, inputs)
        self._learns_constants = basis is not None
        # That of a physics which learns changes: the distribution has it in its mean.
        self._basis = None if learns_inputs else basis
        self._inputs = raw if learns_inputs else inputs
        closed: TargetDistribution | None = None
        if self.parameters.is_batched and not autograd:
            closed = _closed_form(model, inputs, self.parameters, noise, marginal)
        targets = self.targets if learns_inputs and self._learns_constants else None
        self._distribution = closed or ModuleDistribution(
            model, self._inputs, self.parameters, noise, marginal, targets
        )
        self._log_priors: LogPriors | None = None
        if of_logs or next(iter(model.named_priors()), None) is not None:
            self._log_priors = LogPriors(model, self.parameters, of_logs)
        # Targets that are met exactly would have no variance at all: their rounding errors have.
        square = self.targets.square().nanmean(-1)
        square = square.where(square > 0, torch.ones_like(square))
        self._rounding = torch.finfo(square.dtype).eps ** 2 * square
        self.concentrated = not marginal and self._is_homogeneous()

    @property
    def num_points(self) -> int:
        """Number ``n`` of observations of each problem."""
        return self.targets.shape[-1]

    def assign(self, vector: Tensor) -> None:
        """Give the model a vector, ``B x p``, at its best scale, and its constant means."""
        if self.concentrated:
            vector = self.at_best_scale(vector.unsqueeze(0))[0][0]
        self.parameters.assign(vector)
        if self._learns_constants:
            with torch.no_grad():
                self._assign_constants(vector)

    def __call__(self, vectors: Tensor) -> Tensor:
        """Return the objective at ``vectors`` (``k x B x p``) as ``k x B``.

        It is infinite where the covariance has no Cholesky factor.
        """
        return self._in_chunks(lambda part: (self._evaluate(part, derivatives=False)[0],), vectors)[
            0
        ]

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective and its gradient, ``k x B`` and ``k x B x p``.

        The gradient is zero where the objective is infinite.
        """
        value, gradient = self._in_chunks(
            lambda part: self._evaluate(part, derivatives=True), vectors.detach()
        )
        return value, gradient

    @torch.no_grad()
    def at_best_scale(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        r"""Multiply all variances by the factor that maximises the likelihood.

        With :math:`c K` in place of :math:`K` it is :math:`(y - m)^T K^{-1} (y - m) / n`, or what
        brings the noise to its bound.

        Args:
            vectors: ``k x B x p``.

        Returns:
            The vectors, moved into the bounds, and the objective there, ``k x B``.
        """
        if not self.parameters.is_batched:
            return vectors, self(vectors)

        def likelihood(part: Tensor) -> tuple[Tensor, Tensor]:
            mean, covariance = self._distribution(self.parameters.unflatten(part))
            residual = self._residual(mean, covariance)
            found = negative_log_likelihood(
                residual, covariance, self._basis, self._least_scale(part)
            )
            shape = (len(part), self.parameters.num_problems)
            return found.value.reshape(shape), found.scale.reshape(shape)

        values, scale = self._in_chunks(likelihood, vectors)
        usable = scale.isfinite() & (scale > 0)
        shift = scale.where(usable, torch.ones_like(scale)).log().unsqueeze(-1)
        moved = self.parameters.clipped(vectors + self.parameters.variances * shift)
        return moved, values if self.concentrated else self(moved)

    def _in_chunks(
        self, function: Callable[[Tensor], tuple[Tensor, ...]], vectors: Tensor
    ) -> tuple[Tensor, ...]:
        """Evaluate a function of vectors in parts that fit in memory."""
        at_once = max(1, _AT_ONCE // (self.parameters.num_problems * self.num_points**2))
        parts = [function(part) for part in vectors.split(at_once)]
        return tuple(torch.cat(part) for part in zip(*parts, strict=True))

    def _evaluate(self, vectors: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
        if self.parameters.is_batched:
            value, gradient = self._apart(vectors, derivatives)
        else:
            pairs = [self._together(each, derivatives) for each in vectors]
            value = torch.stack([pair[0] for pair in pairs])
            gradient = torch.stack([pair[1] for pair in pairs])
        if self._log_priors is not None:
            if derivatives:
                log_prior, by_prior = self._log_priors.with_gradient(vectors)
                gradient = gradient - by_prior
            else:
                with torch.no_grad():
                    log_prior = self._log_priors(vectors)
            value = value - log_prior
        # NaN and minus infinity are what only failures give.
        value = value.nan_to_num(math.inf, math.inf, math.inf)
        good = (value.isfinite() & gradient.isfinite().all(-1)).unsqueeze(-1)
        return value, torch.where(good, gradient, torch.zeros_like(gradient))

    @torch.no_grad()
    def _apart(self, vectors: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
        """The likelihood of problems of their own, and its gradient (zero if not asked for)."""
        values = self.parameters.unflatten(vectors)
        least = self._least_scale(vectors) if self.concentrated else None
        if not derivatives:
            mean, covariance = self._distribution(values)
            likelihood = self._likelihood(mean, covariance, least)
            return likelihood.value.reshape(len(vectors), -1), torch.zeros_like(vectors)
        mean, covariance, pull_back = self._distribution.with_pull_back(values)
        likelihood = self._likelihood(mean, covariance, least, derivatives=True)
        found = pull_back(*likelihood.gradient())
        gradient = self.parameters.flatten(found)
        value = likelihood.value.reshape(len(vectors), -1)
        if likelihood.by_least_scale is not None:
            # The least scale is that of the least noise, in inverse proportion to the noise.
            by_least = likelihood.by_least_scale.reshape(value.shape)
            gradient = gradient - self.parameters.noise * by_least.unsqueeze(-1)
        return value, gradient

    def _together(self, vector: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
        """Negative log likelihood and its gradient of one vector, ``1`` and ``1 x p``.

        Its outputs are independent given the parameters that they share.
        """
        values = {n: v[0] for n, v in self.parameters.unflatten(vector.unsqueeze(0)).items()}
        gradient = torch.zeros_like(vector)
        try:
            if not derivatives:
                with torch.no_grad():
                    likelihood = self._likelihood(*self._distribution(values), None)
                return likelihood.value.sum().reshape(1), gradient
            mean, covariance, pull_back = self._distribution.with_pull_back(values)
        except PhysicsError:
            # Parameters that the physics cannot run with are a bad vector, not the end of a fit.
            return vector.new_full((1,), math.inf), gradient
        likelihood = self._likelihood(mean, covariance, None, derivatives=True)
        found = pull_back(*likelihood.gradient())
        gradient = self.parameters.flatten({name: v.unsqueeze(0) for name, v in found.items()})[0]
        return likelihood.value.sum().reshape(1), gradient

    def _likelihood(
        self, mean: Tensor, covariance: Tensor, least: Tensor | None, derivatives: bool = False
    ) -> LikelihoodValue:
        residual = self._residual(mean, covariance)
        return negative_log_likelihood(residual, covariance, self._basis, least, derivatives)

    def _residual(self, mean: Tensor, covariance: Tensor) -> Tensor:
        return (self.targets - mean).expand(covariance.shape[:-1])

    def _least_scale(self, vectors: Tensor) -> Tensor:
        """The factor of all variances that brings the noise to its bound, ``k x batch_shape``."""
        least = ((self.parameters.lower - vectors).exp() * self.parameters.noise).sum(-1)
        least = least.maximum(self._rounding.reshape(-1))
        return least.reshape(len(vectors), *self.parameters.batch_shape)

    def _assign_constants(self, vector: Tensor) -> None:
        values: Parameters = self.parameters.unflatten(vector.unsqueeze(0))
        _, covariance = self._distribution({name: value[0] for name, value in values.items()})
        inputs, basis = self._inputs, self._basis
        if basis is None:
            inputs = self.model.transform_inputs(inputs)
            basis = _basis_of_means(self.model, inputs)
        residual = self.targets - self.model.mean_module(inputs)
        observed = ~residual.isnan()
        chol, _ = cholesky(covariance, None if observed.all() else observed)
        basis = basis * observed.unsqueeze(-1)
        basis = basis.expand(*chol.shape[:-1], -1)
        shift, variance = least_squares(chol, residual.nan_to_num(nan=0.0), basis)
        vague = _VAGUE * variance.diagonal(dim1=-1, dim2=-2)
        # A wider prior would drown the smallest pivot in rounding errors.
        pivot = chol.diagonal(dim1=-1, dim2=-2).amin(-1, keepdim=True).square()
        size = basis.square().amax(-2).clamp_min(torch.finfo(chol.dtype).tiny)
        vague = vague.minimum(pivot / (nugget(chol.shape[-1]) * size))
        learnt = [term for term in self.model.covar_module.terms if term.learns_mean]
        for i, term in enumerate(learnt):
            term.mean += shift[..., i : i + 1]
            term.mean_variance.copy_(vague[..., i : i + 1])

    def _is_homogeneous(self) -> bool:
        """Whether a factor of all variances is one of the covariance, and no prior minds."""
        parameters = self.parameters
        one_noise = bool((parameters.noise.sum(-1) <= 1).all())
        if not parameters.is_batched or self._log_priors is not None or not one_noise:
            return False
        vector = parameters.current()
        with torch.no_grad():
            mean, covariance = self._distribution(parameters.unflatten(vector))
            doubled = vector + parameters.variances * math.log(2)
            mean2, covariance2 = self._distribution(parameters.unflatten(doubled))
            off = (covariance2 - 2 * covariance).abs().amax((-1, -2))
        return bool((off <= 1e-9 * covariance.abs().amax((-1, -2))).all()) and bool(
            (mean2 == mean).all()
        )


def _basis_of_means(model: BatchedMultiOutputGPyTorchModel, inputs: Tensor) -> Tensor | None:
    """The bases of unknown constant means, ``... x n x q``; None for models of other libraries."""
    kernel = model.covar_module
    return kernel.basis_of_means(inputs) if isinstance(kernel, SumOfTerms) else None


def _closed_form(
    model: BatchedMultiOutputGPyTorchModel,
    inputs: Tensor,
    parameters: LogParameters,
    noise: Tensor | None,
    marginal: bool,
) -> StationarySum | None:
    """The distribution of the targets without autograd, or None if the model has another form.

    Args:
        model: The model.
        inputs: Its transformed training inputs, or some rows of them.
        parameters: Its learnable parameters.
        noise: The noise variances of these inputs, if they are known.
        marginal: Whether the prior variances of unknown constants count.
    """
    if noise is None and type(model.likelihood) is not GaussianLikelihood:
        return None
    terms, names = [], set() if noise is not None else {_NOISE}
    origin = inputs.mean(-2, keepdim=True)
    with torch.no_grad():
        for path, kernel, num_inputs, basis in kernels_of(model):
            d = inputs.shape[-1] if num_inputs is None else num_inputs
            form = stationary_form(kernel, d)
            if form is None:
                return None
            lengthscale = f"{path}.{form.lengthscale}"
            scale = None if form.outputscale is None else f"{path}.{form.outputscale}"
            weight = None if basis is None else basis(inputs)
            x = (inputs - origin)[..., :d]
            terms.append(StationaryTerm(x, weight, lengthscale, scale, form.profile))
            names |= {name for name in (lengthscale, scale) if name is not None}
        if not terms or not names.issuperset(parameters.names):
            return None
        constant = _constant_covariance(model, inputs) if marginal else None
        shape = (*model.train_targets.shape[:-1], inputs.shape[-2])
        mean = model.mean_module(inputs).expand(shape)
        values = {}
        for name in names:
            path, _, leaf = name.rpartition(".")
            value: Tensor = getattr(model.get_submodule(path), leaf.removeprefix("raw_"))
            values[name] = value.log()
    return StationarySum(terms, mean, constant, _NOISE if noise is None else noise, values)


def _constant_covariance(model: BatchedMultiOutputGPyTorchModel, inputs: Tensor) -> Tensor | None:
    """What unknown constants add to the covariance, ``... x n x n``, or None."""
    basis = _basis_of_means(model, inputs)
    if basis is None:
        return None
    learnt = [term for term in model.covar_module.terms if term.learns_mean]
    scaled = basis * torch.stack([term.mean_variance.sqrt() for term in learnt], dim=-1)
    return scaled @ scaled.mT
