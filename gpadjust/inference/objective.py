"""The negative log marginal likelihood of many hyper-parameter vectors at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.likelihoods import GaussianLikelihood
from torch import Tensor

from gpadjust.gp import AppendedPhysics, SumOfTerms, Term
from gpadjust.gp.gaussian import LikelihoodValue, known_noise, negative_log_likelihood
from gpadjust.gp.stationary import StationarySum, StationaryTerm, stationary_form
from gpadjust.inference.linearisation import Shared
from gpadjust.inference.log_parameters import LogParameters
from gpadjust.inference.log_priors import LogPriors
from gpadjust.inference.target_distribution import ModuleDistribution, constant_means
from gpadjust.models.hyperparameters import kernels_of
from gpadjust.physics import PhysicsError

_NOISE = "likelihood.noise_covar.raw_noise"
_LEAST = 3  # observations, for a constant to be vague
_FEW_INPUTS = 3  # up to which a linear trend is, too
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
        vague_trend: Let all sizes of a constant and a linear trend in the observations cost the
            same, as far as there are enough of them: a factor of the prior, such that the size of
            a trend says nothing of how smooth a function is. A model is else the less likely, the
            larger the functions that its prior allows beside the one that is seen, which speaks
            against all that are nearly polynomial.
        shared: What unknown parameters of the physics add to mean and covariance; they are then
            integrated out.

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
        vague_trend: bool = False,
        shared: Shared | None = None,
    ) -> None:
        model.train()
        self.model = model
        self._kind = {"marginal": marginal, "of_logs": of_logs, "vague_trend": vague_trend}
        self.parameters = LogParameters(model)
        kept = slice(None) if rows is None else rows
        self._all_shared, self._shared = shared, None if shared is None else shared.of_rows(kept)
        raw, noise = model.train_inputs[0], known_noise(model.likelihood)
        self.targets = model.train_targets[..., kept]
        if self._shared is not None:
            self.targets = self.targets - self._shared.mean
        noise = None if noise is None else noise[..., kept]
        with torch.no_grad():
            inputs = model.transform_inputs(raw)[..., kept, :]
            basis = None if marginal else _basis_of_means(model, inputs)
        self._learns_constants = basis is not None
        self._trend = _trend(raw[..., kept, :], self.targets) if vague_trend else None
        self._inputs, self._basis, targets = inputs, basis, None
        if self.parameters.learns_inputs:
            self._inputs = raw[..., kept, :]
        learns_basis = any(".basis." in name for name in self.parameters.names)
        if basis is not None and (self.parameters.learns_inputs or learns_basis):
            # The basis changes with what is learnt: the distribution has it in its mean.
            self._basis, targets = None, self.targets
        closed = self.parameters.is_batched and not autograd
        self._distribution = (
            self._closed_form(inputs, noise, marginal) if closed else None
        ) or ModuleDistribution(model, self._inputs, self.parameters, noise, marginal, targets)
        self._log_priors: LogPriors | None = None
        if of_logs or next(iter(model.named_priors()), None) is not None:
            self._log_priors = LogPriors(model, self.parameters, of_logs)
        # Targets that are met exactly would have no variance at all: their rounding errors have.
        square = self.targets.square().nanmean(-1)
        square = square.where(square > 0, torch.ones_like(square))
        self._rounding = torch.finfo(square.dtype).eps ** 2 * square
        self.concentrated = not marginal and self._is_homogeneous()

    def of_rows(self, rows: Tensor) -> Objective:
        """The same objective of some of the observations, numbers of rows."""
        return Objective(self.model, rows=rows, shared=self._all_shared, **self._kind)

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
        return self._in_chunks(lambda part: self._evaluate(part, derivatives=False), vectors)[0]

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective and its gradient, ``k x B`` and ``k x B x p``.

        The gradient is zero where the objective is infinite.
        """
        return self._in_chunks(lambda part: self._evaluate(part, derivatives=True), vectors)

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
            found, _ = self._likelihood(part, self._least_scale(part), derivatives=False)
            return found.value.reshape(len(part), -1), found.scale.reshape(len(part), -1)

        values, scale = self._in_chunks(likelihood, vectors)
        usable = scale.isfinite() & (scale > 0)
        shift = scale.where(usable, torch.ones_like(scale)).log().unsqueeze(-1)
        moved = self.parameters.clipped(vectors + self.parameters.variances * shift)
        return moved, values if self.concentrated else self(moved)

    def _in_chunks(
        self, function: Callable[[Tensor], tuple[Tensor, Tensor]], vectors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Evaluate a function of vectors in parts that fit in memory.

        Where problems share parameters, as the physics learns, it is one vector after the other.
        """
        size = self.parameters.num_problems * self.num_points**2
        at_once = max(1, _AT_ONCE // size) if self.parameters.is_batched else 1
        first, second = zip(*(function(part) for part in vectors.split(at_once)), strict=True)
        return torch.cat(first), torch.cat(second)

    @torch.no_grad()
    def _evaluate(self, vectors: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
        """The objective and its gradient (zero if not asked for)."""
        least = self._least_scale(vectors) if self.concentrated else None
        try:
            found, gradient = self._likelihood(vectors, least, derivatives)
        except PhysicsError:
            # Parameters that the physics cannot run with are a bad vector, not the end of a fit.
            return vectors.new_full(vectors.shape[:-1], math.inf), torch.zeros_like(vectors)
        # Outputs that share parameters are independent given these.
        value = found.value.reshape(*vectors.shape[:-1], -1).sum(-1)
        if found.by_least_scale is not None:
            # The least scale is that of the least noise, in inverse proportion to the noise.
            by_least = found.by_least_scale.reshape(*value.shape, 1)
            gradient = gradient - self.parameters.noise * by_least
        if self._log_priors is not None and derivatives:
            log_prior, by_prior = self._log_priors.with_gradient(vectors)
            value, gradient = value - log_prior, gradient - by_prior
        elif self._log_priors is not None:
            value = value - self._log_priors(vectors)
        # NaN and minus infinity are what only failures give.
        value = value.nan_to_num(math.inf, math.inf, math.inf)
        good = (value.isfinite() & gradient.isfinite().all(-1)).unsqueeze(-1)
        return value, torch.where(good, gradient, torch.zeros_like(gradient))

    def _likelihood(
        self, vectors: Tensor, least: Tensor | None, derivatives: bool
    ) -> tuple[LikelihoodValue, Tensor]:
        """The likelihood, and its gradient at a fixed scale (zero if not asked for)."""
        values = self.parameters.unflatten(vectors)
        if not self.parameters.is_batched:
            values = {name: value[0] for name, value in values.items()}
        if derivatives:
            mean, covariance, pull_back = self._distribution.with_pull_back(values)
        else:
            mean, covariance = self._distribution(values)
        if self._shared is not None:
            covariance = covariance + self._shared.covariance
        residual = (self.targets - mean).expand(covariance.shape[:-1])
        found = negative_log_likelihood(
            residual, covariance, self._basis, least, derivatives, self._trend
        )
        if found.by_mean is None or found.by_covariance is None:
            return found, torch.zeros_like(vectors)
        return found, self.parameters.flatten(pull_back(found.by_mean, found.by_covariance))

    def _least_scale(self, vectors: Tensor) -> Tensor:
        """The factor of all variances that brings the noise to its bound, ``k x batch_shape``."""
        least = ((self.parameters.lower - vectors).exp() * self.parameters.noise).sum(-1)
        least = least.maximum(self._rounding.reshape(-1))
        return least.reshape(len(vectors), *self.parameters.batch_shape)

    def _assign_constants(self, vector: Tensor) -> None:
        values = self.parameters.unflatten(vector.unsqueeze(0))
        _, covariance = self._distribution({name: value[0] for name, value in values.items()})
        if self._shared is not None:
            covariance = covariance + self._shared.covariance
        inputs, basis = self._inputs, self._basis
        if self.parameters.learns_inputs:
            inputs = self.model.transform_inputs(inputs)
        if basis is None:
            basis = self.model.covar_module.basis_of_means(inputs)
        residual = self.targets - self.model.mean_module(inputs)
        shift, vague = constant_means(residual, covariance, basis)
        for i, term in enumerate(_terms_of_means(self.model)):
            term.mean.add_(shift[..., i : i + 1])
            term.mean_variance.copy_(vague[..., i : i + 1])

    @torch.no_grad()
    def _closed_form(
        self, inputs: Tensor, noise: Tensor | None, marginal: bool
    ) -> StationarySum | None:
        """The distribution without autograd, or None if the model has another form."""
        model = self.model
        if noise is None and type(model.likelihood) is not GaussianLikelihood:
            return None
        learns_means = _basis_of_means(model, inputs) is not None
        terms, names = [], set() if noise is not None else {_NOISE}
        learnt: set[str] = set()  # centres
        origin = inputs.mean(-2, keepdim=True)
        for path, kernel, num_inputs, basis in kernels_of(model):
            d = inputs.shape[-1] if num_inputs is None else num_inputs
            form = stationary_form(kernel, d)
            if form is None:
                return None
            lengthscale = f"{path}.{form.lengthscale}"
            scale = None if form.outputscale is None else f"{path}.{form.outputscale}"
            weight = None if basis is None else basis(inputs)
            x, center, spread = (inputs - origin)[..., :d], None, None
            names |= {lengthscale} if scale is None else {lengthscale, scale}
            if isinstance(basis, AppendedPhysics) and basis.has_free_center:
                center = f"{path.removesuffix('.kernel')}.basis.center"
                spread = basis.spread / basis.scale
                weight = basis(inputs) + spread * basis.center
                learnt.add(center)
            terms.append(
                StationaryTerm(x, weight, lengthscale, scale, form.profile, center, spread)
            )
        if not terms or not (names | learnt).issuperset(self.parameters.names):
            return None
        if learnt and learns_means:
            return None  # their bases move with the centres
        mean = model.mean_module(inputs).expand(self.targets.shape)
        bases = _basis_of_means(model, inputs) if marginal else None
        constant: Tensor | None = None
        if bases is not None:
            variances = torch.stack([t.mean_variance for t in _terms_of_means(model)], dim=-1)
            root = bases * variances.sqrt()
            constant = root @ root.mT
        values = {}
        for name in names:
            path, _, leaf = name.rpartition(".")
            value: Tensor = getattr(model.get_submodule(path), leaf.removeprefix("raw_"))
            values[name] = value.log()
        for name in learnt:
            values[name] = model.get_parameter(name)
        return StationarySum(terms, mean, constant, _NOISE if noise is None else noise, values)

    @torch.no_grad()
    def _is_homogeneous(self) -> bool:
        """Whether a factor of all variances is one of the covariance, and no prior minds."""
        parameters = self.parameters
        one_noise = bool((parameters.noise.sum(-1) == 1).all())
        if not parameters.is_batched or self._log_priors is not None or not one_noise:
            return False
        if self._shared is not None:
            return False
        vector = parameters.current()
        mean, covariance = self._distribution(parameters.unflatten(vector))
        doubled = parameters.unflatten(vector + parameters.variances * math.log(2))
        mean2, covariance2 = self._distribution(doubled)
        off = (covariance2 - 2 * covariance).abs().amax((-1, -2))
        close = (off <= 1e-9 * covariance.abs().amax((-1, -2))).all()
        return bool(close) and torch.allclose(mean2, mean, rtol=1e-9, atol=1e-12)


def _trend(inputs: Tensor, targets: Tensor) -> Tensor | None:
    """A constant and, of few inputs, a linear trend, orthogonal: ``... x n x q``, or None."""
    observed = (~targets.isnan()).unsqueeze(-1)
    n, d = int(observed.sum(-2).min()), inputs.shape[-1]
    if n < _LEAST:
        return None
    one = observed.to(inputs)
    if d > _FEW_INPUTS or n < 2 * (d + 1):
        return one
    count = one.sum(-2, keepdim=True)
    away = (inputs - (inputs * one).sum(-2, keepdim=True) / count) * one
    spread = (away.square().sum(-2, keepdim=True) / count).sqrt()
    rounding = 8 * n * torch.finfo(inputs.dtype).eps * inputs.abs().amax(-2, keepdim=True)
    away = torch.where(spread > rounding, away / spread, torch.zeros_like(away))
    slopes, sizes, _ = torch.linalg.svd(away, full_matrices=False)
    # Inputs that do not vary, or only together, have no slopes of their own.
    rank = int((sizes > 1e-6 * math.sqrt(n)).sum(-1).amin())
    return torch.cat([one, slopes[..., :rank] * math.sqrt(n)], dim=-1)


def _basis_of_means(model: BatchedMultiOutputGPyTorchModel, inputs: Tensor) -> Tensor | None:
    """The bases of unknown constant means, ``... x n x q``; None for models of other libraries."""
    kernel = model.covar_module
    return kernel.basis_of_means(inputs) if isinstance(kernel, SumOfTerms) else None


def _terms_of_means(model: BatchedMultiOutputGPyTorchModel) -> list[Term]:
    return [term for term in model.covar_module.terms if term.learns_mean]
