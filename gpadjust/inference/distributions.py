"""The distribution of the targets at given hyper-parameters, in closed form or by modules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.settings import lazily_evaluate_kernels
from linear_operator import to_dense
from torch import Tensor
from torch.nn import Parameter

from gpadjust.gp import SumOfTerms
from gpadjust.gp.categories import GroupedRBFKernel
from gpadjust.gp.gaussian import LikelihoodValue, scaled
from gpadjust.gp.kernels import Pairs, Profile, Stationary, stationary_parts
from gpadjust.gp.noise import Noise
from gpadjust.inference.vectors import Parameters, Values


class MarginalizedParameters(NamedTuple):
    """Contribution of a physics' unknown parameters to the distribution of the targets.

    Attributes:
        mean: Added to their mean, ``(m) x n``.
        covariance: Added to their covariance, ``(m) x n x n``.
    """

    mean: Tensor
    covariance: Tensor


class Moments(NamedTuple):
    """The distribution of the targets at given hyper-parameters.

    Attributes:
        mean: ``... x n``.
        covariance: With noise, ``... x n x n``; it may be overwritten.
        basis: The bases of unknown constants that are not in these, ``... x n x q``, or None.
        pull_back: Carries derivatives of a likelihood back to the hyper-parameters, if asked for.
    """

    mean: Tensor
    covariance: Tensor
    basis: Tensor | None
    pull_back: Callable[[LikelihoodValue], Values] | None


class _Part(NamedTuple):
    """A term of a sum in closed form; what may be learnt is said by name.

    Attributes:
        x: Its inputs, centerd, ``... x n x d``.
        profile: Its kernel as a function of the distance.
        lengthscale: The name of the lengthscales.
        scale: That of the outputscale, or None for 1.
        weight: Its basis at the current constant, ``... x n``, or None for 1.
        constant: The name of the constant that the basis is affine in, or None.
        slope: The derivative of the basis by it, ``... x n`` or what broadcasts to it.
        groups: The kernel, if it has lengthscales of groups of inputs.
        error: The covariance of an error of the basis, ``... x n x n``, or None.
    """

    x: Tensor
    profile: Profile
    lengthscale: str
    scale: str | None
    weight: Tensor | None
    constant: str | None = None
    slope: Any = None
    groups: GroupedRBFKernel | None = None
    error: Tensor | None = None

    def squares(self, weight: Tensor) -> Tensor:
        """The expected products of the basis ``... x n`` at each two inputs, ``... x n x n``."""
        products = weight.unsqueeze(-1) * weight.unsqueeze(-2)
        return products if self.error is None else products + self.error


@dataclass(eq=False)
class StationaryTerms:
    r"""The targets' distribution with :math:`K = \sum_t s_t B_t k_t(X / \ell_t) B_t + K_0 + S`.

    Each term has a stationary kernel, and a diagonal B for a basis, affine in at most one learnt
    constant; :math:`K_0` is the covariance of random means and of errors of an f_p that is
    emulated, and S that of the noise. There is no
    graph of autograd: :meth:`~gpadjust.gp.kernels.Pairs.pull_back` carries derivatives back.

    Args:
        parts: The terms.
        current: The model's values of what may be learnt, by name.
        mean: The prior mean, ``... x n``.
        constant: :math:`K_0`, ``... x n x n``, or None.
        basis: As in :class:`Moments`.
        noise: The noise variances, ``... x n``; or the name of those that are learnt.
        selection: Which of those each target has, ``... x n x K``; None for the only one.
        added: What is added to the variances, ``... x n``, or None.
    """

    parts: list[_Part]
    current: Values
    mean: Tensor
    constant: Tensor | None
    basis: Tensor | None
    noise: Tensor | str
    selection: Tensor | None
    added: Tensor | None = None

    def __call__(self, values: Values, derivatives: bool = False) -> Moments:
        """Moments at values by name; see :class:`Moments`."""
        every = {**self.current, **values}
        found: list[tuple[Pairs, Tensor | None]] = []
        total: Any = self.constant
        for part in self.parts:
            lengthscale, weight = every[part.lengthscale].exp(), part.weight
            if part.groups is not None:
                lengthscale = part.groups.of_inputs(lengthscale)
            scale = lengthscale.new_ones(()) if part.scale is None else every[part.scale].exp()
            pairs = Stationary(lengthscale, scale, part.profile).pairs(part.x, derivatives)
            covariance = pairs.covariance
            if weight is not None and part.constant is not None:
                weight = weight + part.slope * (every[part.constant] - self.current[part.constant])
            if weight is not None and part.error is not None:
                squares = part.squares(weight)
                covariance = covariance * squares
                if part.constant is None:
                    slope = None if pairs.slope is None else pairs.slope * squares
                    pairs, weight = Pairs(covariance, slope, pairs.z), None
            elif weight is not None and part.constant is not None:
                covariance = (covariance * weight.unsqueeze(-1)).mul_(weight.unsqueeze(-2))
            elif weight is not None:  # a part of the kernel, as it stays
                for factor in (weight.unsqueeze(-1), weight.unsqueeze(-2)):
                    covariance = scaled(covariance, factor)
                    slope = None if pairs.slope is None else scaled(pairs.slope, factor)
                    pairs = Pairs(covariance, slope, pairs.z)
                weight = None
            found.append((pairs, weight))
            total = covariance if total is None else total + covariance
        variances = self.noise
        if isinstance(variances, str):
            variances = every[variances].exp()
            if self.selection is not None:
                variances = (self.selection * variances.unsqueeze(-2)).sum(-1)
            if self.added is not None:
                variances = variances + self.added
        if total.dim() <= variances.dim():  # only the noise is learnt
            total = total.expand(*variances.shape[:-1], *total.shape[-2:]).clone()
        elif total is found[0][0].covariance:
            total = total.clone()
        total.diagonal(dim1=-1, dim2=-2).add_(variances)

        def pull_back(likelihood: LikelihoodValue) -> Values:
            by: Any = likelihood.by_covariance
            result: Values = {}
            if isinstance(self.noise, str) and self.noise in values:
                by_noise = by.diagonal(dim1=-1, dim2=-2).unsqueeze(-1)
                by_noise = by_noise if self.selection is None else by_noise * self.selection
                result[self.noise] = values[self.noise].exp() * by_noise.sum(-2)
            for part, (pairs, weight) in zip(self.parts, found, strict=True):
                by_length, by_scale, by_weight = pairs.pull_back(by, weight)
                if part.error is not None and weight is not None:
                    by_length, by_scale, _ = pairs.pull_back(by * part.squares(weight), None)
                if part.lengthscale in values:
                    shape = values[part.lengthscale].shape
                    if part.groups is not None:
                        by_length = part.groups.of_groups(by_length)
                    elif shape[-1] == 1:
                        by_length = by_length.sum(-1, keepdim=True)
                    result[part.lengthscale] = by_length.reshape(shape)
                if part.scale in values:
                    result[part.scale] = by_scale.reshape(values[part.scale].shape)
                if part.constant in values:
                    by_constant = (by_weight * part.slope).sum(-1)
                    result[part.constant] = by_constant.reshape(values[part.constant].shape)
            return result

        given = pull_back if derivatives else None
        return Moments(self.mean, total, self.basis, given)


@torch.no_grad()
def stationary_terms(
    model: BatchedMultiOutputGPyTorchModel,
    parameters: Parameters,
    inputs: Tensor,
    known_noise: Tensor | None,
    random_means: bool,
    kept: Any = slice(None),
) -> StationaryTerms | None:
    """The distribution of a model in closed form, or None if it has another form.

    The arguments are those of :class:`ByModules`.
    """
    if not isinstance(model.covar_module, SumOfTerms):
        return None
    current: Values = {}

    def enter(raw: Parameter) -> str:
        row = parameters.table[id(raw)]
        current[row.name] = row.value()
        return row.name

    likelihood, kernel, parts = Noise(model.likelihood), model.covar_module, []
    centerd = inputs - inputs.mean(-2, keepdim=True)
    errors: dict[str, Tensor] = {
        term.scaled_by: term.covariance(inputs) for term in kernel.terms if term.scaled_by
    }
    for term in (term for term in kernel.terms if not term.scaled_by):
        form = None if term.kernel is None else stationary_parts(term.kernel, term.num_inputs)
        if form is not None:
            base, outer, profile = form
            x, constant = centerd[..., : term.num_inputs], getattr(term.basis, "learnt", None)
            scale = None if outer is None else enter(outer.raw_outputscale)
            part = _Part(x, profile, enter(base.raw_lengthscale), scale, term.weights(inputs))
            if isinstance(base, GroupedRBFKernel):
                part = part._replace(groups=base)
            part = part._replace(error=errors.get(term.name))
            if constant is not None:
                part = part._replace(constant=enter(constant), slope=term.basis.slope(inputs))
            parts.append(part)
        elif term.kernel is not None:
            return None
    noise: Any = known_noise
    if noise is None and likelihood.learnt is not None:
        noise = enter(likelihood.learnt)
    if noise is None or not parts or not current.keys() >= {*parameters.names}:
        return None
    basis, mean = kernel.basis_of_means(inputs), model.mean_module(inputs)
    for row in (row for row in parameters.rows if row.kind == "constant"):
        # All but its basis stays, or the closed form would have to follow.
        before = row.value().clone()
        row.raw.add_(1.0)
        there = model.mean_module(inputs)
        row.raw.copy_(before)
        if basis is not None or not torch.allclose(there, mean, rtol=1e-9, atol=1e-12):
            return None
    of_means: Tensor | None = None
    if basis is not None and random_means:
        variances = [term.mean_variance for term in kernel.terms if term.learns_mean]
        root = basis * torch.stack(variances, dim=-1).sqrt()
        of_means, basis = root @ root.mT, None
    for term in (term for term in kernel.terms if term.name in errors):
        square = term.mean.square() + (term.mean_variance if random_means else 0.0)
        of_error = errors[term.name] * square.unsqueeze(-1)
        of_means = of_error if of_means is None else of_means + of_error
    shares = (None, None) if known_noise is not None else likelihood.shares(inputs, kept)
    return StationaryTerms(parts, current, mean, of_means, basis, noise, *shares)


@dataclass(eq=False)
class ByModules:
    """The distribution by the model's own modules, differentiated by autograd: of any model.

    Autograd does not see the factorisation: it starts from the derivatives by mean and covariance,
    which are known in closed form.

    Args:
        model: The model, in train mode.
        parameters: Its learnable parameters.
        inputs: Its training inputs, or some rows of them; transformed, unless parameters of the
            input transform are among those that are learnt.
        known_noise: The noise variances of these inputs, if they are known.
        random_means: Whether the prior variances of unknown constants are in the covariance.
        kept: Which rows of the training data these are.
    """

    model: BatchedMultiOutputGPyTorchModel
    parameters: Parameters
    inputs: Tensor
    known_noise: Tensor | None
    random_means: bool
    kept: Any = field(default_factory=lambda: slice(None))

    def __call__(self, values: Values, derivatives: bool = False) -> Moments:
        """Moments at values by name; see :class:`Moments`."""
        if derivatives:
            values = {name: value.detach().requires_grad_() for name, value in values.items()}
        with torch.set_grad_enabled(derivatives), lazily_evaluate_kernels(False):
            mean, covariance, basis = self.parameters.call_at(values, self._moments)

        def pull_back(found: LikelihoodValue) -> Values:
            by: list[Any] = [(covariance, found.by_covariance), (mean, found.by_mean)]
            if found.by_mean is not None and found.coefficients is not None:
                # The estimates minimise, so that no derivative goes through them.
                by.append((basis, found.by_mean.unsqueeze(-1) * found.coefficients.unsqueeze(-2)))
            by = [(m, each) for m, each in by if each is not None and m.requires_grad]
            moments, each = zip(*by, strict=True)
            slopes = torch.autograd.grad(moments, list(values.values()), each, allow_unused=True)
            return {
                name: torch.zeros_like(value) if slope is None else slope
                for (name, value), slope in zip(values.items(), slopes, strict=True)
            }

        if not derivatives:
            return Moments(mean, covariance, basis, None)
        fixed = None if basis is None else basis.detach()
        covariances = covariance.detach().clone()
        return Moments(mean.detach(), covariances, fixed, pull_back)

    def _moments(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """Mean, covariance and basis at the model's parameters."""
        model, inputs, noise = self.model, self.inputs, self.known_noise
        if self.parameters.learns_inputs:
            inputs = model.transform_inputs(inputs)
        kernel, basis = model.covar_module, None
        if self.random_means or not isinstance(kernel, SumOfTerms):
            covariance = to_dense(kernel(inputs))
        else:
            covariance = kernel.covariance(inputs, known_means=True)
            basis = kernel.basis_of_means(inputs)
        if noise is None:
            likelihood = Noise(model.likelihood)
            noise = likelihood.of_rows(likelihood.at(inputs), self.kept)
        noise = noise.expand(torch.broadcast_shapes(noise.shape, covariance.shape[:-1]))
        mean = model.mean_module(inputs).expand(noise.shape)
        return mean, covariance + torch.diag_embed(noise), basis
