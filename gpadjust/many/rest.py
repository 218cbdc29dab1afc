"""What inducing points cannot show: shares of a function and of noise in the residuals."""

from __future__ import annotations

from collections.abc import Callable

import torch
from scipy.special import chdtri
from torch import Tensor

from gpadjust.core.gaussian import log_likelihood
from gpadjust.core.kernels import Kernel
from gpadjust.core.sample import maximise
from gpadjust.core.unknowns import Table, Values
from gpadjust.many.conditioning import SparseConditioning

_GROUPS, _NEIGHBOURS = 64, 128  # places where neighbours are compared
_LEAST = 8  # neighbours that show anything
_STARTS = (-1.0, -2.0)  # of searches, coordinates of lengthscales: shorter than the usual ones
_CHANCE = 1e-3  # of finding a rest where there is none, at most


@torch.no_grad()
def rest_of(
    posterior: SparseConditioning, kernel: Kernel, table: Table, begin: Values,
    noise: Callable[[Values], Tensor], seed: int,
) -> tuple[Values, Tensor]:  # fmt: skip
    r"""Return numbers of the rest and of the noise, and in which outputs there is a rest, ``m``.

    Few inducing points leave a function of x in the residuals, which is noise to a sparse model.
    Close rows share it, but not the noise. The residuals of groups of neighbours are
    :math:`N(0, k + \sigma^2 I)`, with the kernel k. It is kept if a test of likelihoods
    finds it (Wilks 1938), with a chance of a thousandth where there is none: over distances that
    contain next to no neighbours it looks as noise does, and must not take its place.

    Args:
        posterior: The posterior without rest.
        kernel: k, of the term ``rest``.
        table: The table of their unknown numbers.
        begin: The numbers of the noise that contains the rest.
        noise: Returns the variances of the noise, ``S x m x n`` (or 1), by its numbers.
        seed: Seed of the places.
    """
    x, n, m = posterior.total.x[0, 0], posterior.num_rows, table.num_outputs
    k = min(_NEIGHBOURS, n // 4)
    if k < _LEAST:
        return {}, x.new_zeros(m, dtype=torch.bool)
    spread = x.std(0)
    spread = spread.where(spread > 0, torch.ones_like(spread))
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randperm(n, generator=generator)[: min(_GROUPS, n // k)].to(x.device)
    nearest = torch.cdist(x[centers] / spread, x / spread).topk(k, largest=False).indices
    groups = x[nearest].unsqueeze(-3).unsqueeze(-3)

    def of_groups(v: Tensor) -> Tensor:
        """Return ``G x S x m x k`` of values ``S x m x n`` (or 1)."""
        return v.expand(*v.shape[:-1], n)[..., nearest].movedim(-2, 0)

    mean, unseen, own = posterior.leverage()
    kept = (1 - posterior.weight * own).clamp_min(1e-3)  # of the noise is in the residuals
    residual = (posterior.targets - mean) / kept.sqrt()
    size = residual.square().nanmean(-1)[0].unsqueeze(-1).clamp_min(1e-300)  # m x 1
    residual = of_groups(residual)
    observed, residual = ~residual.isnan(), residual.nan_to_num()

    def likelihood(has_rest: bool) -> Callable[..., tuple[Tensor, Tensor]]:
        def log_density(u: Tensor, with_gradient: bool = True) -> tuple[Tensor, Tensor]:
            leaf = u.detach().requires_grad_()
            with torch.set_grad_enabled(with_gradient):
                values = table.values(leaf)
                K = kernel.covariance(_of_kernel(values), groups)
                K = K if has_rest else 0 * K
                variance = of_groups(noise(values)).expand(K.shape[:-1])
            residuals = residual.expand(K.shape[:-1])
            found = log_likelihood(residuals, K, variance, observed, with_gradient)
            if not with_gradient:
                return found.value.sum(0), torch.zeros_like(u)
            by = (found.by_covariance, found.by_covariance.diagonal(dim1=-1, dim2=-2))
            parts = [(v, d) for v, d in zip((K, variance), by, strict=True) if v.requires_grad]
            tensors, slopes = zip(*parts, strict=True)
            (slope,) = torch.autograd.grad(tensors, leaf, slopes, materialize_grads=True)
            return found.value.sum(0), slope

        return log_density

    begins = []
    for start in _STARTS:
        values = {name: 0.7 * value for name, value in begin.items()}
        values["rest.kernel.outputscale"] = 0.3 * size
        u = size.new_full((1, table.problems, table.size), start)
        begins.append(table.with_values(u, values))
    with_rest, without = likelihood(True), likelihood(False)
    ends = maximise(with_rest, torch.cat(begins))
    density = with_rest(ends, False)[0]
    best = ends[density.argmax(0), torch.arange(m)].unsqueeze(0)
    plain = table.with_values(0 * begins[0], begin)
    alone = without(maximise(without, plain), False)[0]
    gain = 2 * (density.amax(0) - alone[0])
    values = table.values(best)
    number = sum(r.location.shape[-1] for r in table.own if r.name not in begin)
    # Groups show the noise; its variance and those that are predicted make up the residuals'.
    other = (unseen + noise(values)).mean(-1, keepdim=True)
    if "rest.kernel.outputscale" in values:
        values["rest.kernel.outputscale"] = (size - other).maximum(1e-9 * size)
    return values, gain > chdtri(number, _CHANCE)


def _of_kernel(values: Values) -> Values:
    start = "rest.kernel."
    return {n.removeprefix(start): v for n, v in values.items() if n.startswith(start)}
