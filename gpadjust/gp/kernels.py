"""Kernels of terms: scaled RBF and Matern kernels in closed form, and any other by an adapter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any, NamedTuple, Self

import torch
from gpytorch.kernels import Kernel, MaternKernel, RBFKernel, ScaleKernel
from linear_operator import to_dense
from torch import Size, Tensor
from torch.nn import Module, Parameter

_TINY = 1e-30  # of a squared distance, at which its root has a gradient


class Batched(Module):
    """A module whose tensors and kernels all have its batch dimensions, in front."""

    def map_batches(self, change: Callable[[Any], Any]) -> Self:
        """A copy whose kernels and tensors are changed along their batch dimensions."""
        new = deepcopy(self)
        child: Any
        for name, child in self.named_children():
            if isinstance(child, Kernel):
                setattr(new, name, change(child))
            elif hasattr(child, "map_batches"):
                setattr(new, name, child.map_batches(change))
        for name, old in self.named_parameters(recurse=False):
            setattr(new, name, Parameter(change(old.detach()), requires_grad=old.requires_grad))
        for name, buffer in self.named_buffers(recurse=False):
            if name != "active_dims":  # GPyTorch's, which has no batch
                setattr(new, name, change(buffer))
        return new


class CompositeKernel(Batched, Kernel):
    """A kernel made of others, which follows more than differences of inputs."""

    @property
    def is_stationary(self) -> bool:
        """False."""
        return False

    def __getitem__(self, index: Any) -> Self:
        """The kernel of a part of the batch."""
        index = index if isinstance(index, tuple) else (index,)
        return self.map_batches(lambda part: part[index]) if self.batch_shape else self

    def expand_batch(self, *sizes: Any) -> Self:
        """The kernel with its batch expanded to ``sizes``."""
        shape = Size(sizes if isinstance(sizes[0], int) else sizes[0])
        own: Any = self.batch_shape
        return self.map_batches(
            lambda part: (
                part.expand_batch(shape)
                if isinstance(part, Kernel)
                else part.expand(*shape, *part.shape[len(own) :])
            )
        )


class Profile(NamedTuple):
    """A stationary kernel k as a function of e = -r^2 / 2, ``e <= 0``."""

    value: Callable[[Tensor], Tensor]  # maps e to k; it may overwrite e
    slope: Callable[[Tensor], Tensor] | None = None  # maps e to -2 dk / d(r^2); None if that is k


class Pairs(NamedTuple):
    """The covariance of all pairs of some points, with what its derivatives are made of."""

    covariance: Tensor  # K, ... x n x n
    slope: Tensor | None  # -2 dK / d(r^2), of the same shape, or None if that is K
    z: Tensor  # the points in lengthscales, ... x n x d

    def pull_back(self, by: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        r"""Carry derivatives D by :math:`B K B`, with a diagonal B, back to what it is made of.

        That by :math:`\log s` of a factor s of K is :math:`\sum_{ij} M_{ij}` with :math:`M = D
        \circ B K B`, that by :math:`b_i` is :math:`2 \sum_j (D \circ K)_{ij} b_j`, and that by
        :math:`\log \ell_k` is :math:`\sum_{ij} M_{ij} (z_{ik} - z_{jk})^2 = 2 \sum_i z_{ik}^2 (M
        1)_i - 2 z_k^T M z_k`, with the slope in place of K: one product for all inputs.

        D is symmetric; the weight is the diagonal of B, ``... x n``, or None for 1. Returns the
        derivatives by log lengthscales, ``... x d``, log s, ``...``, and weight, ``... x n``.
        """
        z = self.z
        columns = torch.cat([z, torch.ones_like(z[..., :1])], dim=-1)
        columns = columns if weight is None else columns * weight.unsqueeze(-1)
        by_k = by * self.covariance
        by_slope = by_k if self.slope is None else by * self.slope
        columns = columns.expand(*by_slope.shape[:-1], columns.shape[-1])
        # D is symmetric, and the product faster this way round.
        products = (columns.mT @ by_slope).mT
        rows = products[..., -1]
        if self.slope is not None:
            rows = (columns[..., -1:].mT @ by_k).squeeze(-2)
        by_scale = (rows if weight is None else rows * weight).sum(-1)
        products = products if weight is None else products * weight.unsqueeze(-1)
        by_length = 2 * (z * (z * products[..., -1:] - products[..., :-1])).sum(-2)
        return by_length, by_scale, 2 * rows


class Stationary(NamedTuple):
    r"""A kernel :math:`s \, k(|x - x'| / \ell)` at values of its parameters."""

    lengthscale: Tensor  # l, ... x 1 x d or ... x 1 x 1
    scale: Tensor  # the outputscale s, ...
    profile: Profile  # k

    def covariance(self, x1: Tensor, x2: Tensor | None = None) -> Tensor:
        """The kernel of all pairs of inputs ``... x n x d`` and ``... x n' x d``, or of one set."""
        origin = x1.detach().mean(-2, keepdim=True)
        z = (x1 - origin) / self.lengthscale
        exponent = _exponents(z, None if x2 is None else (x2 - origin) / self.lengthscale)
        if x2 is None:
            # The closest pairs are differences of large numbers; these are known.
            exponent = exponent - torch.diag_embed(exponent.diagonal(dim1=-1, dim2=-2))
        return self.scale[..., None, None] * self.profile.value(exponent.clamp_max(0.0))

    def diagonal(self, x: Tensor) -> Tensor:
        """The variances at inputs ``... x n x d``, ``... x n``."""
        batch = torch.broadcast_shapes(x.shape[:-2], self.scale.shape)
        return self.scale.unsqueeze(-1).expand(*batch, x.shape[-2])

    def variance(self) -> Tensor:
        """The variance, which is the same everywhere, ``... x 1``."""
        return self.scale.unsqueeze(-1)

    def pairs(self, x: Tensor, derivatives: bool = True) -> Pairs:
        """All pairs of centered inputs ``... x n x d``, and what derivatives are made of."""
        z, scale = x / self.lengthscale, self.scale[..., None, None]
        if self.profile is RBF:
            return Pairs(_exponents(z, shift=self.scale.log()[..., None, None]).exp_(), None, z)
        exponent = _exponents(z)
        exponent.diagonal(dim1=-1, dim2=-2).zero_()
        exponent, slope = exponent.clamp_max_(0), None
        if derivatives and self.profile.slope is not None:
            slope = scale * self.profile.slope(exponent)
        return Pairs(scale * self.profile.value(exponent), slope, z)


class AnyKernel(NamedTuple):
    """Any GPyTorch kernel, by the methods of :class:`Stationary` that predictions need."""

    kernel: Kernel

    def covariance(self, x1: Tensor, x2: Tensor | None = None) -> Tensor:
        """The kernel of all pairs of inputs ``... x n x d`` and ``... x n' x d``, or of one set."""
        return to_dense(self.kernel(x1, x1 if x2 is None else x2))

    def diagonal(self, x: Tensor) -> Tensor:
        """The variances at inputs ``... x n x d``, ``... x n``."""
        return to_dense(self.kernel(x, x, diag=True))

    def variance(self) -> None:
        """None: it may not be the same everywhere."""


class ToPoints:
    r"""Stationary kernels between any inputs and fixed points, by one product; for values alone.

    With :math:`\tilde x` the inputs less the mean of the points, -r^2 / 2 is :math:`[\tilde x,
    \tilde x^2, 1] \, R` for a matrix R of the points and lengthscales.
    """

    @torch.no_grad()
    def __init__(self, forms: Mapping[str, Stationary], points: Tensor) -> None:
        self.origin = points.mean(-2, keepdim=True)
        self.forms = {
            name: Stationary(form.lengthscale.detach(), form.scale.detach(), form.profile)
            for name, form in forms.items()
        }
        self.is_rbf = all(form.profile is RBF for form in forms.values())
        matrices = []
        for form in self.forms.values():
            z = (points - self.origin) / form.lengthscale
            half = z.square().sum(-1, keepdim=True) / 2
            # The scale of RBF kernels is in their exponents.
            last = form.scale.log()[..., None, None] - half if self.is_rbf else -half
            square = (-0.5 / form.lengthscale.square()).expand_as(z)
            matrices.append(torch.cat([z / form.lengthscale, square, last], dim=-1).mT)
        if matrices:
            self.stack = torch.stack(torch.broadcast_tensors(*matrices), -3).contiguous()

    def __call__(self, x: Tensor) -> dict[str, Tensor]:
        """The kernels between inputs ``... x q x (d + k)`` and the points, ``... x q x n``."""
        if not self.forms:
            return {}
        x = x[..., : self.origin.shape[-1]] - self.origin
        left = torch.cat([x, x.square(), torch.ones_like(x[..., :1])], dim=-1)
        exponents = left.unsqueeze(-3) @ self.stack
        if self.is_rbf:
            return dict(zip(self.forms, exponents.exp_().unbind(-3), strict=True))
        pairs = zip(self.forms.items(), exponents.clamp_max(0.0).unbind(-3), strict=True)
        return {n: f.scale[..., None, None] * f.profile.value(e.clone()) for (n, f), e in pairs}


def stationary_parts(kernel: Any, num_inputs: int) -> tuple[Any, Any, Profile] | None:
    """The modules with lengthscale and outputscale (or None) of a stationary kernel, and k.

    None for a kernel that is not one of :data:`PROFILES`, with or without ``ScaleKernel``.
    """
    scaled = None
    if type(kernel) is ScaleKernel and kernel.active_dims is None:
        scaled, kernel = kernel, kernel.base_kernel
    profile = PROFILES.get(type(kernel))
    fits = kernel.active_dims is None and kernel.ard_num_dims in (None, num_inputs)
    return None if profile is None or not fits else (kernel, scaled, profile(kernel))


def _exponents(z: Tensor, other: Tensor | None = None, shift: Tensor | float = 0.0) -> Tensor:
    """-r^2 / 2 of all pairs (plus a shift, ``... x 1 x 1``), ``... x n x n'``, by one product."""
    half = z.square().sum(-1, keepdim=True) / 2
    other_half = half if other is None else other.square().sum(-1, keepdim=True) / 2
    columns = torch.cat(
        [z if other is None else other, -other_half, torch.ones_like(other_half)], -1
    )
    first = shift - half
    z = z.expand(*first.shape[:-1], z.shape[-1])
    return torch.cat([z, torch.ones_like(first), first], -1) @ columns.mT


def _of_root(factor: float, function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """A function of the root of ``-factor e``, with a gradient of zero where e is zero."""
    return lambda e: function((-factor * e).clamp_min(_TINY).sqrt())


RBF = Profile(torch.exp_)
_MATERN = {  # exp(-r), (1 + t) exp(-t) and (1 + t + t^2 / 3) exp(-t) with t = sqrt(2 nu) r
    0.5: Profile(
        _of_root(2.0, lambda r: (-r).exp()),
        # 1 / r is multiplied by differences that vanish where r does: 0 will do there.
        lambda e: _of_root(2.0, lambda r: (-r).exp() / r)(e).masked_fill(e == 0, 0.0),
    ),
    1.5: Profile(
        _of_root(6.0, lambda t: (1 + t) * (-t).exp()), _of_root(6.0, lambda t: 3 * (-t).exp())
    ),
    2.5: Profile(
        _of_root(10.0, lambda t: (1 + t + t.square() / 3) * (-t).exp()),
        _of_root(10.0, lambda t: (5 / 3) * (1 + t) * (-t).exp()),
    ),
}
PROFILES: dict[type[Kernel], Callable[[Any], Profile]] = {
    RBFKernel: lambda kernel: RBF,
    MaternKernel: lambda kernel: _MATERN[kernel.nu],
}
"""Profiles by classes of stationary kernels, made of a kernel: enter yours to make it fast."""
