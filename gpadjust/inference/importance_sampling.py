"""Adaptive importance sampling of many distributions at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

# Maps positions k x B x p to potentials k x B, negative log densities up to a constant.
Potential = Callable[[Tensor], Tensor]

_DEGREES = 5  # of freedom: tails that are wider than those of what is sampled, as a rule
_BANDWIDTH = 0.7  # of the kernels, in standard deviations of the draws so far
_KERNELS = 32
_A_ROUND = 256  # draws from one proposal
_LEAST_COUNTED = 64  # draws, or a quarter of fewer
_HALVINGS = 20  # of an interval, for the power at which they are so many


class Draws(NamedTuple):
    """Weighted draws.

    Attributes:
        positions: ``N x B x p``.
        weights: ``N x B``, which sum to one.
        power: What the importance weights were raised to, ``B``.
    """

    positions: Tensor
    weights: Tensor
    power: Tensor

    def resampled(self, number: int, generator: torch.Generator) -> Tensor:
        """Equally likely draws, ``number x B x p``, in their order: systematic resampling."""
        count, problems, p = self.positions.shape
        first = torch.rand(1, problems, generator=generator, dtype=self.weights.dtype)
        height = (torch.arange(number).unsqueeze(-1) + first).to(self.weights) / number
        total = self.weights.cumsum(0)
        rows = torch.searchsorted(total.mT.contiguous(), height.mT.contiguous()).mT
        rows = rows.clamp_max(count - 1)
        return self.positions.gather(0, rows.unsqueeze(-1).expand(-1, -1, p))


class Mixture(NamedTuple):
    """Mixtures of Student's t distributions of one shape, to draw from.

    Attributes:
        centres: ``k x B x p``.
        weights: ``k x B``, which sum to one.
        root: Of the shape, lower triangular, ``B x p x p``.
    """

    centres: Tensor
    weights: Tensor
    root: Tensor

    def sample(self, number: int, generator: torch.Generator) -> Tensor:
        """Draw ``number x B x p``."""
        problems, p = self.centres.shape[1:]
        which = torch.multinomial(
            self.weights.mT.cpu(), number, replacement=True, generator=generator
        ).mT.to(self.centres.device)
        shape = (number, problems, p + _DEGREES)
        normal = torch.randn(shape, generator=generator, dtype=self.root.dtype).to(self.root)
        white = normal[..., :p] / normal[..., p:].square().mean(-1, keepdim=True).sqrt()
        away = (self.root @ white.unsqueeze(-1)).squeeze(-1)
        return self.centres.gather(0, which.unsqueeze(-1).expand(-1, -1, p)) + away

    def log_density(self, positions: Tensor) -> Tensor:
        """At ``N x B x p``, up to a constant that all mixtures share: ``N x B``."""

        def whitened(vectors: Tensor) -> Tensor:
            columns = vectors.permute(1, 2, 0)
            return torch.linalg.solve_triangular(self.root, columns, upper=False).mT

        p = positions.shape[-1]
        square = torch.cdist(whitened(positions), whitened(self.centres)).square()  # B x N x k
        log_kernel = -0.5 * (_DEGREES + p) * torch.log1p(square / _DEGREES)
        log_size = self.root.diagonal(dim1=-1, dim2=-2).abs().log().sum(-1)
        return (log_kernel + self.weights.log().mT.unsqueeze(-2)).logsumexp(-1).mT - log_size


def sample(
    potential: Potential, proposal: Mixture, num_draws: int, generator: torch.Generator
) -> Draws:
    r"""Draw from :math:`\exp(-U)` of each of ``B`` problems, in rounds.

    The first round draws from the proposal that is given, each further one from a kernel estimate
    of the weighted draws so far. All are weighted as draws from the mixture of all proposals
    (adaptive multiple importance sampling, Cornuet et al. 2012). Where few draws would have all the
    weight, weights are raised to a power below one, at which 64 of them count (as the inverse sum
    of squares tells): in many dimensions what is drawn from is then followed more than the density.

    Args:
        potential: The potential U; infinite where the density is zero.
        proposal: What to draw from first. Its first centre is among the draws.
        num_draws: Their number ``N``.
        generator: Source of randomness.

    Raises:
        FloatingPointError: If the potential of some problem is infinite at all draws of a round.
    """
    num_rounds = max(1, num_draws // _A_ROUND)
    sizes = [num_draws // num_rounds + (i < num_draws % num_rounds) for i in range(num_rounds)]
    positions = proposal.sample(sizes[0], generator)
    positions[0] = proposal.centres[0]
    values, proposals = potential(positions), [proposal]
    draws = _weighted(positions, -values - proposal.log_density(positions))
    for size in sizes[1:]:
        proposals.append(_kernel_estimate(draws, proposal.root, generator))
        new = proposals[-1].sample(size, generator)
        positions, values = torch.cat([positions, new]), torch.cat([values, potential(new)])
        log_q = torch.stack([q.log_density(positions) for q in proposals])
        log_shares = torch.tensor(sizes[: len(proposals)]).to(log_q).log()
        draws = _weighted(positions, -values - (log_q + log_shares[:, None, None]).logsumexp(0))
    return draws


def _weighted(positions: Tensor, log_weights: Tensor) -> Draws:
    """Draws with weights, tempered as far as few would have them all."""
    if not log_weights.isfinite().any(0).all():
        raise FloatingPointError("The density is zero at all draws.")
    least = min(_LEAST_COUNTED, len(positions) // 4)
    counted = log_weights.isfinite()
    log_weights = log_weights - log_weights.amax(0)

    def weights(power: Tensor) -> Tensor:
        return (power * log_weights).where(counted, -math.inf).softmax(0)

    low, high = torch.zeros_like(log_weights[0]), torch.ones_like(log_weights[0])
    power = high
    for _ in range(_HALVINGS):
        enough = weights(power).square().sum(0).reciprocal() >= least
        low, high = power.where(enough, low), high.where(enough, power)
        power = 0.5 * (low + high)
    return Draws(positions, weights(high), high)


def _kernel_estimate(draws: Draws, root: Tensor, generator: torch.Generator) -> Mixture:
    """Kernels at some of the draws, of the shape of all; of a given one as far as they are few."""
    positions, weights = draws.positions, draws.weights
    p = positions.shape[-1]
    away = positions - (weights.unsqueeze(-1) * positions).sum(0)
    covariance = torch.einsum("kb,kbi,kbj->bij", weights, away, away)
    size = weights.square().sum(0).reciprocal()
    share = (size / (size + p))[:, None, None]
    covariance = share * covariance + (1 - share) * (root @ root.mT)
    centres = draws.resampled(_KERNELS, generator)
    shape = torch.linalg.cholesky(covariance) * _BANDWIDTH
    return Mixture(centres, torch.full_like(centres[..., 0], 1 / _KERNELS), shape)
