"""One scaled RBF or Matern kernel, with its derivatives by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gpadjust.gp import PhysicsColumn
from gpadjust.inference.parameters import Parameters

# Maps -r^2 / 2 to the kernel, and (if asked for) to -2 dk / d(r^2).
Profile = Callable[[Tensor, bool], tuple[Tensor, Tensor | None]]


@dataclass(frozen=True)
class StationaryTerm:
    r"""A term :math:`s \, G k(X / \ell) G` of a covariance.

    With D the derivative of a function by the term's covariance :math:`K`, its derivative by
    :math:`\log s` is :math:`\sum_{ij} (D \circ K)_{ij}`, and by :math:`\log \ell_k` it is
    :math:`\sum_{ij} M_{ij} (z_{ik} - z_{jk})^2 = 2 \sum_i z_{ik}^2 (M 1)_i - 2 z_k^T M z_k` with
    :math:`z = x / \ell` and :math:`M = D \circ S`, where S is -2 times the derivative of K by
    :math:`r^2`: one matrix product for all inputs. For the RBF kernel, S = K.

    Attributes:
        num_inputs: Number ``d`` of leading input columns that the kernel sees.
        weight: Reads the diagonal of G, or None for 1.
        scale: Name of the outputscale s, or None for 1.
        lengthscale: Name of the lengthscales, or None for a constant kernel.
        profile: The kernel as a function of -r^2 / 2, or None for the RBF kernel.
    """

    num_inputs: int
    weight: PhysicsColumn | None = None
    scale: str | None = None
    lengthscale: str | None = None
    profile: Profile | None = None

    def but(self, **changes: Any) -> StationaryTerm:
        """The term with some attributes changed."""
        return replace(self, **changes)

    @property
    def names(self) -> set[str]:
        """The names of its parameters."""
        return {name for name in (self.scale, self.lengthscale) if name is not None}


class TermValue:
    """A term at given inputs and parameters.

    Args:
        term: The term.
        x: Its inputs, ``... x n x d``, centred.
        weight: The diagonal of G, ``... x n``, or None.
        parameters: The (logarithmic) parameters; those of the term are all there.
        derivatives: Whether :meth:`pull_back` will be called.

    Attributes:
        covariance: ``... x n x n``.
    """

    def __init__(
        self,
        term: StationaryTerm,
        x: Tensor,
        weight: Tensor | None,
        parameters: Parameters,
        derivatives: bool,
    ) -> None:
        self._term = term
        self._slope: Tensor | None = None
        log_scale = x.new_zeros(())
        if term.scale is not None:
            log_scale = parameters[term.scale].unsqueeze(-1)
        if term.lengthscale is None:  # a constant kernel, whose parameter has one dimension more
            self.covariance = log_scale.exp() * x.new_ones(x.shape[-2], x.shape[-2])
        else:
            z = x / parameters[term.lengthscale].exp()
            half = z.square().sum(-1, keepdim=True) / 2
            # -r^2 / 2 in one matrix product, with the logarithm of the scale for the RBF kernel.
            shifted = log_scale.unsqueeze(-1) - half if term.profile is None else -half
            z = z.expand(*shifted.shape[:-1], z.shape[-1])
            one = torch.ones_like(shifted)
            self._z = torch.cat([z, one], dim=-1)
            right = torch.cat([z, -half.expand_as(one), one], dim=-1)
            exponent = torch.cat([self._z, shifted], dim=-1) @ right.mT
            if term.profile is None:
                self.covariance = exponent.exp_()
            else:
                exponent.diagonal(dim1=-1, dim2=-2).zero_()
                self.covariance, self._slope = term.profile(exponent.clamp_max_(0), derivatives)
                self._multiply(log_scale.exp().unsqueeze(-1))
        if weight is not None:
            self._multiply(weight.unsqueeze(-1))
            self._multiply(weight.unsqueeze(-2))

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
            products, z = (self._z.mT @ slope).mT, self._z[..., :-1]
            products, row_sums = products[..., :-1], products[..., -1:]
            by_each = 2 * (z * (z * row_sums - products)).sum(-2)
            shape = shapes[term.lengthscale]
            by_each = by_each if shape[-1] > 1 else by_each.sum(-1, keepdim=True)
            found[term.lengthscale] = by_each.reshape(shape)
            total = row_sums.sum((-1, -2)) if self._slope is None else None
        if term.scale in shapes:
            if total is None:
                total = (by_covariance * self.covariance).sum((-1, -2))
            found[term.scale] = total.reshape(shapes[term.scale])
        return found

    def _multiply(self, factor: Tensor) -> None:
        """Multiply the covariance, in place where its shape allows."""
        in_place = factor.dim() <= self.covariance.dim() and all(
            ours >= theirs
            for ours, theirs in zip(
                reversed(self.covariance.shape), reversed(factor.shape), strict=False
            )
        )
        self.covariance = self.covariance.mul_(factor) if in_place else self.covariance * factor
        if self._slope is not None:
            self._slope = self._slope.mul_(factor) if in_place else self._slope * factor


def matern12(exponent: Tensor, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """The Matern kernel of smoothness 1/2, exp(-r)."""
    r = exponent.mul_(-2).sqrt_()
    k = (-r).exp()
    # The slope's 1 / r is multiplied by differences that vanish where r does: 0 will do there.
    return k, (k / r).masked_fill_(r == 0, 0.0) if derivatives else None


def matern32(exponent: Tensor, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """The Matern kernel of smoothness 3/2, (1 + t) exp(-t) with t = sqrt(3) r."""
    t = exponent.mul_(-6).sqrt_()
    decay = (-t).exp()
    return (1 + t) * decay, 3 * decay if derivatives else None


def matern52(exponent: Tensor, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """The Matern kernel of smoothness 5/2, (1 + t + t^2 / 3) exp(-t) with t = sqrt(5) r."""
    t = exponent.mul_(-10).sqrt_()
    decay = (-t).exp()
    slope = (5 / 3) * (1 + t) * decay if derivatives else None
    return (1 + t + t.square() / 3) * decay, slope


MATERN: dict[float, Profile] = {0.5: matern12, 1.5: matern32, 2.5: matern52}
