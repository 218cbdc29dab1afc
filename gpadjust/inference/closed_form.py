"""The distribution of the targets of sums of scaled RBF and Matern kernels, without autograd."""

from __future__ import annotations

from typing import NamedTuple

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.likelihoods import GaussianLikelihood
from torch import Tensor

from gpadjust.gp import SumOfTerms
from gpadjust.gp.stationary_kernel import Profile, StationaryRows, exponents, stationary_form
from gpadjust.inference.log_parameters import LogParameters, Parameters
from gpadjust.inference.target_distribution import PullBack
from gpadjust.models.hyperparameters import kernels_of

_NOISE = "likelihood.noise_covar.raw_noise"


class ClosedForm:
    r"""The distribution with :math:`K = \sum_t s_t \, B_t k_t(X / \ell_t) B_t + K_0 + \sigma^2 I`.

    Each term has an outputscale :math:`s`, lengthscales :math:`\ell` and a diagonal B, its basis;
    :math:`K_0` is what unknown constants add. With D the derivative of a function by the covariance
    K, its derivative by :math:`\log s` is :math:`\sum_{ij} (D \circ K_t)_{ij}`, and that by
    :math:`\log \ell_k` is :math:`\sum_{ij} M_{ij} (z_{ik} - z_{jk})^2
    = 2 \sum_i z_{ik}^2 (M 1)_i - 2 z_k^T M z_k` with :math:`z = x / \ell` and
    :math:`M = D \circ S`, where S is -2 times the derivative of :math:`K_t` by :math:`r^2`: one
    matrix product for all inputs. For the RBF kernel, :math:`S = K_t`.

    Args:
        model: The model.
        inputs: Its transformed training inputs, or some rows of them.
        terms: The terms.
        known_noise: The noise variances of these inputs, if they are known.
        marginal: Whether the prior variances of unknown constants count.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        terms: list[ClosedTerm],
        known_noise: Tensor | None,
        marginal: bool,
    ) -> None:
        self._terms = terms
        self._known_noise = known_noise
        # Those that are not learnt stay as they are.
        self._own = {
            name: _log_value(model, name)
            for name, _ in model.named_parameters()
            if name == _NOISE or any(name in (t.lengthscale, t.scale) for t in terms)
        }
        with torch.no_grad():
            shape = (*model.train_targets.shape[:-1], inputs.shape[-2])
            self._mean = model.mean_module(inputs).expand(shape)
            self._fixed = None
            if marginal and isinstance(model.covar_module, SumOfTerms):
                self._fixed = _constants(model.covar_module, inputs)

    @classmethod
    def of(
        cls,
        model: BatchedMultiOutputGPyTorchModel,
        inputs: Tensor,
        parameters: LogParameters,
        known_noise: Tensor | None,
        marginal: bool,
    ) -> ClosedForm | None:
        """The closed form of a model, or None if it has none."""
        names: set[str] = set()
        if known_noise is None:
            if type(model.likelihood) is not GaussianLikelihood:
                return None
            names.add(_NOISE)
        terms = []
        origin = inputs.mean(-2, keepdim=True)
        for path, kernel, num_inputs, basis in kernels_of(model):
            d = inputs.shape[-1] if num_inputs is None else num_inputs
            form = stationary_form(kernel, d)
            if form is None:
                return None
            scale = None if form.outputscale is None else f"{path}.{form.outputscale}"
            with torch.no_grad():
                weight = None if basis is None else basis(inputs)
            x = (inputs - origin)[..., :d]
            terms.append(ClosedTerm(x, weight, f"{path}.{form.lengthscale}", scale, form.profile))
            names |= {f"{path}.{form.lengthscale}"} | ({scale} if scale else set())
        if not terms or not names.issuperset(parameters.names):
            return None
        return cls(model, inputs, terms, known_noise, marginal)

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
        values = [TermValue(term, every, derivatives) for term in self._terms]
        noise = every[_NOISE].exp() if self._known_noise is None else self._known_noise
        first, *others = (value.covariance for value in values)
        total = sum(others, first)
        if self._fixed is not None:
            total = total + self._fixed
        elif not others:
            total = total.clone()
        if total.dim() < noise.dim() + 1:  # only the noise is learnt
            total = total.expand(*noise.shape[:-1], *total.shape[-2:]).clone()
        total.diagonal(dim1=-1, dim2=-2).add_(noise)
        return total, values


class ClosedTerm(NamedTuple):
    """One term :math:`s \\, B k(X / \\ell) B`.

    Attributes:
        x: Its inputs, ``... x n x d``, centred.
        weight: The diagonal of B, ``... x n``, or None for 1.
        lengthscale: Name of the lengthscales.
        scale: Name of the outputscale s, or None for 1.
        profile: The kernel as a function of -r^2 / 2, or None for the RBF kernel.
    """

    x: Tensor
    weight: Tensor | None
    lengthscale: str
    scale: str | None
    profile: Profile | None


class TermValue:
    """A term at given parameters.

    Args:
        term: The term.
        parameters: The (logarithmic) parameters; those of the term are all there.
        derivatives: Whether :meth:`pull_back` will be called.

    Attributes:
        covariance: ``... x n x n``.
    """

    def __init__(self, term: ClosedTerm, parameters: Parameters, derivatives: bool) -> None:
        self._term = term
        self._slope: Tensor | None = None
        rows = StationaryRows.of(term.x, parameters[term.lengthscale].exp())
        log_scale = None
        if term.scale is not None:
            log_scale = parameters[term.scale][..., None, None]
        if term.profile is None:
            self.covariance = exponents(rows, rows, log_scale).exp_()
        else:
            exponent = exponents(rows, rows)
            exponent.diagonal(dim1=-1, dim2=-2).zero_()
            self.covariance, self._slope = term.profile(exponent.clamp_max_(0), derivatives)
            if log_scale is not None:
                self._multiply(log_scale.exp())
        self._z = rows.z
        if term.weight is not None:
            self._multiply(term.weight.unsqueeze(-1))
            self._multiply(term.weight.unsqueeze(-2))

    def pull_back(self, by_covariance: Tensor, shapes: dict[str, torch.Size]) -> Parameters:
        """Turn a derivative by the covariance into those by the parameters.

        Args:
            by_covariance: ``... x n x n``, symmetric.
            shapes: The shapes of the parameters that are asked for.
        """
        term, found = self._term, {}
        total: Tensor | None = None
        if term.lengthscale in shapes:
            slope = by_covariance * (self.covariance if self._slope is None else self._slope)
            # The slope is symmetric, and the product faster this way round.
            z = self._z.expand(*slope.shape[:-1], -1)
            with_one = torch.cat([z, torch.ones_like(z[..., :1])], dim=-1)
            products = (with_one.mT @ slope).mT
            products, row_sums = products[..., :-1], products[..., -1:]
            by_each = 2 * (z * (z * row_sums - products)).sum(-2)
            shape = shapes[term.lengthscale]
            by_each = by_each if shape[-1] > 1 else by_each.sum(-1, keepdim=True)
            found[term.lengthscale] = by_each.reshape(shape)
            total = row_sums.sum((-1, -2)) if self._slope is None else None
        if term.scale is not None and term.scale in shapes:
            if total is None:
                total = (by_covariance * self.covariance).sum((-1, -2))
            found[term.scale] = total.reshape(shapes[term.scale])
        return found

    def _multiply(self, factor: Tensor) -> None:
        """Multiply the covariance, in place where its shape allows."""
        shape = torch.broadcast_shapes(self.covariance.shape, factor.shape)
        in_place = shape == self.covariance.shape
        self.covariance = self.covariance.mul_(factor) if in_place else self.covariance * factor
        if self._slope is not None:
            self._slope = self._slope.mul_(factor) if in_place else self._slope * factor


def _constants(kernel: SumOfTerms, inputs: Tensor) -> Tensor | None:
    """What unknown constants add to the covariance, ``... x n x n``, or None."""
    total = None
    for term in kernel.terms:
        if term.learns_mean:
            b = torch.ones_like(inputs[..., 0]) if term.basis is None else term.basis(inputs)
            part = term.mean_variance.unsqueeze(-1) * b.unsqueeze(-1) * b.unsqueeze(-2)
            total = part if total is None else total + part
    return total


def _log_value(model: BatchedMultiOutputGPyTorchModel, name: str) -> Tensor:
    """The logarithm of a positive parameter."""
    path, _, leaf = name.rpartition(".")
    value: Tensor = getattr(model.get_submodule(path), leaf.removeprefix("raw_"))
    return value.detach().log()
