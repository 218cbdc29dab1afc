"""Scaled RBF and Matern kernels in closed form: what most terms have, and what is made fast."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from gpytorch.kernels import Kernel, MaternKernel, RBFKernel, ScaleKernel
from torch import Tensor

# Maps -r^2 / 2 to the kernel, and (if asked for) to -2 dk / d(r^2).
Profile = Callable[[Tensor, bool], tuple[Tensor, Tensor | None]]


class StationaryKernel(NamedTuple):
    r"""A kernel :math:`s \, k(|x - x'| / \ell)`, by the names of its parameters.

    Attributes:
        lengthscale: Name of the raw lengthscales within the kernel.
        outputscale: Name of the raw outputscale s, or None for 1.
        profile: The kernel as a function of -r^2 / 2, or None for the RBF kernel, its exponential.
    """

    lengthscale: str
    outputscale: str | None
    profile: Profile | None


def stationary_form(kernel: Kernel | None, num_inputs: int) -> StationaryKernel | None:
    """Recognise a kernel of that form, with or without ``ScaleKernel``; None for any other."""
    outputscale, path = None, ""
    if type(kernel) is ScaleKernel and kernel.active_dims is None:
        outputscale, path, kernel = "raw_outputscale", "base_kernel.", kernel.base_kernel
    if type(kernel) not in (RBFKernel, MaternKernel) or kernel.active_dims is not None:
        return None
    if kernel.ard_num_dims not in (None, num_inputs):
        return None
    profile = None if type(kernel) is RBFKernel else _MATERN[kernel.nu]
    return StationaryKernel(f"{path}raw_lengthscale", outputscale, profile)


class StationaryRows(NamedTuple):
    """Inputs in lengthscales, made ready for a matrix product that gives all -r^2 / 2.

    Attributes:
        z: ``... x n x d``.
        half: Half their squared norms, ``... x n x 1``.
    """

    z: Tensor
    half: Tensor

    @classmethod
    def of(cls, x: Tensor, lengthscale: Tensor) -> StationaryRows:
        """From inputs ``... x n x d`` and lengthscales ``... x 1 x d``."""
        z = x / lengthscale
        return cls(z, z.square().sum(-1, keepdim=True) / 2)


def exponents(left: StationaryRows, right: StationaryRows, shift: Tensor | None = None) -> Tensor:
    """Return -r^2 / 2 of all pairs (plus a shift, ``... x 1 x 1``), ``... x n x n'``."""
    half = -left.half if shift is None else shift - left.half
    z = left.z.expand(*half.shape[:-1], left.z.shape[-1])
    one = torch.ones_like(right.half)
    return torch.cat([z, torch.ones_like(half), half], -1) @ torch.cat(
        [right.z, -right.half, one], -1
    ).mT


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
