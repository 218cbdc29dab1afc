"""Posteriors by formulas and samplers that the library has no part in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor
from torch.quasirandom import SobolEngine

from paper.parameters.laws import Case

_LEVELS = (0.025, 0.975)
_STEP = 1e-4
_NUGGET = 1e-10
_NUMBER = 1024  # particles
_MOVES = 6  # between powers
_LAST_MOVES = 15
_EACH = 24  # draws of z
_WIDER = 3.0
_DEGREES = 4
_AT_ONCE = 8192


class Posterior:
    r"""The joint density of z and hyper-parameters of one of the models, of a case.

    ``y = f_p(x; z) + (\rho(x) - 1) (f_p(x; z) - c) + \delta(x) + \epsilon``, with the priors that
    the library's documentation states, of the logarithms of lengthscales and variances. All
    hyper-parameters h are standard normal by their priors, as z is.

    Args:
        case: The case.
        model: ``"physics"``, ``"free"``, ``"orthogonal"`` or ``"cka"``.
    """

    def __init__(self, case: Case, model: str) -> None:
        self.case, self.model, self.p = case, model, len(case.true)
        self.X, self.y = case.X, case.Y.squeeze(-1)
        self.best = self._best()
        self._f, self._J = self.f(self.best[None])[0], self._slope(self.best[None])[0]
        v = min((self.y - self._f).square().mean(), self.y.var(correction=0)).item()
        self.least_noise = 1e-11 * v
        d = self.X.shape[-1]
        span = self.X.amax(0) - self.X.amin(0)
        lengths = [(math.log(3 * math.sqrt(d) * each), 2.0) for each in span.tolist()]
        rows = [(math.log(1e-3 * v), 4.0)]
        if model != "physics":
            rows += [(math.log(v), 6.0), *lengths]
        if model == "cka":
            guess = case.physics(self.X, case.physics.unknowns.guess).squeeze(-1)
            self._middle, self._spread = guess.mean(), guess.std()
            rows += [(math.log(1e-2), 4.0), *lengths, (0.0, 3.0)]
        self.mean, self.sd = torch.tensor(rows, dtype=torch.float64).T

    def f(self, z: Tensor) -> Tensor:
        """The law at coordinates ``N x p``, ``N x n``."""
        values: Tensor = self.case.physics.or_nan(self.X, self.case.physics.unknowns.at(z))
        return values.squeeze(-1)

    def exact(self, u: Tensor) -> Tensor:
        """The log density ``N`` of (z, h), ``N x (p + q)``."""
        z, h = u.tensor_split([self.p], dim=-1)
        f = self.f(z)
        chol, good = self._factor(h, f, self._slope(z) if self.model == "orthogonal" else None)
        value = _log_normal((self.y - f).where(good[:, None], 0.0), chol)
        value = value.where(good, -math.inf).nan_to_num(-math.inf)
        return value - 0.5 * u.square().sum(-1)

    def marginal(self, h: Tensor) -> Tensor:
        """That without z, which is integrated out, of h, ``N x q``."""
        chol, good = self._at_best(h)
        both = torch.linalg.cholesky(chol @ chol.mT + self._J @ self._J.T)
        value = _log_normal(self.y - self._f + self._J @ self.best, both)
        return value.where(good, -math.inf) - 0.5 * h.square().sum(-1)

    def given(self, h: Tensor) -> tuple[Tensor, Tensor]:
        """Mean, ``N x p``, and factor of the precision of z given h, if the law were linear."""
        chol, _ = self._at_best(h)
        target = self.y - self._f + self._J @ self.best
        columns = torch.cat([self._J, target[:, None]], -1).expand(len(h), -1, -1)
        white = torch.linalg.solve_triangular(chol, columns, upper=False)
        J, r = white[..., :-1], white[..., -1:]
        root = torch.linalg.cholesky(J.mT @ J + torch.eye(self.p).double())
        return torch.cholesky_solve(J.mT @ r, root).squeeze(-1), root

    def _best(self) -> Tensor:
        """Coordinates of the best fit, with noise of its standard deviation."""
        case, unknowns = self.case, self.case.physics.unknowns
        z = SobolEngine(self.p, scramble=True, seed=0).draw(1024, dtype=torch.float64)
        z = torch.special.ndtri(z.clamp(1e-6, 1 - 1e-6))
        square = (self.y - self.f(z)).square().sum(-1).nan_to_num(nan=math.inf)

        def errors(at: Any) -> Any:
            z = torch.from_numpy(at)
            miss = (case.physics(case.X, unknowns.at(z)) - case.Y).flatten() / case.noise
            return torch.cat([miss, z]).numpy()

        found = [least_squares(errors, z[i].numpy()) for i in square.argsort()[:4]]
        return torch.from_numpy(min(found, key=lambda each: each.cost).x)

    def _at_best(self, h: Tensor) -> tuple[Tensor, Tensor]:
        f = self._f.expand(len(h), -1)
        return self._factor(h, f, self._J.expand(len(h), -1, -1))

    def _factor(self, h: Tensor, f: Tensor, slope: Tensor | None) -> tuple[Tensor, Tensor]:
        """Cholesky factors of the observations' covariance, and where there are some."""
        rest = self.mean + self.sd * h
        n, d = len(self.X), self.X.shape[-1]
        noise, one = rest[:, 0].exp(), torch.eye(n).double()
        K = noise[:, None, None] * one
        if self.model != "physics":
            delta = self._rbf(rest[:, 1], rest[:, 2 : 2 + d])
            K = K + (delta if self.model != "orthogonal" else _orthogonal(delta, slope))
        if self.model == "cka":
            rho = self._rbf(rest[:, 2 + d], rest[:, 3 + d : 3 + 2 * d])
            basis = f - (self._middle + self._spread * rest[:, -1:])
            K = K + rho * basis[:, :, None] * basis[:, None, :]
        K = K + _NUGGET * K.diagonal(dim1=1, dim2=2).diag_embed()
        good = f.isfinite().all(-1) & K.isfinite().all(-1).all(-1) & (noise >= self.least_noise)
        chol, info = torch.linalg.cholesky_ex(torch.where(good[:, None, None], K, one))
        good = good & (info == 0)
        return torch.where(good[:, None, None], chol, one), good

    def _rbf(self, log_variance: Tensor, log_length: Tensor) -> Tensor:
        scaled = self.X / log_length.exp().unsqueeze(1)
        square = (scaled[:, :, None] - scaled[:, None]).square().sum(-1)
        return log_variance.exp()[:, None, None] * (-0.5 * square).exp()

    def _slope(self, z: Tensor) -> Tensor:
        moves = _STEP * torch.eye(self.p).double()
        return torch.stack(
            [(self.f(z + move) - self.f(z - move)) / (2 * _STEP) for move in moves], dim=-1
        )


def _log_normal(residual: Tensor, chol: Tensor) -> Tensor:
    """The log density, but for a constant, of residuals ``N x n`` with factors ``N x n x n``."""
    white = torch.linalg.solve_triangular(chol, residual.unsqueeze(-1), upper=False)
    log_det = chol.diagonal(dim1=1, dim2=2).log().sum(-1)
    return -0.5 * white.square().sum((-1, -2)) - log_det


def _orthogonal(K: Tensor, slope: Any) -> Tensor:
    """Plumlee's kernel, with directions ``N x n x p``."""
    G = torch.linalg.qr(slope).Q
    KG = K @ G
    inner = G.mT @ KG
    size = inner.diagonal(dim1=1, dim2=2).mean(-1)[:, None, None]
    inner = inner + 1e-10 * size * torch.eye(inner.shape[-1]).double()
    chol, _ = torch.linalg.cholesky_ex(inner)
    half = torch.linalg.solve_triangular(chol, KG.mT, upper=False)
    return K - half.mT @ half


def sample(posterior: Posterior, seed: int) -> tuple[Tensor, Tensor]:
    """Draws of z, ``N x p``, and their weights, ``N``.

    Sequential Monte Carlo brings h from its prior to its posterior with z integrated out of a
    linear law; particles move by differences of others (ter Braak 2006). To each go draws of z from
    a Student's t distribution that is wider than that of a linear law, and their weights are those
    of the law itself.
    """
    generator = torch.Generator().manual_seed(seed)
    options: Any = {"generator": generator, "dtype": torch.float64}
    h = _annealed(posterior, generator)
    mean, root = posterior.given(h)
    mean, root = (each.repeat_interleave(_EACH, 0) for each in (mean, root))
    h, p = h.repeat_interleave(_EACH, 0), posterior.p
    white = torch.randn(len(h), p + _DEGREES, **options)
    white = white[:, :p] / white[:, p:].square().mean(-1, keepdim=True).sqrt()
    away = torch.linalg.solve_triangular(root.mT, white.unsqueeze(-1), upper=True).squeeze(-1)
    z = mean + _WIDER * away
    log_q = -0.5 * (_DEGREES + p) * torch.log1p(white.square().sum(-1) / _DEGREES)
    log_q = log_q + root.diagonal(dim1=1, dim2=2).log().sum(-1)
    ratio = torch.cat([posterior.exact(part) for part in torch.cat([z, h], -1).split(_AT_ONCE)])
    return z, (ratio - posterior.marginal(h) - log_q).nan_to_num(nan=-math.inf).softmax(0)


def _annealed(posterior: Posterior, generator: torch.Generator) -> Tensor:
    """Draws of h of a linear law, ``N x q``."""
    options: Any = {"generator": generator, "dtype": torch.float64}
    h, power, half = torch.randn(_NUMBER, len(posterior.mean), **options), 0.0, _NUMBER // 2
    q = h.shape[-1]

    def ratio_of(h: Tensor) -> Tensor:
        return posterior.marginal(h) + 0.5 * h.square().sum(-1)

    ratio = ratio_of(h)
    while power < 1:
        low, high = 0.0, 2 * (1 - power)
        for _ in range(30):
            more = min(0.5 * (low + high), 1 - power)
            enough = (more * ratio).softmax(0).square().sum().reciprocal() >= 0.5 * _NUMBER
            low, high = (more, high) if enough else (low, more)
        power = 1.0 if low >= 0.999 * (1 - power) else power + low
        height = (torch.arange(_NUMBER) + torch.rand(1, **options)) / _NUMBER
        rows = torch.searchsorted((low * ratio).softmax(0).cumsum(0), height)
        rows = rows.clamp_max(_NUMBER - 1)[torch.randperm(_NUMBER, generator=generator)]
        h, ratio = h[rows], ratio[rows]
        for _ in range(_LAST_MOVES if power == 1 else _MOVES):
            for own, others in ((slice(0, half), h[half:]), (slice(half, None), h[:half])):
                pair = torch.randint(half, (2, half), generator=generator)
                factor = 2.38 / math.sqrt(2 * q) * (0.1 + 1.1 * torch.rand(half, 1, **options))
                new = h[own] + factor * (others[pair[0]] - others[pair[1]])
                new = new + 1e-3 * torch.randn(half, q, **options)
                found = ratio_of(new)
                gain = power * (found - ratio[own])
                gain = gain + 0.5 * (h[own].square() - new.square()).sum(-1)
                taken = torch.rand(half, **options).log() < gain
                h[own] = torch.where(taken[:, None], new, h[own])
                ratio[own] = torch.where(taken, found, ratio[own])
    return h


def grid(case: Case, numbers: Sequence[int], width: float = 4.5) -> tuple[Tensor, Tensor]:
    """Points ``N x p`` of a grid about the prior, by numbers in each direction; weights ``N``.

    Of the law alone; the noise's variance is integrated out by a sum.
    """
    posterior = Posterior(case, "physics")
    each = [torch.linspace(-width, width, number, dtype=torch.float64) for number in numbers]
    points = torch.cartesian_prod(*each)
    square = torch.cat(
        [(posterior.y - posterior.f(part)).square().sum(-1) for part in points.split(20_000)]
    )
    u = torch.linspace(-5, 5, 401, dtype=torch.float64)
    log_noise = posterior.mean + posterior.sd * u
    u, log_noise = (each[log_noise > math.log(posterior.least_noise)] for each in (u, log_noise))
    known = torch.linspace(*square.log().aminmax(), 2000, dtype=torch.float64)
    exponent = -0.5 * (known[:, None] - log_noise).exp() - 0.5 * len(posterior.y) * log_noise
    value = (exponent - 0.5 * u.square()).logsumexp(-1)
    value = torch.from_numpy(np.interp(square.log().numpy(), known.numpy(), value.numpy()))
    return points, (value - 0.5 * points.square().sum(-1)).softmax(0)


def distance(draws: Tensor, values: Tensor, weights: Tensor) -> float:
    """The largest difference of distribution functions of any parameter, between 0 and 1.

    Args:
        draws: Equally likely draws, ``K x p``.
        values: Draws or points, ``N x p``.
        weights: Theirs, ``N``.
    """
    worst = 0.0
    for own, other in zip(draws.mT, values.mT, strict=True):
        own = own.sort().values
        shares = np.interp(own, *_distribution(other, weights))
        steps = (np.arange(len(own)) + 0.5) / len(own)
        worst = max(worst, float(np.abs(shares - steps).max()))
    return worst


def ends(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Ends of the central 95 % intervals of values ``N x p`` with weights ``N``, ``p`` each."""
    found = []
    for each in values.mT:
        at, below = _distribution(each, weights)
        found.append(np.interp(_LEVELS, below, at))
    low, high = torch.tensor(np.array(found)).mT
    return low, high


def _distribution(values: Tensor, weights: Tensor) -> tuple[Any, Any]:
    """Points of a distribution function that is linear in between, and its values there."""
    at, which = values.unique(return_inverse=True)
    mass = torch.zeros_like(at).index_add(0, which, weights)
    return at.numpy(), (mass.cumsum(0) - 0.5 * mass).numpy()
