"""The negative log marginal likelihood of many hyper-parameter settings at once."""

from __future__ import annotations

import math

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from torch import Size, Tensor

from gpadjust.gp import DataInterval
from gpadjust.inference.gaussian_likelihood import (
    Likelihood,
    least_squares,
    negative_log_likelihood,
    safe_cholesky,
)
from gpadjust.inference.log_priors import LogPriors
from gpadjust.inference.parameters import LogScale, Parameters
from gpadjust.inference.prior_moments import ModuleMoments, Moments
from gpadjust.inference.stationary_moments import StationaryMoments
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.parameter_scales import kind
from gpadjust.physics import PhysicsError

_VAGUE = 1e4  # the prior variance of an unknown constant mean, in squared standard errors
_AT_ONCE = 2**20  # numbers in the covariances of a batch; larger ones make memory the bottleneck


class Objective:
    r"""Negative log marginal likelihood, less the log priors, of settings of a model.

    .. math:: \tfrac12 (y - m)^T K^{-1} (y - m) + \tfrac12 \log|K| + \tfrac n2 \log 2\pi

    A model's outputs (and batches) have their own hyper-parameters each, and are ``B`` problems
    apart; the model is evaluated at ``k`` settings of all of them in one batch. Where parameters
    are shared, by several outputs or with the input transform (a physics that learns), the outputs
    make up one problem, ``B = 1``, and the settings are evaluated one after the other.

    Where all variances are learnt without priors, their overall scale is *concentrated* out: it is
    at its optimum, in closed form, and the objective does not depend on that of a setting. Unknown
    constant means are at their generalised least squares estimate.

    Attributes:
        names: The names of the model's learnable parameters.
        scale: What the settings are in: logarithms of lengthscales and variances.
        num_problems: Number ``B`` of problems.
        num_parameters: Number ``p`` of parameters of each.
        batch_shape: The shape whose elements are the problems.
        variances: 1 for a free variance, 0 for another parameter, ``B x p``.
        concentrated: Whether the overall scale is concentrated out.

    Args:
        model: The model; it is put in train mode.
        marginal: Take the model as it is, at its own scale and with unknown constant means
            integrated over their priors.
        of_settings: Take priors as densities of the settings, that is of the logarithms of
            lengthscales and variances, instead of densities of these: what is to be sampled.
        autograd: Differentiate the kernel by autograd even where there is a closed form.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        marginal: bool = False,
        of_settings: bool = False,
        autograd: bool = False,
    ) -> None:
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
        self.scale = LogScale(model)
        self.shapes = [p.shape[len(self.batch_shape) :] for p in parameters.values()]
        self.num_parameters = sum(shape.numel() for shape in self.shapes)
        inputs = model.train_inputs[0]
        with torch.no_grad():
            transformed = model.transform_inputs(inputs)
        means = model.constant_means if isinstance(model, MultiOutputGP) and not marginal else {}
        self._basis = (
            torch.stack([read(transformed) for read in means.values()], dim=-1) if means else None
        )
        if means:
            # Those that the residuals are computed with.
            self._constants = model.constant_mean_values.detach().clone()
        by_hand = None
        if self.is_batched and not autograd:
            by_hand = StationaryMoments.of(model, transformed, self.names, [*means])
        inputs = inputs if learns_inputs else transformed
        self._moments: Moments = by_hand or ModuleMoments(model, inputs, [*means], learns_inputs)
        self._log_priors = LogPriors(
            model, self.names, self.batch_shape, self.unflatten, self.flatten, of_settings
        )
        self.variances = self.flatten(
            {
                name: torch.full_like(p, float(self._is_free_variance(name))).unsqueeze(0)
                for name, p in parameters.items()
            }
        )[0]
        # Targets that are met exactly would have no variance at all: their rounding errors have.
        square = model.train_targets.square().mean(-1)
        self._rounding = torch.finfo(square.dtype).eps ** 2 * square.where(
            square > 0, torch.ones_like(square)
        )
        self.concentrated = False
        self.concentrated = not marginal and self._is_homogeneous()

    def flatten(self, values: Parameters) -> Tensor:
        """Pack one tensor per parameter name, ``k x`` its shape, into ``k x B x p``."""
        parts = [
            values[name].detach().reshape(-1, self.num_problems, shape.numel())
            for name, shape in zip(self.names, self.shapes, strict=True)
        ]
        return torch.cat(parts, dim=-1)

    def unflatten(self, settings: Tensor) -> Parameters:
        """The reverse of :meth:`flatten`."""
        sizes = [shape.numel() for shape in self.shapes]
        parts = settings.split(sizes, dim=-1)
        return {
            name: part.reshape(-1, *self.batch_shape, *shape)
            for name, part, shape in zip(self.names, parts, self.shapes, strict=True)
        }

    def current(self) -> Tensor:
        """The model's own setting, ``1 x B x p``."""
        return self.flatten({name: self.scale.current(name).unsqueeze(0) for name in self.names})

    def assign(self, setting: Tensor) -> None:
        """Give the model a setting, ``B x p``, at its best scale, and its constant means."""
        if self.concentrated:
            shift = self.best_scale(setting.unsqueeze(0))[0].log()
            setting = setting + self.variances * shift.unsqueeze(-1)
        parameters = self._single(self.unflatten(setting.unsqueeze(0)))
        self.scale.assign(parameters)
        if self._basis is not None:
            with torch.no_grad():
                mean, covariance = self._moments(parameters)
                chol, _ = safe_cholesky(covariance)
                basis = self._basis.expand(*covariance.shape[:-1], -1)
                shift, variance = least_squares(chol, self.model.train_targets - mean, basis)
                vague = _VAGUE * variance.diagonal(dim1=-1, dim2=-2)
                # A wider prior would drown the smallest pivot in rounding errors.
                pivot = chol.diagonal(dim1=-1, dim2=-2).amin(-1, keepdim=True).square()
                rounding = 10 * chol.shape[-1] ** 2 * torch.finfo(chol.dtype).eps
                size = basis.square().amax(-2).clamp_min(torch.finfo(chol.dtype).tiny)
                vague = vague.minimum(pivot / (rounding * size))
                self.model.set_constant_means(self._constants + shift, vague)

    @torch.no_grad()
    def __call__(self, settings: Tensor) -> Tensor:
        """Return the objective at ``settings`` (``k x B x p``) as ``k x B``.

        It is infinite where the covariance has no Cholesky factor.
        """
        if not self.is_batched:
            value = torch.stack([self._together(each)[0] for each in settings])
            return _finite(value - self._log_priors(settings) if self._log_priors.any else value)
        likelihood = self._likelihood(*self._moments(self.unflatten(settings)))
        value = likelihood.value.reshape(-1, self.num_problems)
        return _finite(value - self._log_priors(settings) if self._log_priors.any else value)

    def value_and_gradient(self, settings: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective and its gradient, ``k x B`` and ``k x B x p``.

        The gradient is zero where the objective is infinite.
        """
        settings = settings.detach()
        n = self.model.train_targets.shape[-1]
        at_once = max(1, _AT_ONCE // (self.num_problems * n**2))
        if len(settings) > at_once:
            parts = [self.value_and_gradient(part) for part in settings.split(at_once)]
            values, gradients = zip(*parts, strict=True)
            return torch.cat(values), torch.cat(gradients)
        if self.is_batched:
            with torch.no_grad():
                mean, covariance, pull_back = self._moments.with_pull_back(self.unflatten(settings))
                likelihood = self._likelihood(mean, covariance, derivatives=True)
                gradient = self.flatten(pull_back(*likelihood.gradient))
            value = likelihood.value.reshape(-1, self.num_problems)
        else:
            pairs = [self._together(each, derivatives=True) for each in settings]
            value = torch.stack([pair[0] for pair in pairs])
            gradient = torch.stack([pair[1] for pair in pairs])
        if self._log_priors.any:
            log_prior, by_prior = self._log_priors.with_gradient(settings)
            value, gradient = value - log_prior, gradient - by_prior
        value = _finite(value)
        good = (value.isfinite() & gradient.isfinite().all(-1)).unsqueeze(-1)
        return value, torch.where(good, gradient, torch.zeros_like(gradient))

    @torch.no_grad()
    def best_scale(self, settings: Tensor) -> Tensor:
        r"""The factor of all variances that maximises the likelihood, ``k x B``.

        With :math:`c K` in place of :math:`K` it is :math:`(y - m)^T K^{-1} (y - m) / n`.
        """
        if not self.is_batched:
            return torch.ones_like(settings[..., 0])
        likelihood = self._likelihood(*self._moments(self.unflatten(settings)))
        return likelihood.scale.reshape(-1, self.num_problems)

    def _likelihood(
        self, mean: Tensor, covariance: Tensor, derivatives: bool = False
    ) -> Likelihood:
        residual = (self.model.train_targets - mean).expand(covariance.shape[:-1])
        return negative_log_likelihood(
            residual, covariance, self._basis, self.concentrated, derivatives, self._rounding
        )

    def _together(self, setting: Tensor, derivatives: bool = False) -> tuple[Tensor, Tensor]:
        """Negative log likelihood and its gradient (if asked for) of one setting, ``1``, ``1 x p``.

        Its outputs are independent given the parameters that they share.
        """
        parameters = self._single(self.unflatten(setting.unsqueeze(0)))
        gradient = torch.zeros_like(setting)
        try:
            if not derivatives:
                value = self._likelihood(*self._moments(parameters)).value
                return value.sum().reshape(1), gradient
            mean, covariance, pull_back = self._moments.with_pull_back(parameters)
        except PhysicsError:
            # Parameters that the physics cannot run with are a bad setting, not the end of a fit.
            return setting.new_full((1,), math.inf), gradient
        likelihood = self._likelihood(mean, covariance, derivatives=True)
        found = pull_back(*likelihood.gradient)
        gradient = self.flatten({name: v.unsqueeze(0) for name, v in found.items()})[0]
        return likelihood.value.sum().reshape(1), gradient

    def _single(self, parameters: Parameters) -> Parameters:
        return {name: value[0] for name, value in parameters.items()}

    def is_free(self, name: str) -> bool:
        """Whether nothing but the data bounds a lengthscale or variance."""
        if not self.scale.covers(name):
            return False
        constraint = self.scale.constraint(name)
        unbounded = bool((constraint.lower_bound <= 0).all()) and bool(
            constraint.upper_bound.isinf().all()
        )
        return unbounded or isinstance(constraint, DataInterval)

    @property
    def has_one_noise(self) -> bool:
        """Whether a problem has one noise at most, not one for each level as AR1 has."""
        noises = [
            shape.numel()
            for name, shape in zip(self.names, self.shapes, strict=True)
            if kind(name) == "noise"
        ]
        return sum(noises) <= 1

    def _is_free_variance(self, name: str) -> bool:
        return kind(name) in ("outputscale", "noise") and self.is_free(name)

    def _is_homogeneous(self) -> bool:
        """Whether a factor of all variances is one of the covariance, and no prior minds."""
        if not self.is_batched or self._log_priors.any or not self.has_one_noise:
            return False
        setting = self.current()
        with torch.no_grad():
            mean, covariance = self._moments(self.unflatten(setting))
            doubled = setting + self.variances * math.log(2)
            mean2, covariance2 = self._moments(self.unflatten(doubled))
            off = (covariance2 - 2 * covariance).abs().amax((-1, -2))
        return bool((off <= 1e-9 * covariance.abs().amax((-1, -2))).all()) and bool(
            (mean2 == mean).all()
        )


def _finite(value: Tensor) -> Tensor:
    """Infinity in place of NaN and minus infinity, which only failures give."""
    return value.nan_to_num(math.inf, math.inf, math.inf)
