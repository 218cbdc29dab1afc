"""Sums of scaled RBF and Matern kernels in closed form: what most models are, made fast."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from torch import Tensor

from gpadjust.gp.gaussian import scaled

Parameters = dict[str, Tensor]
# Maps -r^2 / 2 to the kernel, and (if asked for) to -2 dk / d(r^2).
Profile = Callable[[Tensor, bool], tuple[Tensor, Tensor | None]]
# Inputs in lengthscales, ... x n x d, and half their squared norms, ... x n x 1.
Rows = tuple[Tensor, Tensor]


class StationaryForm(NamedTuple):
    r"""A kernel :math:`s \, k(|x - x'| / \ell)`, by the names of its parameters.

    Attributes:
        lengthscale: Name of the raw lengthscales within the kernel.
        outputscale: Name of the raw outputscale s, or None for 1.
        profile: The kernel as a function of -r^2 / 2, or None for the RBF kernel, its exponential.
    """

    lengthscale: str
    outputscale: str | None
    profile: Profile | None


def stationary_form(kernel: Any, num_inputs: int) -> StationaryForm | None:
    """Recognise a kernel of that form, with or without ``ScaleKernel``; None for any other."""
    outputscale, path = None, ""
    if type(kernel) is ScaleKernel and kernel.active_dims is None:
        outputscale, path, kernel = "raw_outputscale", "base_kernel.", kernel.base_kernel
    if type(kernel) not in (RBFKernel, MaternKernel) or kernel.active_dims is not None:
        return None
    if kernel.ard_num_dims not in (None, num_inputs):
        return None
    profile = None if type(kernel) is RBFKernel else _MATERN[kernel.nu]
    return StationaryForm(f"{path}raw_lengthscale", outputscale, profile)


def rows_of(x: Tensor, lengthscale: Tensor) -> Rows:
    """Make inputs ``... x n x d`` ready for :func:`exponents`, lengthscales ``... x 1 x d``."""
    z = x / lengthscale
    return z, z.square().sum(-1, keepdim=True) / 2


def exponents(left: Rows, right: Rows, shift: Tensor | None = None) -> Tensor:
    """Return -r^2 / 2 of all pairs (plus a shift, ``... x 1 x 1``), ``... x n x n'``.

    It is one matrix product of the inputs with two columns more.
    """
    (z, half), (other, other_half) = left, right
    first = -half if shift is None else shift - half
    z = z.expand(*first.shape[:-1], z.shape[-1])
    columns = torch.cat([other, -other_half, torch.ones_like(other_half)], -1)
    return torch.cat([z, torch.ones_like(first), first], -1) @ columns.mT


class StationaryTerm(NamedTuple):
    r"""A term :math:`s \, B k(X / \ell) B` of a covariance.

    Attributes:
        x: Its inputs, ``... x n x d``, centred.
        weight: The diagonal of B, ``... x n``, or None for 1.
        lengthscale: Name of the lengthscales.
        scale: Name of the outputscale s, or None for 1.
        profile: As in :class:`StationaryForm`.
        center: Name of a parameter that is taken from the weight, times ``spread``; or None.
        spread: ``... x 1``, if there is such a parameter.
    """

    x: Tensor
    weight: Tensor | None
    lengthscale: str
    scale: str | None
    profile: Profile | None
    center: str | None = None
    spread: Tensor | None = None


class TermValue(NamedTuple):
    """A term at given parameters.

    Attributes:
        covariance: ``... x n x n``.
        slope: -2 times its derivative by r^2, if that is not the covariance itself, or None.
        z: The inputs in lengthscales, ``... x n x d``.
        by_center: A, where its derivative by the centre is :math:`A + A^T`, ``... x n x n``; None
            if there is no centre to learn.
    """

    covariance: Tensor
    slope: Tensor | None
    z: Tensor
    by_center: Tensor | None = None


@dataclass(eq=False)
class StationarySum:
    r"""The targets' distribution with :math:`K = \sum_t s_t \, B_t k_t(X / \ell_t) B_t + K_0 + S`.

    Each term has an outputscale :math:`s`, lengthscales :math:`\ell` and a diagonal B, its basis;
    :math:`K_0` is a constant, and S the noise. With D the derivative of a function by the
    covariance K, its derivative by :math:`\log s` is :math:`\sum_{ij} (D \circ K_t)_{ij}`, and that
    by :math:`\log \ell_k` is :math:`\sum_{ij} M_{ij} (z_{ik} - z_{jk})^2
    = 2 \sum_i z_{ik}^2 (M 1)_i - 2 z_k^T M z_k` with :math:`z = x / \ell` and
    :math:`M = D \circ S_t`, where :math:`S_t` is -2 times the derivative of :math:`K_t` by
    :math:`r^2`: one matrix product for all inputs. For the RBF kernel, :math:`S_t = K_t`. There is
    no graph of autograd.

    Args:
        terms: The terms.
        mean: The prior mean, ``... x n``.
        constant: :math:`K_0`, ``... x n x n``, or None.
        noise: The noise variances, ``... x n``; or the name of the one that is learnt.
        values: Those parameters that may not be learnt, by their names; logarithms but for centres.
    """

    terms: Sequence[StationaryTerm]
    mean: Tensor
    constant: Tensor | None
    noise: Tensor | str
    values: Parameters

    def __call__(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Return mean ``... x n`` and covariance ``... x n x n`` at (logarithmic) parameters."""
        return self.mean, self._evaluate(parameters, derivatives=False)[0]

    def with_pull_back(
        self, parameters: Parameters
    ) -> tuple[Tensor, Tensor, Callable[[Tensor, Tensor], Parameters]]:
        """As calling it, with the function that carries derivatives back to the parameters."""
        covariance, values = self._evaluate(parameters, derivatives=True)

        def pull_back(by_mean: Tensor, by_covariance: Tensor) -> Parameters:
            found: Parameters = {}
            if isinstance(self.noise, str) and self.noise in parameters:
                trace = by_covariance.diagonal(dim1=-1, dim2=-2).sum(-1, keepdim=True)
                found[self.noise] = parameters[self.noise].exp() * trace
            for term, value in zip(self.terms, values, strict=True):
                found |= self._pull_back(term, value, by_covariance, parameters)
            return found

        return self.mean, covariance, pull_back

    def _evaluate(
        self, parameters: Parameters, derivatives: bool
    ) -> tuple[Tensor, list[TermValue]]:
        every = {**self.values, **parameters}
        values = [self._value(term, every, derivatives) for term in self.terms]
        noise = every[self.noise].exp() if isinstance(self.noise, str) else self.noise
        first, *others = (value.covariance for value in values)
        total = sum(others, first)
        if self.constant is not None:
            total = total + self.constant
        elif not others:
            total = total.clone()
        if total.dim() < noise.dim() + 1:  # only the noise is learnt
            total = total.expand(*noise.shape[:-1], *total.shape[-2:]).clone()
        total.diagonal(dim1=-1, dim2=-2).add_(noise)
        return total, values

    @staticmethod
    def _value(term: StationaryTerm, parameters: Parameters, derivatives: bool) -> TermValue:
        rows = rows_of(term.x, parameters[term.lengthscale].exp())
        shift = None if term.scale is None else parameters[term.scale][..., None, None]
        if term.profile is None:
            covariance, slope = exponents(rows, rows, shift).exp_(), None
        else:
            exponent = exponents(rows, rows)
            exponent.diagonal(dim1=-1, dim2=-2).zero_()
            covariance, slope = term.profile(exponent.clamp_max_(0), derivatives)
        factors = [] if shift is None or term.profile is None else [shift.exp()]
        weight, by_center = term.weight, None
        if weight is not None and term.center is not None and term.spread is not None:
            weight = weight - term.spread * parameters[term.center]
        if weight is not None:
            factors += [weight.unsqueeze(-1), weight.unsqueeze(-2)]
        for factor in factors:
            if factor is factors[-1] and term.spread is not None and derivatives:
                by_center = -term.spread.unsqueeze(-1) * covariance
            covariance = scaled(covariance, factor)
            slope = None if slope is None else scaled(slope, factor)
        return TermValue(covariance, slope, rows[0], by_center)

    @staticmethod
    def _pull_back(
        term: StationaryTerm, value: TermValue, by_covariance: Tensor, parameters: Parameters
    ) -> Parameters:
        """Turn a derivative by the covariance into those by the parameters of a term."""
        found: Parameters = {}
        total: Tensor | None = None
        if term.lengthscale in parameters:
            slope = by_covariance * (value.covariance if value.slope is None else value.slope)
            # The slope is symmetric, and the product faster this way round.
            z = value.z.expand(*slope.shape[:-1], -1)
            products = (torch.cat([z, torch.ones_like(z[..., :1])], dim=-1).mT @ slope).mT
            products, row_sums = products[..., :-1], products[..., -1:]
            by_each = 2 * (z * (z * row_sums - products)).sum(-2)
            shape = parameters[term.lengthscale].shape
            by_each = by_each if shape[-1] > 1 else by_each.sum(-1, keepdim=True)
            found[term.lengthscale] = by_each.reshape(shape)
            total = row_sums.sum((-1, -2)) if value.slope is None else None
        if term.scale is not None and term.scale in parameters:
            if total is None:
                total = (by_covariance * value.covariance).sum((-1, -2))
            found[term.scale] = total.reshape(parameters[term.scale].shape)
        if term.center in parameters and value.by_center is not None:
            total = 2 * (by_covariance * value.by_center).sum((-1, -2))
            found[term.center] = total.reshape(parameters[term.center].shape)
        return found


def _matern12(exponent: Tensor, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """The Matern kernel of smoothness 1/2, exp(-r)."""
    r = exponent.mul_(-2).sqrt_()
    k = (-r).exp()
    # The slope's 1 / r is multiplied by differences that vanish where r does: 0 will do there.
    return k, (k / r).masked_fill_(r == 0, 0.0) if derivatives else None


def _matern32(exponent: Tensor, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """The Matern kernel of smoothness 3/2, (1 + t) exp(-t) with t = sqrt(3) r."""
    t = exponent.mul_(-6).sqrt_()
    decay = (-t).exp()
    return (1 + t) * decay, 3 * decay if derivatives else None


def _matern52(exponent: Tensor, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """The Matern kernel of smoothness 5/2, (1 + t + t^2 / 3) exp(-t) with t = sqrt(5) r."""
    t = exponent.mul_(-10).sqrt_()
    decay = (-t).exp()
    slope = (5 / 3) * (1 + t) * decay if derivatives else None
    return (1 + t + t.square() / 3) * decay, slope


_MATERN: dict[float, Profile] = {0.5: _matern12, 1.5: _matern32, 2.5: _matern52}
