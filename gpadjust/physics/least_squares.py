"""Unknown parameters of a physics by least squares, from far starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from scipy.optimize import least_squares
from torch import Tensor

FITS = 12  # at most
_FREE = 4  # of them from the prior
_SAME = 3  # so many that end alike are enough
_ALIKE = 0.1  # of log densities
_MIDDLE = 0.67  # a coordinate by the prior is less with a probability of one half
_ROUNDS, _STEPS = 4, 60  # of the noise in a fit, and of the parameters in a round
_BETTER = 0.9  # a round that leaves more of the last noise is the last one
_FIRM = 0.1  # standard deviation of the noise in a fit, of that left, so that data outweigh priors
_DIFFERENCE = 1e-4  # of coordinates, for derivatives


def least_squares_fit(misfit: Callable[[Tensor], Tensor], begins: Tensor) -> Tensor:
    """Return coordinates ``p`` of the parameters that fit observations best.

    Each of the begins, ``N x p``, is improved by a trust-region method, with priors as further
    residuals and the noise that the last round has left. Later begins are the best end so far, but
    for coordinates far from the middle of the prior. The search ends when several ends are alike.

    Args:
        misfit: Residuals ``k x n`` at coordinates ``k x p``, N(0, I) by the prior; NaN where the
            physics fails.
        begins: Where searches begin.
    """
    eye = torch.eye(begins.shape[-1]).to(begins)

    def left(z: Tensor) -> float:
        return float(misfit(z.unsqueeze(0)).square().mean().sqrt())

    def residuals(z: Any, noise: float) -> Any:
        at = torch.as_tensor(z)
        return torch.cat([misfit(at.unsqueeze(0))[0] / noise, at]).numpy()

    def jacobian(z: Any, noise: float) -> Any:
        at, steps = torch.as_tensor(z), _DIFFERENCE * eye
        up, down = misfit(torch.cat([at + steps, at - steps])).chunk(2)
        slopes = ((up - down) / (2 * _DIFFERENCE * noise)).nan_to_num()
        return torch.cat([slopes.mT, eye]).numpy()

    ends: list[tuple[float, Tensor]] = []
    for z in begins:
        if len(ends) >= _FREE:
            z = torch.where(z.abs() < _MIDDLE, ends[0][1], z)
        noise = left(z)
        for _ in range(_ROUNDS if 0 < noise < math.inf else 0):
            options = {"args": (_FIRM * noise,), "max_nfev": _STEPS, "ftol": 1e-4, "xtol": 1e-6}
            z = torch.as_tensor(least_squares(residuals, z.numpy(), jacobian, **options).x)
            before, noise = noise, left(z)
            if not 0 < noise < _BETTER * before:
                break
        # Minus the log density, n log(noise) + |z|^2 / 2; it is infinite where the physics fails.
        size = math.log(max(noise, 1e-12)) if math.isfinite(noise) else math.inf
        number = misfit(z.unsqueeze(0)).shape[-1]
        ends = sorted([*ends, (number * size + 0.5 * float(z.square().sum()), z)], key=_cost)
        if sum(cost < ends[0][0] + _ALIKE for cost, _ in ends) == _SAME:
            break
    return ends[0][1]


def _cost(end: tuple[float, Tensor]) -> float:
    return end[0]
