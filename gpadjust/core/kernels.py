"""Kernels: a covariance, and what carries derivatives of a likelihood back to its parameters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.core.unknowns import LogNormal, Row, Values, standard_normal

PullBack = Callable[[Tensor], Values]
Features = Callable[[Tensor], Tensor]

RHO = LogNormal(0.001, 100.0)  # prior variance of a scaling's process
DELTA = LogNormal(0.1, 1000.0)  # that of a process in squared units of the targets
LENGTH_FACTOR = 7.4
STANDARD_DEVIATION = "standard deviation"  # of a process, in summaries


class Kernel(ABC):
    """The covariance function of a Gaussian process, and the priors of its parameters.

    A subclass has ``rows`` and ``covariance``; derivatives are then autograd's. Inputs x are
    ``... x 1 x 1 x n x d``, parameters ``S x m x k``, covariances ``... x S x m x n x n'``.
    """

    has_constant = True
    """Whether a term may add an unknown constant to the process."""

    @abstractmethod
    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the unknown parameters, for training inputs ``n x d``."""

    @abstractmethod
    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the covariances of inputs with others, or with themselves."""

    def toward(self, own: Values, other: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the covariances with others as a function of inputs, to be called often."""
        return partial(self.covariance, own, other=other)  # which can be pickled

    def of_data(self, data: Any) -> Kernel:
        """Return the kernel for a model's data, whose columns have names; itself by default."""
        return self

    def of_term(self, outputscale: LogNormal) -> Kernel:
        """Return the kernel with the prior variance of a term if it has none; or itself."""
        return self

    def in_user_units(self, name: str, numbers: Tensor, unit: float) -> tuple[str, Tensor]:
        """Return the name and numbers of a parameter in summaries, by the unit of the process.

        Here an ``outputscale``, a variance, becomes a standard deviation; others have no unit.
        """
        if not name.endswith("outputscale"):
            return name, numbers
        return name.replace("outputscale", STANDARD_DEVIATION), numbers.sqrt() * unit

    def variance(self, own: Values, x: Tensor) -> Tensor:
        """Return the prior variances, ``... x S x m x n`` (or 1 where all are equal)."""
        points = x.movedim(-2, 0).unsqueeze(-2)  # n x ... x 1 x d
        return self.covariance(own, points)[..., 0, 0].movedim(0, -1)

    def with_pull_back(self, own: Values, x: Tensor) -> tuple[Tensor, PullBack]:
        r"""Return the covariance K, and a function of D = df/dK that gives df by the parameters."""
        if not own:
            return self.covariance(own, x), lambda D: {}
        leaves = {name: value.detach().clone().requires_grad_() for name, value in own.items()}
        with torch.enable_grad():
            K = self.covariance(leaves, x)

        def pull_back(D: Tensor) -> Values:
            slopes = torch.autograd.grad(K, [*leaves.values()], D, materialize_grads=True)
            return dict(zip(leaves, slopes, strict=True))

        return K.detach(), pull_back

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return random features, ``... x n x d`` to ``... x S x m x n x D``, with k as product."""
        raise NotImplementedError(
            f"{self} has no random features, which functions are drawn with. Give its class a "
            "method features, or draw joint samples: model.posterior(X).rsample()."
        )

    def __repr__(self) -> str:
        return type(self).__name__


class Profile(NamedTuple):
    """A stationary kernel as a function of e = -r^2 / 2."""

    name: str
    value: Callable[[Tensor], Tensor]  # k(e)
    slope: Callable[[Tensor], Tensor]  # dk / de, which is -2 dk / d(r^2)
    degrees: float | None = None  # of freedom of the spectrum if that is a Student t


def _matern(p: int) -> Profile:
    """Return the Matern kernel with nu = p + 1/2 (Rasmussen and Williams 2006, eq. 4.16)."""
    nu2 = 2 * p + 1
    value, slope = (partial(function, p) for function in (_matern_value, _matern_slope))
    return Profile(f"matern{nu2}/2", value, slope, float(nu2))


def _matern_value(p: int, e: Tensor) -> Tensor:
    t = (-2 * (2 * p + 1) * e).clamp_min(1e-30).sqrt()  # sqrt(2 nu) r
    return (1.0, 1 + t, 1 + t + t.square() / 3)[p] * (-t).exp()  # exp(-t), (1 + t) exp(-t), ...


def _matern_slope(p: int, e: Tensor) -> Tensor:
    nu2 = 2 * p + 1
    t = (-2 * nu2 * e).clamp_min(1e-30).sqrt()
    polynomial = (1 / t.clamp_min(1e-8), 1.0, (1 + t) / 3)[p]
    slope = nu2 * polynomial * (-t).exp()  # dk/de = -2 nu k'(t) / t
    return slope * (e < 0) if p == 0 else slope


RBF = Profile("rbf", torch.exp, torch.exp, math.inf)  # exp(-r^2 / 2)
MATERN12 = _matern(0)  # nu = 1/2, the exponential kernel
MATERN32 = _matern(1)  # nu = 3/2
MATERN52 = _matern(2)  # nu = 5/2


def exponents(z: Tensor, other: Tensor | None = None) -> Tensor:
    """Return -r^2 / 2 of all pairs of ``... x n x d`` and ``... x n' x d``."""
    if other is not None:  # (z, 1, -|z|^2 / 2) (z', -|z'|^2 / 2, 1)^T
        half, other_half = (-v.square().sum(-1, keepdim=True) / 2 for v in (z, other))
        left = torch.cat([z, torch.ones_like(half), half], -1)
        right = torch.cat([other, other_half, torch.ones_like(other_half)], -1)
        return (left @ right.mT).clamp_max_(0.0)
    # e_ij = z_i z_j - |z_i|^2 / 2 - |z_j|^2 / 2, with a diagonal of 0 exactly
    e = z @ z.mT
    half = e.diagonal(dim1=-1, dim2=-2) / 2
    return (e - half.unsqueeze(-1)).sub_(half.unsqueeze(-2)).clamp_max_(0.0)


class Stationary(Kernel):
    r"""A kernel :math:`s \, k(|(x - x') / \ell|)` with a lengthscale for each input.

    Args:
        profile: k.
        outputscale: The prior of s, in squared units of the targets (of a scaling without unit).
            Default: that of the term.
        lengthscale: The prior of each lengthscale, in shares of d times the range of its input.
    """

    lengthscale = LogNormal(1.0, LENGTH_FACTOR)

    def __init__(
        self, profile: Profile = RBF, outputscale: LogNormal | None = None,
        lengthscale: LogNormal = lengthscale,
    ) -> None:  # fmt: skip
        self.profile = profile
        self.outputscale = outputscale
        self.lengthscale = lengthscale

    def of_term(self, outputscale: LogNormal) -> Stationary:
        """Return the kernel with the prior variance of a term, if it has none."""
        new = copy(self)
        new.outputscale = self.outputscale or outputscale
        return new

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the lengthscales of the inputs, and the outputscale."""
        ranges = x.amax(-2) - x.amin(-2)
        ranges = ranges.where(ranges > 0, torch.ones_like(ranges))
        length = (self.lengthscale.median * len(ranges) * ranges).expand(num_outputs, -1)
        prior = self.outputscale or DELTA
        scale = length.new_full((num_outputs, 1), prior.median)
        return [
            Row.positive("lengthscale", length, self.lengthscale.factor),
            Row.positive("outputscale", scale, prior.factor),
        ]

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return ``s k(|(x - x') / l|)``."""
        length = own["lengthscale"].unsqueeze(-2)
        # Without a shift distances of large inputs, as of years, would lose digits.
        if other is None:
            z = (x - x.detach().mean(-2, keepdim=True)) / length
            return self._scaled(exponents(z), own["outputscale"])
        shift = other.detach().mean(-2, keepdim=True)
        e = exponents((x - shift) / length, (other - shift) / length)
        return self._scaled(e, own["outputscale"])

    def _scaled(self, e: Tensor, outputscale: Tensor) -> Tensor:
        """Return ``s k(e)``; without a graph in place, which takes half the time."""
        scale = outputscale.unsqueeze(-1)
        if e.requires_grad or scale.requires_grad:
            return scale * self.profile.value(e)
        return (e.exp_() if self.profile is RBF else self.profile.value(e)).mul_(scale)

    def toward(self, own: Values, other: Tensor) -> Callable[[Tensor], Tensor]:
        r"""Return covariances by one product of all draws, :math:`e = (x, x^2, 1) \cdot A`."""
        is_of_draws = other.shape[-4:-2] != (1, 1)
        if is_of_draws or type(self).covariance is not Stationary.covariance:
            return super().toward(own, other)
        shift = other.mean(-2, keepdim=True)
        w = own["lengthscale"].square().reciprocal().unsqueeze(-2)
        o = other - shift
        # e = sum_k w_k (x_k o_k - x_k^2 / 2 - o_k^2 / 2); of s e^e log s is part of A.
        last = -(o.square() * w).sum(-1, keepdim=True) / 2
        if self.profile is RBF:
            last = last + own["outputscale"].unsqueeze(-1).log()
        A = torch.cat([o * w, (-w / 2).expand_as(o * w), last], -1)  # S x m x n' x (2 d + 1)
        return partial(self._toward, own, other, shift, A)

    def _toward(self, own: Values, other: Tensor, shift: Tensor, A: Tensor, x: Tensor) -> Tensor:
        if x.shape[-4:-2] != (1, 1):
            return self.covariance(own, x, other)
        z = (x - shift)[..., 0, 0, :, :]
        e = torch.cat([z, z.square(), torch.ones_like(z[..., :1])], -1) @ A.flatten(0, -2).mT
        e = e.unflatten(-1, A.shape[:-1]).movedim(-4, -2)
        if self.profile is RBF:
            return e.exp_()
        return self._scaled(e.clamp_max_(0.0), own["outputscale"])

    def variance(self, own: Values, x: Tensor) -> Tensor:
        """Return ``s``."""
        return own["outputscale"]

    def with_pull_back(self, own: Values, x: Tensor) -> tuple[Tensor, PullBack]:
        r"""Return K and its derivatives in closed form, with :math:`M = s D \circ dk/de`.

        .. math::
            \frac{\partial f}{\partial s} = \frac{1}{s} \sum D \circ K, \quad
            \frac{\partial f}{\partial \ell_k} = \frac{1}{\ell_k} \sum_{ij} M_{ij}
            (z_{ik} - z_{jk})^2.
        """
        length = own["lengthscale"].unsqueeze(-2)
        z = (x - x.mean(-2, keepdim=True)) / length
        e = exponents(z)
        K = self._scaled(e, own["outputscale"])
        slope = K  # of RBF k is dk / de
        if self.profile is not RBF:
            slope = self.profile.slope(e).mul_(own["outputscale"].unsqueeze(-1))

        def pull_back(D: Tensor) -> Values:
            M = D * slope
            sums = M.sum(-1, keepdim=True)
            # sum_ij M_ij (z_i - z_j)^2 = 2 sum_i z_i (z_i sum_j M_ij - sum_j M_ij z_j)
            by_log = 2 * (z * (z * sums - M @ z)).sum(-2)
            total = sums.sum(-2) if slope is K else (D * K).sum((-1, -2)).unsqueeze(-1)
            by_scale = total / own["outputscale"].clamp_min(1e-300)
            return {"lengthscale": by_log / own["lengthscale"], "outputscale": by_scale}

        return K, pull_back

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return sines and cosines of frequencies of the kernel's spectrum."""
        degrees = self.profile.degrees
        if degrees is None:
            return super().features(own, number, generator)
        length = own["lengthscale"]
        shape = (len(length), 1, length.shape[-1], number // 2)  # each function has others
        w = standard_normal(shape, generator, length)
        # A Student t is normal / sqrt(chi^2 / degrees); chi^2 is a sum of squares.
        if math.isfinite(degrees):
            shape = (len(length), 1, int(degrees), number // 2)
            chi2 = standard_normal(shape, generator, length).square().sum(-2, keepdim=True)
            w = w * (degrees / chi2).sqrt()
        return lambda x: fourier_features(own, x, w)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.profile.name})"


def fourier_features(own: Values, x: Tensor, w: Tensor) -> Tensor:
    """Return sines and cosines of frequencies ``d x D/2``."""
    # sqrt(s / n) (sin a, cos a), a = w x / l, of n frequencies
    a = (x / own["lengthscale"].unsqueeze(-2)) @ w.to(x)
    size = (own["outputscale"] / w.shape[-1]).sqrt().unsqueeze(-1)
    return size * torch.cat([a.sin(), a.cos()], -1)
