"""Hamiltonian Monte Carlo with many chains in one batch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

# Maps positions k x B x p to potentials k x B and their gradients k x B x p.
Potential = Callable[[Tensor], tuple[Tensor, Tensor]]

_TARGET = 0.8  # acceptance rate that the step size is adapted to
_TRAJECTORY = 1.5  # mean length of a trajectory, in standard deviations
_MOST_STEPS = 10
_ENOUGH = 20  # positions for each coordinate, to learn a covariance that is roughly known
_INFLATION = 1.2  # of the standard deviations of the Gaussian for long jumps


class Draws(NamedTuple):
    """What a sampler brings back.

    Attributes:
        positions: ``iterations x chains x B x p``.
        values: The potential there, ``iterations x chains x B``.
        acceptance: Mean acceptance rate of each problem, ``B``.
    """

    positions: Tensor
    values: Tensor
    acceptance: Tensor


def hmc(
    potential: Potential,
    start: Tensor,
    num_warmup: int,
    num_iterations: int,
    generator: torch.Generator,
    progress: Callable[[], object] = lambda: None,
    centre: Tensor | None = None,
    root: Tensor | None = None,
) -> Draws:
    r"""Sample from :math:`\exp(-U)` with ``C`` chains of each of ``B`` problems, in lockstep.

    Hamiltonian Monte Carlo (Neal 2011) with trajectories of random length, each followed by an
    independence Metropolis step that may jump between modes. The chains of a problem share a step
    size, adapted by dual averaging (Hoffman and Gelman 2014), and their pooled mean and covariance
    in the second half of the warm-up so far, whose inverse is the mass matrix: many chains learn it
    in few iterations, and one evaluation of a batch costs little more than that of one chain. A
    warm-up that is too short for that keeps the ones that it is given.

    Args:
        potential: The potential U and its gradient.
        start: Starting positions, ``C x B x p``.
        num_warmup: Number of iterations that adapt, and are thrown away.
        num_iterations: Number of iterations that are kept.
        generator: Source of randomness.
        progress: Called after each iteration.
        centre: A mean to begin with, ``B x p``, such as the optimum.
        root: A root of the covariance around it, lower triangular, ``B x p x p``, such as that of
            Laplace's approximation.
    """
    chains, problems, p = start.shape

    def normal() -> Tensor:
        return torch.randn(chains, problems, p, generator=generator, dtype=start.dtype).to(start)

    def uniform() -> Tensor:
        return torch.rand(chains, problems, generator=generator, dtype=start.dtype).to(start)

    def move(accept: Tensor, x: Tensor, f: Tensor, g: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        each = accept.unsqueeze(-1)
        return x.where(each, position), f.where(accept, value), g.where(each, gradient)

    position = start
    value, gradient = potential(position)
    mean = centre
    if root is None:
        root = 0.1 * torch.eye(p).to(start).expand(problems, p, p)
    step = _DualAveraging(start.new_full((problems,), 0.5))
    history, kept, values = [], [], []
    accepted = start.new_zeros(problems)
    updates = {num_warmup // 4, num_warmup // 2, 3 * num_warmup // 4}
    if centre is not None and chains * num_warmup < _ENOUGH * p:
        updates = set()
    for iteration in range(num_warmup + num_iterations):
        warm = iteration < num_warmup
        size = step.current if warm else step.average
        length = (0.5 + torch.rand((), generator=generator).item()) * _TRAJECTORY
        num_steps = min(max(1, math.ceil(length / size.median().item())), _MOST_STEPS)
        # A bit of jitter, for the sake of ergodicity.
        size = size * (0.9 + 0.2 * torch.rand((), generator=generator).item())
        stretch = (size[:, None, None] * root).unsqueeze(0)

        momentum = normal()
        energy = value + 0.5 * momentum.square().sum(-1)
        x, v = position, momentum - 0.5 * _times(stretch.mT, gradient)
        for inner in range(num_steps):
            x = x + _times(stretch, v)
            f, g = potential(x)
            v = v - (0.5 if inner == num_steps - 1 else 1.0) * _times(stretch.mT, g)
        change = energy - f - 0.5 * v.square().sum(-1)
        rate = _rate(change, value)
        position, value, gradient = move(uniform() < rate, x, f, g)
        if mean is not None:
            # A step to anywhere under the Gaussian, which may lead to another mode.
            white = normal() * _INFLATION
            x = mean + _times(root, white)
            f, g = potential(x)
            away = (position - mean).unsqueeze(-1)
            here = torch.linalg.solve_triangular(root, away, upper=False).squeeze(-1)
            log_ratio = value - f + 0.5 * ((white.square() - here.square()).sum(-1) / _INFLATION**2)
            position, value, gradient = move(uniform() < _rate(log_ratio, value), x, f, g)
        if warm:
            history.append(position)
            step.update(rate.mean(0))
            if iteration + 1 in updates:
                recent = torch.cat(history[len(history) // 2 :])
                mean, root = recent.mean(0), _root(recent)
                step = _DualAveraging(start.new_full((problems,), 0.5))
        else:
            kept.append(position)
            values.append(value)
            accepted += rate.mean(0) / num_iterations
        progress()
    return Draws(torch.stack(kept), torch.stack(values), accepted)


def _rate(log_ratio: Tensor, value: Tensor) -> Tensor:
    """Acceptance rates from their logarithms, which are NaN or infinite where a potential is.

    From where the potential is infinite any step is taken to where it is not, or a chain that
    starts there would stand still.
    """
    escapes = value.isinf() & (log_ratio == math.inf)
    rate = log_ratio.nan_to_num(-math.inf, -math.inf, -math.inf).clamp_max(0).exp()
    return rate.masked_fill(escapes, 1.0)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _root(positions: Tensor) -> Tensor:
    """Cholesky factors ``B x p x p`` of the regularised covariance of ``k x B x p`` positions."""
    k, _, p = positions.shape
    centred = positions - positions.mean(0)
    covariance = torch.einsum("kbi,kbj->bij", centred, centred) / (k - 1)
    weight = k / (k + 5.0 * p)
    variance = covariance.diagonal(dim1=-1, dim2=-2)
    small = (1 - weight) * variance.clamp_min(1e-6)
    return torch.linalg.cholesky(weight * covariance + torch.diag_embed(small))


class _DualAveraging:
    """Step sizes ``B`` adapted to an acceptance rate (Hoffman and Gelman 2014, sec. 3.2)."""

    def __init__(self, start: Tensor) -> None:
        self._centre = (10 * start).log()
        self._error = torch.zeros_like(start)
        self._log_average = torch.zeros_like(start)
        self._count = 0
        self.current = start

    def update(self, rate: Tensor) -> None:
        """Take the acceptance rates of an iteration into account."""
        self._count += 1
        shrinkage, weight, eta = 0.05, 1 / (self._count + 10), self._count**-0.75
        self._error = (1 - weight) * self._error + weight * (_TARGET - rate)
        log_step = self._centre - math.sqrt(self._count) / shrinkage * self._error
        self._log_average = eta * log_step + (1 - eta) * self._log_average
        self.current = log_step.exp().clamp(1e-4, 2.0)

    @property
    def average(self) -> Tensor:
        """The step sizes to go on with."""
        return self._log_average.exp().clamp(1e-4, 2.0) if self._count else self.current
