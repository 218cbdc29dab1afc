"""Draws of coordinates from the prior N(0, I) to the posterior, and their most likely values."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from scipy.optimize import minimize
from torch import Tensor

from gpadjust.core.unknowns import standard_normal

LogLikelihood = Callable[..., tuple[Tensor, Tensor]]
"""Of coordinates ``N x B x P`` and ``with_gradient``: values ``N x B`` of problems, and slopes."""

GROUPS = 2  # of draws that are resampled apart; their difference is the error
_SHARE = 0.5  # of the resulting draws, that count after each step of the power
_MOVES, _LAST_MOVES = 3, 4  # of each draw after a step of the power, and after the last step
_LEAPS, _GUIDED_LEAPS = 3, 6  # steps of the Hamiltonian dynamics in a move
_FIRST_LENGTH = 0.3  # of these steps, in standard deviations of the draws
_ACCEPTED = 0.8  # share of moves that the length is adapted to
_FAR = 60.0  # coordinates, prior standard deviations, beyond which no draw moves
_SEARCHES = 3  # of a precise search, at most, each from the end of the last
_GAIN = 0.01  # log density, of all searches together, below which there is no further one
WIDER = 1.5  # standard deviations of a start, in those of Laplace's approximation
_STEP = 0.1  # of differences for the Hessian, in standard deviations of the prior or posterior
_PASSES = 3  # over the Hessian, each with steps by the last
_REFINED = 10  # of a precise one, at most
_SETTLED = 0.05  # change of the log evidence below which it is precise


class Normal(NamedTuple):
    """Normal distributions of ``B`` problems."""

    mean: Tensor  # B x P
    root: Tensor  # a lower root of the covariances, B x P x P

    def log_density(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return log densities ``N x B`` at ``N x B x P``, and their gradients."""
        # log N(u | m, L L^T) = -|w|^2 / 2 - log |L| - P log(2 pi) / 2, w = L^-1 (u - m)
        white = torch.linalg.solve_triangular(self.root, (u - self.mean).unsqueeze(-1), upper=False)
        log_det = self.root.diagonal(dim1=-1, dim2=-2).log().sum(-1)
        size = log_det + 0.5 * u.shape[-1] * math.log(2 * math.pi)
        slope = torch.linalg.solve_triangular(self.root.mT, white, upper=True).squeeze(-1)
        return -0.5 * white.square().sum((-1, -2)) - size, -slope


class Draws(NamedTuple):
    """Equally likely draws from a posterior; the two halves are resampled apart."""

    u: Tensor  # N x B x P
    log_evidence: Tensor  # of each half, 2 x B


@torch.no_grad()
def sample(
    log_likelihood: LogLikelihood, like: Tensor, number: int, seed: int,
    start: Normal | None = None, first: int = 16, with_moves: bool = True,
    points: Tensor | None = None, guide: LogLikelihood | None = None,
) -> Draws:  # fmt: skip
    r"""Draw from :math:`N(u | 0, I) \, L(u)` by sequential Monte Carlo (Del Moral et al. 2006).

    Draws of a start, ``first`` times as many as result, are weighted by a power of the ratio of the
    posterior to the start, as large as half of them still count, resampled and moved by Hamiltonian
    Monte Carlo; the power rises until it is 1. They are not moved if more of them count than
    result. The evidence is zero if L is, at all draws of a group.

    Args:
        log_likelihood: L of ``B`` problems.
        like: A tensor ``B x P``, for shape and device.
        number: Number of draws, an even one.
        seed: Seed.
        start: The start. Default: the prior.
        first: How many draws begin for each one that results.
        with_moves: Whether draws are moved; without, they are weighted and resampled once.
        points: Draws of the start from N(0, I), if not random ones, ``(first number) x B x P``.
        guide: A cheaper likelihood, whose gradient leads the moves; L itself decides on their ends
            (Neal 2011, section 5.5.4).
    """
    shape = like.shape
    generator = torch.Generator().manual_seed(seed)
    eye = torch.eye(shape[1]).to(like).expand(shape[0], -1, -1)
    prior = Normal(torch.zeros_like(like), eye)
    begin = prior if start is None else start

    def ratio(
        u: Tensor, with_gradient: bool = True, of: LogLikelihood = log_likelihood
    ) -> tuple[Tensor, Tensor]:
        value, slope = of(u, with_gradient)
        if start is None:
            return value, slope
        # log L(u) + log N(u | 0, I) - log q(u)
        a, by_a = prior.log_density(u)
        b, by_b = start.log_density(u)
        return value + a - b, slope + by_a - by_b

    guided = guide and partial(ratio, of=guide)
    if points is None:
        points = standard_normal((first * number, *shape), generator, like)
    u = begin.mean + (begin.root @ points.unsqueeze(-1)).squeeze(-1)
    value, slope = ratio(u, False)
    power = like.new_zeros(shape[0])
    evidence = like.new_zeros(GROUPS, shape[0])
    possible = int(value.isfinite().reshape(GROUPS, -1, shape[0]).sum(1).min())
    if not possible:
        return Draws(u[:number], evidence - math.inf)
    # Draws that count, at least; in the first step no more than have a likelihood.
    least = min(_SHARE * number, possible) if with_moves else 0.0
    length = torch.full_like(power, _FIRST_LENGTH)
    problems = torch.arange(shape[0], device=like.device)
    is_first = True
    while True:
        # The highest power at which enough draws count.
        step = _step(value, power, least)
        logs = (step * value).nan_to_num(nan=-math.inf)
        halves = logs.reshape(GROUPS, -1, shape[0])
        # The evidence is the product of the mean weights.
        evidence = evidence + halves.logsumexp(1) - math.log(halves.shape[1])
        power = power + step
        weights = logs.softmax(0)
        if is_first and start is not None:
            effective = weights.square().sum(0).reciprocal()  # number of draws that count
            with_moves = with_moves and bool((effective < number).any())
        # Resample, and move.
        root = _root(u, weights, start)
        chosen = _resampled(halves, number // GROUPS, generator)
        u, value, slope = (part[chosen, problems] for part in (u, value, slope))
        if not with_moves:
            return Draws(u, evidence)
        if is_first:
            if guided is None:
                value, slope = ratio(u)
            else:
                slope = guided(u)[1]
            is_first = False
            least = _SHARE * number
        is_done = bool((power >= 1).all())
        for _ in range(_LAST_MOVES if is_done else _MOVES):
            here = (u, value, slope)
            u, value, slope, rate = _move(
                ratio, guided, begin, here, power, root, length, generator
            )
            length = length * (rate - _ACCEPTED).exp()
        if is_done:
            return Draws(u, evidence)


def _move(
    ratio: LogLikelihood, guided: LogLikelihood | None, begin: Normal,
    here: tuple[Tensor, Tensor, Tensor], power: Tensor, root: Tensor, length: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Move draws of begin x ratio^power, their values and slopes; return them and acceptance.

    The slopes are those of ``guided``, if there is one.

    Hamiltonian dynamics have momenta N(0, I) in coordinates in which ``root`` makes draws white.
    """
    u, value, slope = here
    t = power.unsqueeze(-1)

    def force(slope: Tensor, prior_slope: Tensor) -> Tensor:
        return (root.mT @ (t * slope + prior_slope).unsqueeze(-1)).squeeze(-1)

    p = standard_normal(u.shape, generator, u)
    jitter = torch.rand(u.shape[:-1], generator=generator, dtype=u.dtype).to(u)
    leap = (length * (0.6 + 0.8 * jitter)).unsqueeze(-1)
    prior, by_prior = begin.log_density(u)
    # Minus the energy: log density - |p|^2 / 2.
    energy = power * value + prior - 0.5 * p.square().sum(-1)
    new, new_value, new_slope = here
    # Leapfrog steps: half a step of p, steps of u and p by turns, and half a step of p.
    p = p + 0.5 * leap * force(slope, by_prior)
    leaps = _LEAPS if guided is None else _GUIDED_LEAPS
    for i in range(leaps):
        new = (new + leap * (root @ p.unsqueeze(-1)).squeeze(-1)).clamp(-_FAR, _FAR)
        new_value, new_slope = (guided or ratio)(new)
        prior, by_prior = begin.log_density(new)
        share = 0.5 if i + 1 == leaps else 1.0
        p = p + share * leap * force(new_slope, by_prior)
    if guided is not None:
        new_value, _ = ratio(new, False)
    after = power * new_value + prior - 0.5 * p.square().sum(-1)
    chance = (after - energy).exp().nan_to_num(nan=0.0).clamp_max(1.0)
    taken = torch.rand(chance.shape, generator=generator, dtype=u.dtype).to(u) < chance
    u = torch.where(taken.unsqueeze(-1), new, u)
    slope = torch.where(taken.unsqueeze(-1), new_slope, slope)
    return u, torch.where(taken, new_value, value), slope, chance.mean(0)


def _step(value: Tensor, power: Tensor, least: float) -> Tensor:
    """Return the largest steps of the power, ``B``, after which enough draws count."""

    def counts(step: Tensor) -> Tensor:
        # 1 / sum_i w_i^2, the effective number (Kong 1992)
        weights = (step * value).nan_to_num(nan=-math.inf).softmax(0)
        return weights.square().sum(0).reciprocal()

    left = high = 1 - power
    if bool((counts(left) >= least).all()):
        return left
    low = torch.where(counts(left) >= least, left, torch.zeros_like(left))
    middle = 0.1 * high
    for _ in range(40):  # bisection of the logarithm
        is_enough = counts(middle) >= least
        low = torch.where(is_enough, middle, low).maximum(low)
        high = torch.where(is_enough, high, middle)
        middle = torch.where(low > 0, (low * high).sqrt(), 0.1 * high).minimum(left)
    return low.where(low > 0, high).minimum(left)


def _resampled(logs: Tensor, number: int, generator: torch.Generator) -> Tensor:
    """Return numbers of draws ``(G number) x B``, systematic in each of the groups of weights."""
    groups, size, problems = logs.shape
    weights = logs.softmax(1)
    offset = torch.rand(groups, 1, problems, generator=generator, dtype=logs.dtype).to(logs)
    steps = torch.arange(number).to(logs).reshape(1, -1, 1)
    heights = ((steps + offset) / number).movedim(1, -1).contiguous()
    total = weights.cumsum(1).movedim(1, -1).contiguous()
    drawn = torch.searchsorted(total, heights).clamp_max(size - 1).movedim(-1, 1)
    shift = size * torch.arange(groups, device=logs.device).reshape(-1, 1, 1)
    return (drawn + shift).reshape(-1, problems)


def _root(u: Tensor, weights: Tensor, start: Normal | None) -> Tensor:
    """Return a root of covariances of few draws, shrunk to Laplace's or to their diagonals."""
    away = u - (weights.unsqueeze(-1) * u).sum(0)
    covariance = torch.einsum("nb,nbi,nbj->bij", weights, away, away)
    size = weights.square().sum(0).reciprocal()
    share = (size / (size + u.shape[-1]))[:, None, None]
    diagonal = covariance.diagonal(dim1=-1, dim2=-2).clamp_min(1e-12)
    few = torch.diag_embed(diagonal)
    if start is not None:
        expected = start.root / WIDER
        few = expected @ expected.mT
    total = share * covariance + (1 - share) * few
    root, info = torch.linalg.cholesky_ex(total)
    if info.any():  # by rounding errors, as some draws are far narrower than others are wide
        size = total.diagonal(dim1=-1, dim2=-2).sqrt().unsqueeze(-1)
        eye = 1e-9 * torch.eye(u.shape[-1]).to(u)
        root = size * torch.linalg.cholesky(total / (size * size.mT) + eye)
    return root


@torch.no_grad()
def maximise(
    log_likelihood: LogLikelihood, u: Tensor, is_precise: bool = False, most: int = 2_000
) -> Tensor:
    """Return coordinates ``N x B x P`` of high density N(u | 0, I) L(u), by L-BFGS from each of N.

    A precise search begins again where it ended, as long as that improves the density: a line
    search may fail for one problem alone. A search takes ``most`` iterations at most.
    """
    best = u.clone()
    top = u.new_full(u.shape[:2], -math.inf)

    def negative(flat: object) -> tuple[float, object]:
        point = torch.as_tensor(flat).to(u).reshape(u.shape)
        value, slope = log_likelihood(point)
        density = value - 0.5 * point.square().sum(-1)
        is_better = density > top
        top[is_better] = density[is_better]
        best[is_better] = point[is_better]
        density = density.nan_to_num(neginf=-1e10)
        return -float(density.sum()), (point - slope).nan_to_num().flatten().cpu().numpy()

    options: dict[str, float] = {"maxiter": most}
    searches = _SEARCHES
    if not is_precise:
        searches = 1
        options["ftol"] = 1e-5
    for _ in range(searches):
        before = float(top.nan_to_num(neginf=-1e10).sum())
        start = best.flatten().cpu().numpy()
        minimize(negative, start, jac=True, method="L-BFGS-B", options=options)
        if float(top.sum()) < before + _GAIN:
            break
    return best


@torch.no_grad()
def around_mode(
    log_likelihood: LogLikelihood, mode: Tensor, is_precise: bool = False
) -> tuple[Normal, Tensor]:
    """Return Laplace's approximation at a mode ``B x P``, made wider, and the log evidence by it.

    The Hessian is by central differences of the gradient, along coordinates that have an influence,
    with steps of a tenth of a standard deviation of the prior, or of the posterior if that is less.
    A precise one is refined along the axes of the posterior, of which one may be a million times
    longer than another; the mode by Newton's steps.
    """
    p = mode.shape[-1]
    here = mode.unsqueeze(0)
    _, at_random = log_likelihood(here + 0.1)
    moved = (at_random[0] != 0).any(0).nonzero().flatten()
    hessian = mode.new_zeros(len(mode), p, p)
    for _ in range(_PASSES):
        step = _STEP * (1 + hessian.diagonal(dim1=-1, dim2=-2).abs()).rsqrt()  # B x P
        moves = torch.diag_embed(step)[:, moved].movedim(0, 1)
        value, slope = log_likelihood(torch.cat([here, mode + moves, mode - moves]))
        up, down = slope[1:].chunk(2)
        rows = (down - up).movedim(0, -2) / (2 * step[:, moved].unsqueeze(-1))
        hessian[:, moved.unsqueeze(-1), moved] = rows.nan_to_num()[..., moved]
    root = _whitening(hessian, torch.eye(p).to(mode).expand_as(hessian), is_precise)
    # log Z = log L(mode) - |mode|^2 / 2 + log |root|
    evidence = value[0] - 0.5 * mode.square().sum(-1) + torch.linalg.slogdet(root).logabsdet
    if is_precise:
        mode, root, evidence = _refined(log_likelihood, mode, root, evidence)
    return Normal(mode, lower_root(WIDER * root)), evidence


def _refined(
    log_likelihood: LogLikelihood, mode: Tensor, root: Tensor, evidence: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a better mode, a better root of the covariance, and the log evidence by these."""
    eye = torch.eye(mode.shape[-1]).to(mode)
    moves = _STEP * eye.unsqueeze(1).expand(-1, len(mode), -1)  # along the axes of the posterior
    here = torch.zeros_like(mode).unsqueeze(0)
    for _ in range(_REFINED):
        before = evidence
        step = maximise(partial(white_density, log_likelihood, mode, root), here, True)[0]
        mode = mode + (root @ step.unsqueeze(-1))[..., 0]
        white = partial(white_density, log_likelihood, mode, root)
        value, slope = white(torch.cat([here, moves, -moves]))
        up, down = (slope[1:] - torch.cat([moves, -moves])).chunk(2)
        rows = (down - up).nan_to_num().movedim(0, -2) / (2 * _STEP)
        root = _whitening(rows - root.mT @ root, root, is_precise=True)
        evidence = value[0] + torch.linalg.slogdet(root).logabsdet
        if ((evidence - before).abs() < _SETTLED).all():
            break
    return mode, root, evidence


def lower_root(root: Tensor) -> Tensor:
    """Return the lower root, with a positive diagonal, of the matrix that has another root."""
    lower = torch.linalg.qr(root.mT).R.mT  # by QR, as their product may lose all digits
    return lower * lower.diagonal(dim1=-1, dim2=-2).sign().unsqueeze(-2)


def white_density(
    log_likelihood: LogLikelihood, mode: Tensor, root: Tensor, v: Tensor, with_gradient: bool = True
) -> tuple[Tensor, Tensor]:
    """Return the log density at u = mode + root v over N(v | 0, I), and its gradient by v."""
    u = mode + (root @ v.unsqueeze(-1)).squeeze(-1)
    value, slope = log_likelihood(u, with_gradient)
    value = value - 0.5 * u.square().sum(-1) + 0.5 * v.square().sum(-1)
    return value, (root.mT @ (slope - u).unsqueeze(-1)).squeeze(-1) + v


def _whitening(hessian: Tensor, root: Tensor, is_precise: bool) -> Tensor:
    """Return a root of the posterior's covariance, by the Hessian of minus the log likelihood.

    This is by coordinates along the columns of another root. Negative curvature counts as zero; in
    a precise search, where it is an error of too long steps, as positive.
    """
    values, vectors = torch.linalg.eigh(0.5 * (hessian + hessian.mT))
    values = values.abs() if is_precise else values.clamp_min(0.0)
    # H + R^T R, the precision with that of the prior
    precision = (vectors * values.unsqueeze(-2)) @ vectors.mT + root.mT @ root
    values, vectors = torch.linalg.eigh(precision)
    return root @ (vectors * values.maximum(1e-14 * values[..., -1:]).rsqrt().unsqueeze(-2))
