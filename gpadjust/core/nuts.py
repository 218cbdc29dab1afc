"""Draws of all unknown numbers by NUTS, a slow reference for those of the default fit."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gpadjust.core.sample import LogLikelihood, around_mode, white_density

if TYPE_CHECKING:
    from gpadjust.core.model import GP

CHAINS = 4
_DEPTH = 7  # of a trajectory, 128 steps at most


def nuts(model: GP, mode: Tensor, number: int, seed: int) -> tuple[Tensor, float]:
    """Return ``number x B x P`` draws of four chains, one after the other, and the worst R-hat.

    Chains begin with draws from Laplace's approximation at a mode ``B x P``, half as wide again,
    whose coordinates they move in. R-hat is that of halves of the chains (Gelman et al. 2013).

    Raises:
        ImportError: Without Pyro, ``pip install "gpadjust[pyro]"``.
    """
    try:
        from pyro.infer import MCMC, NUTS  # here alone, as it takes a second
        from pyro.ops.stats import split_gelman_rubin
    except ImportError as error:
        raise ImportError('"nuts" needs Pyro; run `pip install "gpadjust[pyro]"`.') from error
    start, _ = around_mode(model.log_likelihood, mode, bool(model.table.shared))
    density = partial(white_density, model.log_likelihood, start.mean, start.root)

    def potential(v: dict[str, Tensor]) -> Tensor:
        return _Potential.apply(v["v"], density)

    chains = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(CHAINS):
            v = torch.randn_like(mode)
            if not density(v.unsqueeze(0), False)[0].isfinite().all():
                v = torch.zeros_like(v)
            kernel = NUTS(potential_fn=potential, full_mass=True, max_tree_depth=_DEPTH)
            size = number // CHAINS
            mcmc = MCMC(
                kernel, size, warmup_steps=size, initial_params={"v": v}, disable_progbar=True
            )
            mcmc.run()
            chains.append(mcmc.get_samples()["v"].detach())
    v = torch.stack(chains)
    u = start.mean + (start.root @ v.unsqueeze(-1)).squeeze(-1)
    used = u.std((0, 1)) > 0
    return u.flatten(0, 1), float(split_gelman_rubin(u, 0, 1)[used].max())


class _Potential(torch.autograd.Function):
    """Minus the log density of coordinates ``B x P``, with its own gradient."""

    @staticmethod
    def forward(ctx: Any, v: Tensor, density: LogLikelihood) -> Tensor:
        """Return the sum of all problems."""
        value, slope = density(v.unsqueeze(0))
        ctx.save_for_backward(v - slope[0])
        return (0.5 * v.square().sum() - value.sum()).nan_to_num(posinf=1e10)

    @staticmethod
    def backward(ctx: Any, *by: Tensor) -> tuple[Tensor, None]:
        """Return the gradient."""
        (slope,) = ctx.saved_tensors
        return by[0] * slope, None
