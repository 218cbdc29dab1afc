"""Annealed sampling of many distributions at once, by Hamiltonian moves of particles."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

_HALVINGS = 30  # of an interval of logarithms, for the power at which enough draws count
_LEAST_STEP = 1e-12  # of the power
_LEAST = 0.5  # of the particles, that count after each change of the power
_LEAPS = 5  # of a move, about a quarter of a Gaussian's orbit
_LENGTH = 0.25  # standard deviations in each of them, at first
_JITTER = (0.6, 1.4)  # multiples of that, as orbits have periods
_ACCEPTED = 0.8  # of the moves, by the length that is taken
_FAR = 1e6  # logarithm of a ratio below which it is zero
_LAST = 2  # moves when all is done
_ROUNDS = 50  # of the evidences of all powers, at most
_SAME = 1e-4  # change of their logarithms that ends these


class Density(Protocol):
    """Negative log densities of ``B`` problems, infinite where there is none."""

    def __call__(self, vectors: Tensor) -> Tensor:
        """Values ``k x B`` at vectors ``k x B x p``."""
        ...

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Values ``k x B`` and gradients ``k x B x p``."""
        ...


class Proposal(Protocol):
    """Distributions of ``B`` problems that draws begin with."""

    def sample(self, number: int, generator: torch.Generator) -> Tensor:
        """Draw ``number x B x p``."""
        ...

    def value_and_gradient(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """The negative log density at ``N x B x p``, ``N x B``, and its gradient."""
        ...

    def covariance(self) -> Tensor:
        """Return the covariance of all draws or of a part, ``B x p x p``."""
        ...


class Particles(NamedTuple):
    """Equally likely draws, in two alternating halves that are independent of each other.

    Attributes:
        positions: ``N x B x p``.
        log_ratio: Logarithm of the density over the proposal's there, ``N x B``.
        log_evidence: Logarithm of the integral of the density, ``B``.
        power: Of that ratio, in the density that the particles are of, ``B``: 1 for all of it.
    """

    positions: Tensor
    log_ratio: Tensor
    log_evidence: Tensor
    power: Tensor

    def effective_size(self) -> Tensor:
        """Return the equivalent number of independent draws, ``B``, if the two halves agree.

        Their means are apart by the square root of ``4 / N`` standard deviations, if all count.
        """
        away = self.positions[0::2].mean(0) - self.positions[1::2].mean(0)
        variance = self.positions.var(0).clamp_min(torch.finfo(away.dtype).tiny)
        n = len(self.positions)
        return n / (n * away.square() / (4 * variance)).mean(-1).clamp_min(1.0)


class _State(NamedTuple):
    """Positions of particles, and the negative log densities and gradients there.

    Attributes:
        positions: ``N x B x p``.
        value: ``N x B``, of the density, and ``gradient``.
        first_value: The same of the proposal, and ``first_gradient``.
    """

    positions: Tensor
    value: Tensor
    gradient: Tensor
    first_value: Tensor
    first_gradient: Tensor

    @property
    def log_ratio(self) -> Tensor:
        """The logarithm of the density over the proposal's, ``N x B``."""
        return self.first_value - self.value

    def between(self, power: Tensor) -> tuple[Tensor, Tensor]:
        """The same of the density that is in between, by a power ``B`` of their ratio."""
        share = power.unsqueeze(-1)
        gradient = share * self.gradient + (1 - share) * self.first_gradient
        return power * self.value + (1 - power) * self.first_value, gradient

    def rows(self, rows: Tensor) -> _State:
        """Return the draws of the numbers ``N' x B``."""
        return _State(*(_gathered(part, rows) for part in self))


def sample(
    density: Density,
    proposal: Proposal,
    num_draws: int,
    num_particles: int,
    num_gradients: int,
    generator: torch.Generator,
    enough: Tensor | None = None,
) -> Particles:
    r"""Draw from :math:`\exp(-U)` of each of ``B`` problems.

    Particles are draws from a proposal, weighted by a power of the ratio of both densities, at
    which enough of them count, and resampled. A move of Hamiltonian Monte Carlo then makes them
    draws from that density, and the power goes on, until it is one (sequential Monte Carlo, Del
    Moral et al. 2006). All states that were passed count in the end, by their weights among all
    powers, ``2 N`` draws of them. Two halves go their own ways, so that their difference tells how
    well all is known.

    Args:
        density: The potential U and its gradient; infinite where the density is zero.
        proposal: What to draw from first.
        num_draws: Number of first draws.
        num_particles: Number ``N`` of particles, which is even.
        num_gradients: Number of gradients that may be asked for, by each problem. With fewer than a
            move takes, or before the end, particles are of the density that was reached.
        generator: Source of randomness.
        enough: Log integrals, ``B``, that are of interest: it ends on the way where all are less,
            as far as the particles tell.

    Raises:
        FloatingPointError: If the potential of some problem is infinite at all draws.
    """
    positions = proposal.sample(num_draws, generator)
    log_ratio = proposal.value_and_gradient(positions)[0] - density(positions)
    log_ratio = log_ratio.where(log_ratio.isfinite(), -math.inf)
    if not log_ratio.isfinite().any(0).all():
        raise FloatingPointError("The density is zero at all draws.")
    moves = (num_gradients // num_particles - 1) // _LEAPS
    least = min(num_particles, num_draws / 4)
    start = torch.zeros_like(log_ratio[0])
    power, weights, log_evidence = raised(log_ratio, start, least)
    passed = _Passed([positions], [log_ratio], [start], [start])
    if moves <= 0:
        return passed.particles(power, num_particles, generator)
    root = _root(positions, weights, proposal.covariance())

    def state_at(positions: Tensor) -> _State:
        value, gradient = density.value_and_gradient(positions)
        return _State(positions, value, gradient, *proposal.value_and_gradient(positions))

    state = state_at(_gathered(positions, resampled(weights, num_particles, generator)))
    length, last = torch.full_like(power, _LENGTH), 0
    for _ in range(moves):
        state, accepted = _moved(state, power, root, length, state_at, generator)
        length = length * (accepted - _ACCEPTED).exp()
        passed.add(state.positions, state.log_ratio, power, log_evidence)
        last += bool((power == 1).all())
        if last == _LAST:
            break
        if not last:
            at_most = log_evidence + (1 - power) * state.log_ratio.amax(0)
            if enough is not None and (at_most < enough).all():
                break
            power, weights, more = raised(state.log_ratio, power, _LEAST * num_particles)
            log_evidence = log_evidence + more
            root = _root(state.positions, weights, root @ root.mT)
            state = state.rows(resampled(weights, num_particles, generator))
    return passed.particles(power, 2 * num_particles, generator)


class _Passed(NamedTuple):
    """All states of ``B`` problems on the way, at one power after the other.

    Attributes:
        positions: At each of them, ``N' x B x p``.
        log_ratios: The logarithms of the densities' ratios there, ``N' x B``.
        powers: The powers, ``B``.
        log_evidences: Logarithms of rough integrals of their densities, ``B``.
    """

    positions: list[Tensor]
    log_ratios: list[Tensor]
    powers: list[Tensor]
    log_evidences: list[Tensor]

    def add(self, *state: Tensor) -> None:
        """Add states of the density of a power, in the order of the attributes."""
        for every, one in zip(self, state, strict=True):
            every.append(one)

    def particles(self, power: Tensor, number: int, generator: torch.Generator) -> Particles:
        """Draws of the density of a power, ``B``, from all states that were passed.

        Each state counts by its density over that of the mixture of all states, whose integrals are
        estimated from the same states (Shirts and Chodera 2008).
        """
        log_ratio, positions = torch.cat(self.log_ratios), torch.cat(self.positions)
        counts = log_ratio.new_tensor([float(len(each)) for each in self.log_ratios])
        log_count, powers = counts.log()[:, None, None], torch.stack(self.powers).unsqueeze(1)
        evidence = torch.stack(self.log_evidences).unsqueeze(1)
        is_zero = (log_ratio == -math.inf) & (powers > 0)
        parts = (powers * log_ratio.clamp_min(-_FAR)).masked_fill(is_zero, -math.inf)
        for _ in range(_ROUNDS):  # powers x N x B
            log_mixture = (log_count - evidence + parts).logsumexp(0)
            found = (parts - log_mixture).logsumexp(1, keepdim=True)
            before, evidence = evidence, found - found[:1]
            if (evidence - before).abs().max() < _SAME:
                break
        log_mixture = (log_count - evidence + parts).logsumexp(0)
        log_weights = power * log_ratio - log_mixture
        rows = resampled(log_weights.softmax(0), number, generator)
        log_evidence = log_weights.logsumexp(0) - (-log_mixture).logsumexp(0)
        return Particles(
            _gathered(positions, rows), _gathered(log_ratio, rows), log_evidence, power
        )


def _moved(
    state: _State,
    power: Tensor,
    root: Tensor,
    length: Tensor,
    state_at: Callable[[Tensor], _State],
    generator: torch.Generator,
) -> tuple[_State, Tensor]:
    """A move of Hamiltonian Monte Carlo, and the shares that were accepted, ``B``.

    Args:
        state: Where the particles are.
        power: Of the density that they are of, ``B``.
        root: Of their covariance, ``B x p x p``.
        length: Of a leap, in standard deviations, ``B``.
        state_at: The state at positions.
        generator: Source of randomness.
    """
    shape, device = state.positions.shape, state.positions.device
    options: Any = {"generator": generator, "dtype": root.dtype}
    momentum = torch.randn(shape, **options).to(device)
    least, most = _JITTER
    leap = length * (least + (most - least) * torch.rand(shape[:-1], **options).to(device))
    leap = leap.unsqueeze(-1)

    def pull(gradient: Tensor) -> Tensor:
        return (root.mT @ gradient.unsqueeze(-1)).squeeze(-1)

    value, gradient = state.between(power)
    energy, new = value + 0.5 * momentum.square().sum(-1), state
    momentum = momentum - 0.5 * leap * pull(gradient)
    for i in range(_LEAPS):
        away = (root @ momentum.unsqueeze(-1)).squeeze(-1)
        new = state_at(new.positions + leap * away)
        value, gradient = new.between(power)
        momentum = momentum - (0.5 if i + 1 == _LEAPS else 1.0) * leap * pull(gradient)
    chance = (energy - value - 0.5 * momentum.square().sum(-1)).exp().clamp_max(1.0)
    chance = chance.nan_to_num(nan=0.0)
    taken = torch.rand(shape[:-1], **options).to(device) < chance
    pairs = zip(new, state, strict=True)
    parts = [torch.where(taken if a.dim() == 2 else taken.unsqueeze(-1), a, b) for a, b in pairs]
    return _State(*parts), chance.mean(0)


def raised(log_ratio: Tensor, power: Tensor, least: float) -> tuple[Tensor, Tensor, Tensor]:
    """The highest power, ``B``, at which so many draws count.

    With their weights, ``N x B``, and the logarithms of the means of these before they sum to one.
    """
    low, high = torch.full_like(power, _LEAST_STEP).minimum(1 - power), 1 - power

    def log_weights(more: Tensor) -> Tensor:
        return (more * log_ratio).where(log_ratio > -math.inf, -math.inf)

    more = high
    for _ in range(_HALVINGS):
        size = log_weights(more).softmax(0).square().sum(0).reciprocal()
        low, high = more.where(size >= least, low), high.where(size >= least, more)
        more = (low * high).sqrt()
    reached = torch.where(low < 1 - power, power + low, torch.ones_like(power))
    found = log_weights(low)
    return reached, found.softmax(0), found.logsumexp(0) - math.log(len(found))


def resampled(weights: Tensor, number: int, generator: torch.Generator) -> Tensor:
    """Numbers of rows by their weights ``N x B``, ``number x B``, systematic in each half.

    The number is even. For a half without any weight the rows are those of the other.
    """
    halves, is_odd = [], torch.arange(len(weights), device=weights.device).unsqueeze(-1) % 2
    for i in range(2):
        own = weights * (is_odd == i)
        part = own.where(own.sum(0) > 0, weights).cumsum(0)
        first = torch.rand(1, part.shape[1], generator=generator, dtype=part.dtype).to(part)
        steps = torch.arange(number // 2, device=part.device).unsqueeze(-1)
        height = (steps + first) / (number // 2) * part[-1]
        rows = torch.searchsorted(part.mT.contiguous(), height.mT.contiguous()).mT
        halves.append(rows.clamp_max(len(part) - 1))
    return torch.stack(halves, dim=1).flatten(0, 1)


def _gathered(values: Tensor, rows: Tensor) -> Tensor:
    """Return the values ``N x B x ...`` at the numbers ``N' x B``."""
    return values[rows, torch.arange(rows.shape[-1], device=rows.device)]


def _root(positions: Tensor, weights: Tensor, first: Tensor) -> Tensor:
    """A root of the covariance of weighted draws, or of a first one as far as they are few."""
    p = positions.shape[-1]
    away = positions - (weights.unsqueeze(-1) * positions).sum(0)
    covariance = torch.einsum("kb,kbi,kbj->bij", weights, away, away)
    size = weights.square().sum(0).reciprocal()
    share = (size / (size + p))[:, None, None]
    return torch.linalg.cholesky(share * covariance + (1 - share) * first)
