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
_NEWTON = 20  # steps to a solution
_SOLVED, _FOUND = 1e-5, 1e-3  # standard deviations that it may be away, and another one is away


class Straight:
    r"""Coordinates s of u, N x B x P, in which ridges of parameters of a physics are straight.

    Around a mode :math:`u_0`, with the Jacobian J there of the mean f(u) of the targets, and their
    covariance K, parameters have

    .. math:: s = u_0 + (J^T K^{-1} J + I)^{-1} [J^T K^{-1} (f(u) - f(u_0)) + u - u_0],

    and other coordinates are themselves. By s the posterior is normal but for the curvature of the
    surface f(u), which is mostly small, however curved ridges are by u (Bates and Watts 1980; the
    map of randomize-then-optimize, Bardsley et al. 2014). A call returns the log density by s over
    N(s | 0, I), for :func:`sample`, and its gradient but for that of the determinant.

    Args:
        model: A model whose physics has unknown parameters.
        start: Laplace's approximation at the mode.
        choice: The number of the nested model.
    """

    def __init__(self, model: GP, start: Normal, choice: int) -> None:
        self.model, self.choice, self.mode = model, choice, start.mean
        p = len(model.table.shared)
        # White coordinates w of the parameters: u = u_0 + R w.
        self.root = lower_root(start.root[0, -p:])
        self.mean, slopes = self._mean(self.mode.new_zeros(1, p))
        J = slopes[0].nan_to_num().mT  # p x m n
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
        u, slopes, log_det = self._solution(s)
        value, slope = self.model.log_likelihood(u, with_gradient, choice=self.choice)
        value = value + 0.5 * (s.square() - u.square()).sum(-1) - log_det.unsqueeze(-1)
        p = self.root.shape[-1]
        # du / ds = R (dt / dw)^-1 R^-1, of parameters.
        by_t, _ = torch.linalg.solve_ex(slopes.mT, ((slope - u)[:, 0, -p:] @ self.root)[..., None])
        by_s = torch.linalg.solve_triangular(self.root.mT, by_t[..., 0].mT, upper=True).mT
        own = slope[..., :-p]
        return value, torch.cat([own, by_s.unsqueeze(1).nan_to_num() + s[..., -p:]], -1)

    def coordinates(self, s: Tensor) -> Tensor:
        """Return u at s, ``N x B x P``."""
        return self._solution(s)[0]

    def points(self, number: int, seed: int) -> Tensor:
        """Return ``number x B x P`` draws from N(0, I) that are spread evenly, by Sobol in groups.

        Each group is in the order of the least known combination of parameters, so that draws which
        are resampled systematically are spread evenly by it, too.
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
        """Return which of u, ``N x B x P``, are not the coordinates of any s: ``N``."""
        w = self._white(u)
        s = self._at(self._straight(w)[0], u)
        away = self._white(self.coordinates(s)) - w
        return ~(away.norm(dim=-1) < _FOUND)

    def _white(self, u: Tensor) -> Tensor:
        """Return white coordinates of the parameters, ``N x p``."""
        p = self.root.shape[-1]
        away = (u[:, 0, -p:] - self.mode[:, -p:]).mT
        return torch.linalg.solve_triangular(self.root, away, upper=False).mT

    def _solution(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return u, derivatives dt / dw and log |det|, infinite without a solution, by Newton."""
        N, p = len(s), self.root.shape[-1]
        goal = self._white(s)
        w, trial, step = goal.clone(), goal.clone(), torch.zeros_like(goal)
        slopes = torch.eye(p).to(s).repeat(N, 1, 1)
        error, share = s.new_full((N,), math.inf), s.new_ones(N)
        left = torch.arange(N, device=s.device)
        for _ in range(_NEWTON):
            t, by = self._straight(trial[left])
            away = goal[left] - t
            closer = away.norm(dim=-1) < error[left]
            at, back = left[closer], left[~closer]
            w[at], slopes[at], error[at] = trial[at], by[closer], away[closer].norm(dim=-1)
            whole, _ = torch.linalg.solve_ex(by[closer], away[closer].unsqueeze(-1))
            step[at], share[at] = whole[..., 0].nan_to_num(), (4 * share[at]).clamp_max(1.0)
            share[back] /= 4
            left = left[error[left] > _SOLVED]
            if not len(left):
                break
            trial[left] = w[left] + share[left].unsqueeze(-1) * step[left]
        log_det = torch.linalg.slogdet(slopes).logabsdet
        return self._at(w, s), slopes, log_det.masked_fill(error > _SOLVED, math.inf)

    def _straight(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """Return t, of which s = u_0 + R t, at ``N x p``, and its derivatives ``N x p x p``."""
        f, slopes = self._mean(w)
        t = ((f - self.mean) @ self.by.mT + w @ self.within) @ self.inverse
        return t, self.inverse @ (self.by @ slopes + self.within)

    def _mean(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """Return f at ``N x p``, and its derivatives ``N x m n x p``, by central differences."""
        p = w.shape[-1]
        steps = _STEP * torch.eye(p).to(w).unsqueeze(1)
        moved = torch.cat([w.unsqueeze(0), w + steps, w - steps]).flatten(0, 1)
        u = self._at(moved, self.mode.expand(len(moved), 1, -1))
        f = self.model.prior_mean(u).unflatten(0, (2 * p + 1, len(w)))
        return f[0], ((f[1 : p + 1] - f[p + 1 :]) / (2 * _STEP)).movedim(0, -1)

    def _at(self, w: Tensor, other: Tensor) -> Tensor:
        """Return u at ``N x p``, with other coordinates than parameters of ``N x B x P``."""
        p = w.shape[-1]
        parameters = self.mode[..., -p:] + (w @ self.root.mT).unsqueeze(1)
        return torch.cat([other[..., :-p], parameters], -1)
