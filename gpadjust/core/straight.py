"""Unknown parameters of a physics in coordinates in which their ridges are straight."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust.core.sample import GROUPS, WIDER, Normal, lower_root

if TYPE_CHECKING:
    from gpadjust.core.model import GP, Slopes
    from gpadjust.core.unknowns import Values

_STEP = 0.02  # of differences, in standard deviations of the posterior
_BROYDEN = 10  # steps to a solution by derivatives that follow from earlier steps
_NEWTON = 20  # further steps, by those at the point
_REACH = 3.0  # standard deviations of the start, beyond the root of the number of parameters
_KEPT = 10_000  # solved points, at most, from which others begin
_SOLVED = 1e-5  # standard deviations that a solution may be away
_MISSED = 1e-3  # standard deviations beyond which a solution is another one


class Straight:
    r"""Coordinates s of u, N x B x P, in which ridges of parameters of a physics are straight.

    Around a mode :math:`u_0`, with the Jacobian J there of the mean f(u) of the targets, and their
    covariance K, parameters have

    .. math:: s = u_0 + (J^T K^{-1} J + I)^{-1} [J^T K^{-1} (f(u) - f(u_0)) + u - u_0],

    and other coordinates are themselves. By s the posterior is normal but for the curvature of the
    surface f(u), which is mostly small, however curved ridges are by u (Bates and Watts 1980; the
    map of randomize-then-optimize, Bardsley et al. 2014). A call returns the log density by s over
    N(s | 0, I), for :func:`sample`, without a gradient: :meth:`linear` has one. Unless it is alone,
    other draws are those of parameters that a normal distribution hardly reaches from the mode.
    """

    def __init__(self, model: GP, start: Normal, choice: int, is_alone: bool = True) -> None:
        self.model = model
        self.choice = choice
        self.mode = start.mean  # u_0, of Laplace's approximation
        p = len(model.table.shared)
        self.values = model.table.values(model.table.with_choice(self.mode.unsqueeze(0), choice))
        self.f, slopes = model.physics_with_slopes(self.values, True)
        self.slopes = {name: [y.nan_to_num() for y in ys] for name, ys in slopes.items()}
        # White coordinates w of the parameters: u = u_0 + R w.
        self.root = lower_root(start.root[0, -p:])
        mode = self.mode.new_zeros(1, p)
        self.mean = self._mean(mode)
        # By w: R^T J^T K^-1 and R^T R.
        J = self._mean_slopes(mode)[0].nan_to_num().mT  # p x m n
        self.by = model.precision_times(self.mode.expand(p, 1, -1), J)
        self.within = self.root.mT @ self.root
        self.inverse = torch.linalg.inv(self.by @ J.mT + self.within)
        # Points that are solved, t, w and (dt / dw)^-1: the mode is the first.
        self.solved = [mode, mode, torch.eye(p).to(mode).unsqueeze(0)]
        half = torch.linalg.cholesky(0.5 * (self.inverse + self.inverse.mT))
        parameters = WIDER * lower_root(self.root @ half)
        root = torch.block_diag(lower_root(start.root[0, :-p]), parameters)
        self.start = Normal(self.mode, root.unsqueeze(0))
        self.reach = math.inf
        if not is_alone:
            self.reach = math.sqrt(p) + _REACH

    def __call__(self, s: Tensor, with_gradient: bool = False) -> tuple[Tensor, Tensor]:
        """Return log densities at s over N(s | 0, I), ``N x B``, and zeros for their gradients."""
        w, is_solved = self._solution(s)
        u = self._at(w, s)
        slopes = self._slopes(w)
        log_det = torch.linalg.slogdet(slopes).logabsdet
        holds = is_solved & log_det.isfinite() & ~self._is_far(s)
        log_det = log_det.masked_fill(~holds, math.inf)
        new = (self._white(s)[holds], w[holds], torch.linalg.inv_ex(slopes[holds]).inverse)
        both = zip(self.solved, new, strict=True)
        self.solved = [torch.cat(pair)[-_KEPT:] for pair in both]
        # log p(u) + log |du / ds| - log N(s | 0, I)
        value, slope = self.model.log_likelihood(u, False, choice=self.choice)
        return value + 0.5 * (s.square() - u.square()).sum(-1) - log_det.unsqueeze(-1), slope

    def linear(self, s: Tensor, with_gradient: bool = True) -> tuple[Tensor, Tensor]:
        """Return log densities and gradients for the linear part of f_p, by which s = u."""
        density = self.model.log_likelihood
        return density(s, with_gradient, choice=self.choice, physics=self._linear_physics)

    def coordinates(self, s: Tensor) -> Tensor:
        """Return u at s, ``N x B x P``."""
        return self._at(self._solution(s)[0], s)

    def points(self, number: int, seed: int) -> Tensor:
        """Return ``number x B x P`` even draws from N(0, I), by Sobol in groups.

        Each is in the order of the widest combination of parameters, by which systematically
        resampled draws are then even, too.
        """
        p, dimension = self.root.shape[-1], self.mode.shape[-1]
        axis = torch.linalg.svd(self.start.root[0, -p:, -p:]).Vh[0]
        groups = []
        for g in range(GROUPS):
            engine = SobolEngine(dimension, scramble=True, seed=GROUPS * seed + g)
            uniform = engine.draw(number // GROUPS, dtype=torch.float64).clamp(1e-9, 1 - 1e-9)
            normal = torch.special.ndtri(uniform).to(self.mode)
            groups.append(normal[(normal[:, -p:] @ axis).argsort()])
        return torch.cat(groups).unsqueeze(1)

    def misses(self, u: Tensor) -> Tensor:
        """Return whether u, ``N x B x P``, are not the coordinates of any s: ``N``.

        They are found from the points that are solved, which before the first call is the mode.
        """
        w = self._white(u)
        s = self._at(self._straight(w), u)
        away = self._white(self.coordinates(s)) - w
        return ~(away.norm(dim=-1) < _MISSED) | self._is_far(s)

    def _is_far(self, s: Tensor) -> Tensor:
        """Return whether parameters at s are beyond the reach of the start: ``N``."""
        p = self.root.shape[-1]
        away = (s[:, 0, -p:] - self.mode[:, -p:]).mT
        root = self.start.root[0, -p:, -p:]
        return torch.linalg.solve_triangular(root, away, upper=False).norm(dim=0) > self.reach

    def _white(self, u: Tensor) -> Tensor:
        """Return white coordinates of the parameters, ``N x p``."""
        p = self.root.shape[-1]
        away = (u[:, 0, -p:] - self.mode[:, -p:]).mT
        return torch.linalg.solve_triangular(self.root, away, upper=False).mT

    def _solution(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return w at s, ``N x p``, and whether the equation t(w) = R^-1 (s - u_0) is solved."""
        goal = self._white(s)
        # From the nearest solved point: w = w_k + B (goal - t_k), with B = (dt / dw)^-1 there.
        near = torch.cdist(goal, self.solved[0]).argmin(-1)
        t, w, B = (part[near] for part in self.solved)
        step = _times(B, goal - t)
        trial = w + step
        error, share = s.new_full((len(s),), math.inf), s.new_ones(len(s))
        left = torch.arange(len(s), device=s.device)
        for i in range(_BROYDEN + _NEWTON):
            if i == _BROYDEN:  # Newton's method begins where Broyden's has led
                trial[left] = w[left]
                error[left], share[left] = math.inf, 1.0
            here = self._straight(trial[left])
            if i < _BROYDEN:
                B[left] = _after_step(B[left], trial[left] - w[left], here - t[left])
            size = (goal[left] - here).norm(dim=-1)
            closer = size < error[left]
            at, back = left[closer], left[~closer]
            w[at] = trial[at]
            t[at] = here[closer]
            error[at] = size[closer]
            # w <- w + share (dt / dw)^-1 (goal - t)
            if i < _BROYDEN:
                step[left] = _times(B[left], goal[left] - t[left])
            else:
                newton, _ = torch.linalg.inv_ex(self._slopes(w[at]))
                step[at] = _times(newton, goal[at] - t[at]).nan_to_num()
            share[at] = (4 * share[at]).clamp_max(1.0)
            share[back] /= 4
            left = left[error[left] > _SOLVED]
            if not len(left):
                break
            trial[left] = w[left] + share[left].unsqueeze(-1) * step[left]
        return w, error <= _SOLVED

    def _straight(self, w: Tensor) -> Tensor:
        """Return t, of which s = u_0 + R t, at ``N x p``."""
        # (R^T (J^T K^-1 J + I) R)^-1 [R^T J^T K^-1 (f - f_0) + R^T R w]
        return ((self._mean(w) - self.mean) @ self.by.mT + w @ self.within) @ self.inverse

    def _slopes(self, w: Tensor) -> Tensor:
        """Return the derivatives dt / dw, ``N x p x p``, at ``N x p``."""
        return self.inverse @ (self.by @ self._mean_slopes(w) + self.within)

    def _linear_physics(self, values: Values, with_slopes: bool) -> tuple[list[Tensor], Slopes]:
        """Return the linear part of f_p around the mode, and its derivatives."""
        f = self.f
        # f_0 + sum_j df / dz_j (z_j - z_0j)
        for name, slopes in self.slopes.items():
            key = f"physics.{name}"
            away = (values[key] - self.values[key]).unsqueeze(-1)
            f = [y + away * slope for y, slope in zip(f, slopes, strict=True)]
        n = len(f[0])
        return f, {k: [y.expand(n, -1, -1) for y in ys] for k, ys in self.slopes.items()}

    def _mean(self, w: Tensor) -> Tensor:
        """Return f at ``N x p``, as ``N x m n``."""
        return self.model.prior_mean(self._at(w, self.mode.expand(len(w), 1, -1)))

    def _mean_slopes(self, w: Tensor) -> Tensor:
        """Return the derivatives of f at ``N x p``, ``N x m n x p``, by central differences."""
        steps = _STEP * torch.eye(w.shape[-1]).to(w).unsqueeze(1)
        f = self._mean(torch.cat([w + steps, w - steps]).flatten(0, 1))
        above, below = f.unflatten(0, (2, w.shape[-1], len(w)))
        return ((above - below) / (2 * _STEP)).movedim(0, -1)

    def _at(self, w: Tensor, other: Tensor) -> Tensor:
        """Return u at ``N x p``, with other coordinates than parameters of ``N x B x P``."""
        p = w.shape[-1]
        parameters = self.mode[..., -p:] + (w @ self.root.mT).unsqueeze(1)  # u_0 + R w
        return torch.cat([other[..., :-p], parameters], -1)


def _after_step(B: Tensor, dw: Tensor, dt: Tensor) -> Tensor:
    """Return ``N x p x p`` inverse derivatives after a step, ``N x p``, by Broyden's first method.

    They are the nearest ones by which the step dt of t takes the step dw (Broyden 1965).
    """
    # B + (dw - B dt) dw^T B / (dw^T B dt)
    by_w = (dw.unsqueeze(1) @ B)[:, 0]
    size = (by_w * dt).sum(-1, keepdim=True)
    change = (dw - _times(B, dt)) / size
    return B + (change.unsqueeze(-1) * by_w.unsqueeze(1)).nan_to_num(0.0, 0.0, 0.0)


def _times(B: Tensor, t: Tensor) -> Tensor:
    """Return products of ``N x p x p`` and ``N x p``."""
    return (B @ t.unsqueeze(-1))[..., 0]
