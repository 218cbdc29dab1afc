"""Unknown parameters of a physics by least squares, from far starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from scipy.optimize import least_squares
from torch import Tensor

_STAGES, _FITS = 5, 4  # of the search, and fits in a stage
_MIDDLE = 0.67  # a coordinate by the prior is less with a probability of one half
_PROMISING = 0.7  # of the least misfit so far, for a begin by its linear misfit
_RANK = 1e-6  # singular values of slopes, in the largest one, that count as zero
_ROUNDS, _STEPS = 4, 60  # of the noise in a fit, and of the parameters in a round
_BETTER = 0.9  # a round that leaves more of the last noise is the last one
_FIRM = 0.1  # noise in a fit, as a share of the residuals, so that data outweigh priors
_DIFFERENCE = 1e-4  # of coordinates, for derivatives


def least_squares_fit(misfit: Callable[[Tensor], Tensor], draws: Tensor) -> Tensor:
    """Return coordinates ``p`` of the parameters that fit observations best.

    Fits begin with the middle of the prior and with the draws from it around which the physics
    would fit best if it were linear. While such draws promise a better fit, further fits begin
    with the best parameters so far, except for coordinates of a draw that are far from the middle.

    ``misfit`` returns residuals ``k x n`` at coordinates ``k x p``, N(0, I) by the prior, NaN where
    the physics fails; ``draws`` are from the prior, ``N x p``.
    """
    ranked = draws[_linear_misfit(misfit, draws).argsort()]
    begins = torch.cat([torch.zeros_like(draws[:1]), ranked[: _FITS - 1]])
    best = begins[0]
    lowest = least = math.inf
    for stage in range(_STAGES):
        for begin in begins:
            z, left = _fit(misfit, begin)
            # Minus the log density, n log(noise) + |z|^2 / 2.
            size = math.log(max(left, 1e-12))
            cost = misfit(z.unsqueeze(0)).numel() * size + 0.5 * float(z.square().sum())
            if cost < lowest:
                best, lowest, least = z, cost, left
        # Far coordinates of a draw, near ones of the best fit.
        mixed = torch.where(draws.abs() < _MIDDLE, best, draws)
        promised = _linear_misfit(misfit, mixed)
        number = int((promised < _PROMISING * least).sum())
        begins = mixed[promised.argsort()[:number][_FITS * stage : _FITS * (stage + 1)]]
    return best


def _slopes(misfit: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """Return derivatives ``k x n x p`` at ``k x p``, by central differences."""
    steps = _DIFFERENCE * torch.eye(z.shape[-1]).to(z)
    moved = torch.cat([z.unsqueeze(1) + steps, z.unsqueeze(1) - steps], 1)
    up, down = misfit(moved.flatten(0, 1)).unflatten(0, moved.shape[:2]).chunk(2, 1)
    return ((up - down) / (2 * _DIFFERENCE)).mT  # (r(z + h e_j) - r(z - h e_j)) / (2 h)


def _linear_misfit(misfit: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """Return the root mean squares ``k`` that are left if the physics is linear around ``z``."""
    left = misfit(z)
    slopes = _slopes(misfit, z)
    fails = ~(left.isfinite().all(-1) & slopes.isfinite().flatten(1).all(-1))
    left = left.nan_to_num(0.0, 0.0, 0.0)
    slopes = slopes.nan_to_num(0.0, 0.0, 0.0)
    slopes = slopes / slopes.norm(dim=1, keepdim=True).clamp_min(1e-12)
    U, size, _ = torch.linalg.svd(slopes, full_matrices=False)
    U = U * (size > _RANK * size[:, :1]).unsqueeze(1)
    # r - U U^T r: no change of the parameters explains more of r
    left = left - (U @ (U.mT @ left.unsqueeze(-1)))[..., 0]
    return left.square().mean(-1).sqrt().masked_fill(fails, math.inf)


def _fit(misfit: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, float]:
    """Return the end of a search from ``z``, by a trust region, and the noise it leaves."""
    eye = torch.eye(len(z)).to(z)

    def noise_at(z: Tensor) -> float:
        size = float(misfit(z.unsqueeze(0)).square().mean().sqrt())
        return size if math.isfinite(size) else math.inf

    def residuals(z: Any, noise: float) -> Any:
        z = torch.as_tensor(z)
        return torch.cat([misfit(z.unsqueeze(0))[0] / noise, z]).numpy()  # the prior is N(0, I)

    def jacobian(z: Any, noise: float) -> Any:
        slopes = _slopes(misfit, torch.as_tensor(z).unsqueeze(0))[0]
        return torch.cat([slopes.nan_to_num() / noise, eye]).numpy()

    noise = noise_at(z)
    if not 0 < noise < math.inf:
        return z, noise
    for _ in range(_ROUNDS):
        options = {"args": (_FIRM * noise,), "max_nfev": _STEPS, "ftol": 1e-4, "xtol": 1e-6}
        z = torch.as_tensor(least_squares(residuals, z.numpy(), jacobian, **options).x)
        before = noise
        noise = noise_at(z)
        if not 0 < noise < _BETTER * before:
            break
    return z, noise
