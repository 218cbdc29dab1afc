"""Shares of function and noise in the residuals of a sparse model."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import chdtri
from torch import Tensor

from gpadjust.gp.gaussian import negative_log_likelihood, threads_for
from gpadjust.gp.kernels import RBF, Stationary

_BLOCKS = 64  # places where neighbours are compared
_NEIGHBOURS = 256
_LEAST = 8  # neighbours that tell anything
_LENGTHS = (0.02, 50.0)  # lengthscales, in standard deviations of the inputs
_CHANCE = 1e-3  # of finding structure where there is none, at most
_LEAST_SHARE = 1e-6  # of the residuals' variance


class Unexplained(NamedTuple):
    """The two parts of a sparse model's residuals.

    Attributes:
        variance: That of what varies with the inputs, ``(m)``; 0 where there is none to be seen.
        lengthscales: Those over which it varies, ``(m) x 1 x d``.
        noise: The variance of the rest, ``(m)``.
    """

    variance: Tensor
    lengthscales: Tensor
    noise: Tensor


@torch.no_grad()
def unexplained(inputs: Tensor, residuals: Tensor, known: Tensor | None, seed: int) -> Unexplained:
    r"""Split residuals into a smooth part and noise, by the likelihood of groups of neighbours.

    Few inducing points leave structure in the residuals, which is noise to a sparse model. Close
    observations share it, but not the noise. The residuals of each of some groups of neighbours
    are :math:`N(0, v k + \sigma^2 I)` with an RBF kernel k of one lengthscale for each input; v is
    kept if a test of likelihoods finds it, with a chance of a thousandth where there is none (Wilks
    1938): over lengths that hold next to no neighbours it looks as noise does, and must not take
    its place.

    Args:
        inputs: ``n x d``.
        residuals: ``(m) x n``; NaN where there is none.
        known: Known noise variances, ``(m) x n``, or None if they are to be found.
        seed: Seed of the places.
    """
    batch, n = residuals.shape[:-1], residuals.shape[-1]
    rows = residuals.reshape(-1, n)
    noises = [None] * len(rows) if known is None else known.expand_as(residuals).reshape(-1, n)
    with threads_for(_NEIGHBOURS):
        found = [_of_one(inputs, r, noise, seed) for r, noise in zip(rows, noises, strict=True)]
    variance, lengths, noise = (torch.stack(each) for each in zip(*found, strict=True))
    return Unexplained(
        variance.reshape(batch), lengths.reshape(*batch, 1, -1), noise.reshape(batch)
    )


def _of_one(
    inputs: Tensor, residuals: Tensor, known: Tensor | None, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    seen, d = ~residuals.isnan(), inputs.shape[-1]
    inputs, residuals = inputs[seen], residuals[seen]
    known = None if known is None else known[seen]
    spread = inputs.std(0)
    spread = spread.where(spread > 0, torch.ones_like(spread))
    size = residuals.square().mean()
    whole = size if known is None else known.mean()
    k = min(_NEIGHBOURS, len(inputs) // 4)
    if k < _LEAST or not size > 0:
        return torch.zeros_like(size), spread, whole
    z = inputs / spread
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randperm(len(z), generator=generator)[: min(_BLOCKS, len(z) // k)].to(z.device)
    nearest = torch.cdist(z[centers], z).topk(k, largest=False).indices
    x, r = z[nearest], residuals[nearest] / size.sqrt()
    x = x - x.mean(-2, keepdim=True)
    own = None if known is None else known[nearest] / size

    def objective(vector: np.ndarray) -> tuple[float, np.ndarray]:
        """The negative log likelihood of a residual, of logarithms of lengths, v and noise."""
        p = torch.as_tensor(vector).to(x).exp()
        noise = p[d + 1].expand_as(r) if own is None else own
        pairs = Stationary(p[:d].unsqueeze(0), p[d], RBF).pairs(x)
        covariance = pairs.covariance + torch.diag_embed(noise)
        found = negative_log_likelihood(r, covariance, derivatives=True)
        assert found.by_covariance is not None
        by_length, by_variance, _ = pairs.pull_back(found.by_covariance, None)
        by_noise = found.by_covariance.diagonal(dim1=-1, dim2=-2).sum() * p[-1]
        parts = [by_length.sum(0), by_variance.sum(0, True), by_noise.unsqueeze(0)]
        gradient = torch.cat(parts)[: len(p)] / r.numel()
        return float(found.value.sum()) / r.numel(), gradient.cpu().numpy()

    tiny, most = math.log(_LEAST_SHARE), math.log(4.0)
    bounds = [tuple(map(math.log, _LENGTHS))] * d + [(tiny, most)] * (1 if known is not None else 2)
    starts = [[math.log(length)] * d + [math.log(0.3), math.log(0.7)] for length in (0.5, 2.0)]
    starts = [start[: len(bounds)] for start in starts]
    runs = [minimize(objective, s, jac=True, method="L-BFGS-B", bounds=bounds) for s in starts]
    best = min(runs, key=lambda run: float(run.fun))
    alone = r.square().mean().expand_as(r) if own is None else own
    without = 0.5 * (r.square() / alone + (2 * math.pi * alone).log()).mean()
    if 2 * (float(without) - float(best.fun)) * r.numel() <= chdtri(d + 1, _CHANCE):
        return torch.zeros_like(size), spread, whole
    p = torch.as_tensor(best.x).to(x).exp()
    noise = p[d + 1] if own is None else own.mean()
    # Groups that are narrow beside the lengthscales do not tell v, but the residuals' size does.
    variance = p[d].minimum((1 - noise).clamp_min(0.0))
    return size * variance, p[:d] * spread, whole if known is not None else size * noise
