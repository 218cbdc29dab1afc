"""Unknown parameters of a physics in coordinates in which their ridges are straight."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust.core.sample import GROUPS, WIDER, Normal, lower_root

if TYPE_CHECKING:
    from gpadjust.core.model import GP

_STEP = 0.02  # of differences, in standard deviations of the posterior
_CHORD = 10  # steps to a solution with the derivatives at the mode, which cost nothing
_NEWTON = 20  # further steps, with those at the point
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
    N(s | 0, I), for :func:`sample`, and its gradient but for that of the determinant.
    """

    def __init__(self, model: GP, start: Normal, choice: int) -> None:
        self.model = model
        self.choice = choice
        self.mode = start.mean  # u_0, of Laplace's approximation
        p = len(model.table.shared)
        # White coordinates w of the parameters: u = u_0 + R w.
        self.root = lower_root(start.root[0, -p:])
        mode = self.mode.new_zeros(1, p)
        self.mean = self._mean(mode)
        # By w: R^T J^T K^-1 and R^T R.
        J = self._mean_slopes(mode)[0].nan_to_num().mT  # p x m n
        self.by = model.precision_times(self.mode.expand(p, 1, -1), J)
        self.within = self.root.mT @ self.root
        self.inverse = torch.linalg.inv(self.by @ J.mT + self.within)
        half = torch.linalg.cholesky(0.5 * (self.inverse + self.inverse.mT))
        parameters = WIDER * lower_root(self.root @ half)
        root = torch.block_diag(lower_root(start.root[0, :-p]), parameters)
        self.start = Normal(self.mode, root.unsqueeze(0))

    def __call__(self, u: Tensor, with_gradient: bool = True) -> tuple[Tensor, Tensor]:
        """Return log densities at s, here named u, over N(s | 0, I), ``N x B``, and gradients."""
        s = u
        w, is_solved = self._solution(s)
        u = self._at(w, s)
        slopes = self._slopes(w).nan_to_num()
        # log p(u) + log |du / ds| - log N(s | 0, I)
        log_det = torch.linalg.slogdet(slopes).logabsdet.masked_fill(~is_solved, math.inf)
        value, slope = self.model.log_likelihood(u, with_gradient, choice=self.choice)
        value = value + 0.5 * (s.square() - u.square()).sum(-1) - log_det.unsqueeze(-1)
        p = self.root.shape[-1]
        # du / ds = R (dt / dw)^-1 R^-1, of parameters.
        by_t, _ = torch.linalg.solve_ex(slopes.mT, ((slope - u)[:, 0, -p:] @ self.root)[..., None])
        by_s = torch.linalg.solve_triangular(self.root.mT, by_t[..., 0].mT, upper=True).mT
        by_s = by_s.unsqueeze(1).nan_to_num() + s[..., -p:]
        return value, torch.cat([slope[..., :-p], by_s], -1)

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
        """Return whether u, ``N x B x P``, are not the coordinates of any s: ``N``."""
        w = self._white(u)
        s = self._at(self._straight(w), u)
        away = self._white(self.coordinates(s)) - w
        return ~(away.norm(dim=-1) < _MISSED)

    def _white(self, u: Tensor) -> Tensor:
        """Return white coordinates of the parameters, ``N x p``."""
        p = self.root.shape[-1]
        away = (u[:, 0, -p:] - self.mode[:, -p:]).mT
        return torch.linalg.solve_triangular(self.root, away, upper=False).mT

    def _solution(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return w at s, ``N x p``, and whether the equation t(w) = R^-1 (s - u_0) is solved."""
        goal = self._white(s)
        w, trial, step = goal.clone(), goal.clone(), torch.zeros_like(goal)
        error, share = s.new_full((len(s),), math.inf), s.new_ones(len(s))
        left = torch.arange(len(s), device=s.device)
        for i in range(_CHORD + _NEWTON):
            if i == _CHORD:  # Newton's method begins where the chords have led
                trial[left] = w[left]
                error[left], share[left] = math.inf, 1.0
            away = goal[left] - self._straight(trial[left])
            closer = away.norm(dim=-1) < error[left]
            at, back = left[closer], left[~closer]
            w[at] = trial[at]
            error[at] = away[closer].norm(dim=-1)
            # w <- w + share (dt / dw)^-1 (goal - t), where dt / dw = I at the mode.
            step[at] = away[closer]
            if i >= _CHORD:
                newton, _ = torch.linalg.solve_ex(self._slopes(w[at]), step[at].unsqueeze(-1))
                step[at] = newton[..., 0].nan_to_num()
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
