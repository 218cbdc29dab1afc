"""Draws of all unknown numbers by NUTS, a slow reference for those of the default fit."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gpadjust.core.sample import LogLikelihood, lower_root, white_density

if TYPE_CHECKING:
    from gpadjust.core.model import GP

CHAINS = 4
_DEPTH = 5  # of a trajectory, 32 steps at most
_WARMING = 2  # resulting draws of a chain for each step before, which adapts
_JUMPS = 32  # proposals after each trajectory
_WIDTH, _TAIL = 0.5, 3  # of proposals around a draw, Student's t: scale and degrees of freedom
_FROM_PRIOR = 0.1  # share of proposals, so that densities are bounded by those of proposals


def nuts(model: GP, draws: Tensor, number: int, seed: int) -> tuple[Tensor, float]:
    """Return ``number x B x P`` draws of four chains, one after the other, and the worst R-hat.

    Chains move in coordinates in which draws of the default fit, ``N x B x P``, are white. After
    each trajectory of NUTS come jumps: Metropolis steps whose proposals are points around these
    draws and, after warm-up, those of all chains, or from the prior (an independence sampler,
    Tierney 1994). R-hat compares halves of the chains (Gelman et al. 2013).
    """
    try:
        from pyro.infer import NUTS  # here alone, as it takes a second
        from pyro.ops.stats import split_gelman_rubin
    except ImportError as error:
        raise ImportError('"nuts" needs Pyro; run `pip install "gpadjust[pyro]"`.') from error
    jumps, size = _Jumps(model, draws), number // CHAINS
    warm = size // _WARMING

    def potential(v: dict[str, Tensor]) -> Tensor:
        return _Potential.apply(v["v"], jumps.density)

    def chain(kernel: NUTS, v: Tensor, steps: int) -> Tensor:
        """Return the states after each of some steps."""
        states = []
        for _ in range(steps):
            v = jumps.moved(kernel.sample({"v": v})["v"].detach())
            kernel.clear_cache()
            states.append(v)
        return torch.stack(states)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        kernels = []
        for _ in range(CHAINS):
            kernel = NUTS(potential_fn=potential, full_mass=True, max_tree_depth=_DEPTH)
            kernel.initial_params = {"v": jumps.start()}
            kernel.setup(warm)
            kernels.append(kernel)
        warmed = [chain(kernel, kernel.initial_params["v"], warm) for kernel in kernels]
        jumps.add(torch.cat(warmed))
        chains = [chain(kernel, v[-1], size) for kernel, v in zip(kernels, warmed, strict=True)]
    u = jumps.coordinates(torch.stack(chains))
    used = u.std((0, 1)) > 0
    return u.flatten(0, 1), float(split_gelman_rubin(u, 0, 1)[used].max())


class _Jumps:
    """Proposals around draws ``N x B x P`` or from the prior, in coordinates v of white draws."""

    def __init__(self, model: GP, draws: Tensor) -> None:
        away = (draws - draws.mean(0)).movedim(0, -1) / math.sqrt(len(draws) - 1)  # B x P x N
        floor = 1e-6 * torch.eye(draws.shape[-1]).to(draws).expand(len(away), -1, -1)
        self.mean, self.root = draws.mean(0), lower_root(torch.cat([away, floor], -1))
        self.density = partial(white_density, model.log_likelihood, self.mean, self.root)
        self.draws = self._white(draws)

    def add(self, v: Tensor) -> None:
        """Add as many other draws, evenly, to those of the proposals."""
        every = max(1, len(v) // len(self.draws))
        self.draws = torch.cat([self.draws, v[::every]])

    def coordinates(self, v: Tensor) -> Tensor:
        """Return u = mean + root v, ``... x B x P``."""
        return self.mean + (self.root @ v.unsqueeze(-1)).squeeze(-1)

    def proposed(self) -> Tensor:
        """Return proposals v, ``J x B x P``."""
        z = torch.randn(_JUMPS, *self.mean.shape, dtype=self.mean.dtype).to(self.mean)
        size = torch.randn(_JUMPS, 1, 1, _TAIL).square().mean(-1).sqrt().to(z)
        near = self.draws[torch.randint(len(self.draws), (_JUMPS,))] + _WIDTH * z / size
        is_prior = torch.rand(_JUMPS, 1, 1).to(z) < _FROM_PRIOR
        return torch.where(is_prior, self._white(z), near)

    def start(self) -> Tensor:
        """Return the first possible proposal, ``B x P``."""
        v = self.proposed()
        first = self.log_ratio(v).isfinite().to(torch.int8).argmax(0)
        return v.take_along_dim(first[None, :, None], 0)[0]

    @torch.no_grad()
    def log_ratio(self, v: Tensor) -> Tensor:
        """Return the log density less that of the proposals at v, ``N x B``, but for a constant."""
        # q(v) = (1 - a) mean_i t(v; v_i, h^2 I) + a N(u; 0, I) |root|, times (2 pi)^(P / 2).
        p, total = v.shape[-1], _TAIL + v.shape[-1]
        distances = torch.cdist(v.movedim(1, 0), self.draws.movedim(1, 0)).movedim(0, 1)
        near = -0.5 * total * ((distances / _WIDTH).square() / _TAIL).log1p()
        size = math.lgamma(total / 2) - math.lgamma(_TAIL / 2) - 0.5 * p * math.log(_TAIL / 2)
        size = size - p * math.log(_WIDTH) - math.log(len(self.draws) / (1 - _FROM_PRIOR))
        log_det = self.root.diagonal(dim1=-1, dim2=-2).log().sum(-1) + math.log(_FROM_PRIOR)
        prior = log_det - 0.5 * self.coordinates(v).square().sum(-1)
        value = self.density(v, False)[0] - 0.5 * v.square().sum(-1)
        return (value - torch.logaddexp(near.logsumexp(-1) + size, prior)).nan_to_num(nan=-math.inf)

    def moved(self, v: Tensor) -> Tensor:
        """Return v ``B x P`` after Metropolis steps."""
        others = self.proposed()
        here, *ratios = self.log_ratio(torch.cat([v.unsqueeze(0), others]))
        for other, ratio in zip(others, ratios, strict=True):
            # Accepted with the probability p(v') q(v) / (p(v) q(v')).
            taken = torch.rand(len(v)).to(v) < (ratio - here).exp()
            v = torch.where(taken.unsqueeze(-1), other, v)
            here = torch.where(taken, ratio, here)
        return v

    def _white(self, u: Tensor) -> Tensor:
        """Return v at u, ``N x B x P``."""
        away = (u - self.mean).unsqueeze(-1)
        return torch.linalg.solve_triangular(self.root, away, upper=False).squeeze(-1)


class _Potential(torch.autograd.Function):
    """Minus the log density of coordinates ``B x P``, with its own gradient."""

    @staticmethod
    def forward(ctx: Any, v: Tensor, density: LogLikelihood) -> Tensor:
        """Return the sum of all problems."""
        value, slope = density(v.unsqueeze(0))
        ctx.save_for_backward(v - slope[0])
        # -log L(v) - log N(v | 0, I)
        return (0.5 * v.square().sum() - value.sum()).nan_to_num(posinf=1e10)

    @staticmethod
    def backward(ctx: Any, *by: Tensor) -> tuple[Tensor, None]:
        """Return the gradient."""
        (slope,) = ctx.saved_tensors
        return by[0] * slope, None
