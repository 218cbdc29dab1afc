"""The rest: the shares of a function and of noise in the residuals of inducing points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from scipy.special import chdtri
from torch import Tensor

from gpadjust.core.gaussian import log_likelihood
from gpadjust.core.kernels import Kernel
from gpadjust.core.sample import maximise
from gpadjust.core.unknowns import Table, Values
from gpadjust.many.conditioning import SparseConditioning

_GROUPS = 64  # places where neighbours are compared
_NEIGHBOURS = 128
_LEAST = 8  # neighbours needed for a comparison
_STARTS = (-1.0, -2.0)  # of searches, coordinates of lengthscales: shorter than the prior median
_CHANCE = 1e-3  # probability of a rest in pure noise, at most
_START = "rest.kernel."  # of the names of the numbers of its kernel


@torch.no_grad()
def rest_of(
    posterior: SparseConditioning, kernel: Kernel, table: Table, begin: Values,
    noise: Callable[[Values], Tensor], seed: int,
) -> tuple[Values, Tensor]:  # fmt: skip
    r"""Return the numbers of rest and noise, and a mask of the outputs with a rest, ``m``.

    Few inducing points leave a function of x in the residuals, which is noise to a sparse model.
    Close rows share this function, but not the noise: the residuals of groups of neighbours are
    :math:`N(0, k + \sigma^2 I)`, with the kernel k. A likelihood ratio test (Wilks 1938) decides
    whether there is a rest, with a thousandth of false alarms: over distances with few neighbours
    a rest looks like noise, and must not replace it. The posterior is that without rest, the table
    that of k and of the noise, whose variances ``noise`` returns; they begin with the whole rest.
    """
    x = posterior.total.x[0, 0]
    n = posterior.num_rows
    m = table.num_outputs
    k = min(_NEIGHBOURS, n // 4)
    if k < _LEAST:
        return {}, x.new_zeros(m, dtype=torch.bool)
    # Groups: the nearest neighbours of random rows, with inputs in standard deviations.
    spread = x.std(0)
    spread = spread.where(spread > 0, torch.ones_like(spread))
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randperm(n, generator=generator)[: min(_GROUPS, n // k)].to(x.device)
    nearest = torch.cdist(x[centers] / spread, x / spread).topk(k, largest=False).indices
    groups = x[nearest].unsqueeze(-3).unsqueeze(-3)

    def of_groups(v: Tensor) -> Tensor:  # G x S x m x k of S x m x n (or 1)
        return v.expand(*v.shape[:-1], n)[..., nearest].movedim(-2, 0)

    # A fit takes the share H of the noise out of a residual: divide by sqrt(1 - H).
    mean, conditional, h = posterior.leverage()
    free = (1 - posterior.weight * h).clamp_min(1e-3)
    residual = (posterior.targets - mean) / free.sqrt()
    size = residual.square().nanmean(-1)[0].unsqueeze(-1).clamp_min(1e-300)  # m x 1
    residual = of_groups(residual)
    observed = ~residual.isnan()
    residual = residual.nan_to_num()

    def log_density(
        u: Tensor, with_gradient: bool = True, share: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Return the log likelihood with a share of the rest, 1 or 0, and its gradient."""
        leaf = u.detach().requires_grad_()
        with torch.set_grad_enabled(with_gradient):
            values = table.values(leaf)
            numbers = {n.removeprefix(_START): v for n, v in values.items() if _START in n}
            K = share * kernel.covariance(numbers, groups)
            variance = of_groups(noise(values)).expand(K.shape[:-1])
        residuals = residual.expand(K.shape[:-1])
        result = log_likelihood(residuals, K, variance, observed, with_gradient)
        if not with_gradient:
            return result.value.sum(0), torch.zeros_like(u)
        by = (result.by_covariance, result.by_covariance.diagonal(dim1=-1, dim2=-2))
        parts = [(v, d) for v, d in zip((K, variance), by, strict=True) if v.requires_grad]
        tensors, slopes = zip(*parts, strict=True)
        (slope,) = torch.autograd.grad(tensors, leaf, slopes, materialize_grads=True)
        return result.value.sum(0), slope

    # The best of several searches with a rest, and the one without.
    starts = []
    for start in _STARTS:
        values = {name: 0.7 * value for name, value in begin.items()}
        values[f"{_START}outputscale"] = 0.3 * size
        u = size.new_full((1, table.problems, table.size), start)
        starts.append(table.with_values(u, values))
    ends = maximise(log_density, torch.cat(starts))
    density = log_density(ends, False)[0]
    best = ends[density.argmax(0), torch.arange(m)].unsqueeze(0)
    without_rest = partial(log_density, share=0.0)
    noise_alone = maximise(without_rest, table.with_values(0 * starts[0], begin))
    # 2 log of the likelihood ratio is chi-squared with as many degrees as k has numbers.
    statistic = 2 * (density.amax(0) - without_rest(noise_alone, False)[0][0])
    degrees = sum(r.location.shape[-1] for r in table.own if r.name not in begin)
    # Groups determine the noise; the rest is what noise and predicted variances leave of all.
    values = table.values(best)
    other = (conditional + noise(values)).mean(-1, keepdim=True)
    if f"{_START}outputscale" in values:
        values[f"{_START}outputscale"] = (size - other).maximum(1e-9 * size)
    return values, statistic > chdtri(degrees, _CHANCE)
