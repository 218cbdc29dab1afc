"""Unknown parameters of a physics by least squares, without any Gaussian process."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust.inference.calibration import Misfit, or_infinite

_GUESSES = 512  # of the parameters, of which the best are started from
_STARTS = 32
_ROUNDS_OF_SEARCHES = 4  # at most
_UNSEEN = 0.02  # of the posterior, near optima that searches have not come to
_ITERATIONS = 60  # of least squares
_ARRIVED = 1e-4  # decrease of a negative log density at which they stop
_BESIDE = 0.5  # standard deviations, within which starts or optima are one
_ALIKE = 1e-3  # standard deviations of the prior, likewise
_REACHED = 2.0  # standard deviations from an optimum, within which a search came to it
_WORSE = 12.0  # negative log density, beside the best, of an optimum that does not count
_KEPT = 12  # of these
_STUCK = 1e8  # damping of a search that finds nothing better
_SILENT = 1e-14  # the mean square of residuals, relative to that of the targets, that is none


class Optima(NamedTuple):
    """Results of least squares.

    Attributes:
        points: Coordinates of all optima that count, the best first, ``k x p``.
        variances: Mean squares of the residuals at the best, ``B``.
        unseen: About the share of the posterior near others that no search came to: that of those
            that one alone did (after Good and Turing), and of what is too many.
    """

    points: Tensor
    variances: Tensor
    unseen: float


@torch.no_grad()
def least_squares(misfit: Misfit, generator: torch.Generator) -> Optima:
    r"""The parameters that fit best without any Gaussian process.

    They minimise :math:`\sum_j \tfrac{n_j}{2} \log |r_j|^2 + \tfrac12 |z|^2`, with the variance
    of each output's residuals at its best. Where a single search came to an optimum, there are
    likely others that none did, so that more begin.
    """
    guesses, found = (
        misfit.point.unsqueeze(0),
        [],
    )  # where it works, as the model was built there
    for _ in range(_ROUNDS_OF_SEARCHES):
        others = spread_normal((_GUESSES, guesses.shape[-1]), generator).to(guesses)
        found.append(descend(misfit, torch.cat([guesses, others])))
        points, values, variances, hessians = map(torch.cat, zip(*found, strict=True))
        kept, square = _apart(points, values, hessians)
        share = (values[kept].min() - values[kept]).exp()
        alone = (square < _REACHED**2).sum(-1) == 1
        alone[_KEPT:] = True
        unseen = (share * alone).sum() / share.sum()
        if unseen < _UNSEEN:
            break
        guesses = guesses[:0]
    kept = kept[:_KEPT]
    kept = kept[values[kept] < values[kept[0]] + _WORSE]
    return Optima(points[kept], variances[kept[0]], unseen.item())


def descend(misfit: Misfit, guesses: Tensor) -> tuple[Tensor, ...]:
    """Searches by Levenberg and Marquardt, which begin at the best of guesses ``... x p``.

    Returns:
        Where they came to, ``k x p``, what they minimise there, ``k``, variances of residuals,
        ``k x B``, and about the second derivatives, ``k x p x p``.
    """
    values = _misfit(misfit, guesses, misfit.residuals(guesses))[0]
    prior = torch.eye(guesses.shape[-1]).to(guesses).expand(len(guesses), -1, -1)
    best = _apart(guesses, values, prior)[0][:_STARTS]
    near = misfit.linearized(guesses[best[values[best].isfinite()]])
    values, variances = _misfit(misfit, near.point, near.residual)
    damping = values.new_full((len(values), 1, 1), 1e-3)
    hessians = torch.empty_like(damping).expand(-1, *prior.shape[1:]).clone()
    going = torch.arange(len(values), device=values.device)
    for _ in range(_ITERATIONS):
        z, slope = near.point[going], near.slope[going]
        weighted = slope / variances[going][..., None, None]
        residual = near.residual[going].unsqueeze(-1)
        gradient = (weighted.mT @ residual).sum(-3).squeeze(-1) - z
        hessian = hessians[going] = (weighted.mT @ slope).sum(-3) + prior[0]
        damped = hessian + damping[going] * torch.diag_embed(hessian.diagonal(dim1=1, dim2=2))
        moved = misfit.linearized(z + torch.linalg.solve(damped, gradient))
        found, others = _misfit(misfit, moved.point, moved.residual)
        better = found < values[going]
        arrived = better & (values[going] - found < _ARRIVED)
        damping[going] *= torch.where(better, 0.2, 5.0)[:, None, None]
        pairs = zip((*near, variances, values), (*moved, others, found), strict=True)
        for old, new in pairs:
            old[going[better]] = new[better]
        going = going[~arrived & (damping[going].flatten() < _STUCK)]
        if not len(going):
            break
    return near.point, values, variances, hessians


def _misfit(misfit: Misfit, z: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return the objective, ``k``, and the variances of residuals, ``k x B``."""
    count = misfit.observed.sum(-1).to(z)
    least = _SILENT * misfit.targets.square().nanmean(-1) + torch.finfo(z.dtype).tiny
    variances = (residual.square().sum(-1) / count).maximum(least)
    value = (0.5 * count * variances.log()).sum(-1) + 0.5 * z.square().sum(-1)
    return or_infinite(value), variances


def _apart(points: Tensor, values: Tensor, hessians: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``k x p`` that are not beside a better one.

    Args:
        points: The points.
        values: Negative log densities there, ``k``.
        hessians: Metrics of distances from each, ``k x p x p``.

    Returns:
        Their numbers, ``K``, the best first, and squares of their distances to all, ``K x k``.
    """
    order = values.argsort()
    away = points[order].unsqueeze(0) - points[order].unsqueeze(1)
    square = torch.einsum("ijp,ipq,ijq->ij", away, hessians[order], away)
    alike = (square < _BESIDE**2) | (away.square().sum(-1) < _ALIKE**2)
    first = ~alike.tril(-1).any(-1)
    return order[first], square[first]


def spread_normal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Standard normal draws ``... x p`` that fill space evenly, in random order (Sobol)."""
    seed = int(torch.randint(2**31, (1,), generator=generator))
    engine = SobolEngine(shape[-1], scramble=True, seed=seed)
    number = math.prod(shape[:-1])
    shares = engine.draw(number, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
    order = torch.randperm(number, generator=generator)
    return torch.special.ndtri(shares[order]).reshape(shape)
