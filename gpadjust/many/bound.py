"""A lower bound of the evidence of many rows, by inducing points, with its derivatives."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core.gaussian import SumLikelihood, add_noise
from gpadjust.core.terms import WeightedSum

_NUGGET = 1e-8  # of the mean variance of inducing values; sums over rows divide rounding by it
_AT_ONCE = 2**20  # covariances of inducing values with rows to have in memory


def at_points(total: WeightedSum, points: Tensor) -> WeightedSum:
    """Return a sum over all rows at inducing points: row numbers of each output, ``m x M``."""
    m = len(points)
    outputs = torch.arange(m, device=points.device).unsqueeze(-1)

    def select(v: Tensor) -> Tensor:
        return v.expand(*v.shape[:-2], m, v.shape[-1])[..., outputs, points]

    weights = {n: select(w) for n, w in total.weights.items()}
    x = total.x.expand(*total.x.shape[:-3], m, *total.x.shape[-2:])[..., outputs, points, :]
    return WeightedSum(total.terms, total.values, x, select(total.mean), weights)


def split_off(total: WeightedSum, name: str, is_in: bool) -> WeightedSum:
    """Return the term of a name alone, or the sum without it."""
    weights = {n: w for n, w in total.weights.items() if (n == name) is is_in}
    return WeightedSum(total.terms, total.values, total.x, total.mean, weights)


def root_of(inducing: WeightedSum) -> Tensor:
    """Return the Cholesky factor of the covariance of inducing values, NaN if it fails."""
    K = inducing.cross(inducing)
    nugget = _NUGGET * K.diagonal(dim1=-1, dim2=-2).mean(-1, keepdim=True)
    root, info = torch.linalg.cholesky_ex(add_noise(K, nugget))
    return root.masked_fill((info > 0)[..., None, None], math.nan)


def blocks(number: int, root: Tensor) -> Iterator[slice]:
    """Return slices of rows whose covariances with inducing values fit into memory."""
    size = max(1, _AT_ONCE // root[..., 0].numel())
    return (slice(i, min(i + size, number)) for i in range(0, number, size))


class Sums(NamedTuple):
    r"""Sums over all rows of :math:`v_i = L^{-1} k_i`, with weights :math:`w_i`."""

    root: Tensor  # L, S x m x M x M
    square: Tensor  # sum_i w_i v_i v_i^T
    cross: Tensor  # sum_i w_i r_i v_i, S x m x M

    @classmethod
    def over_rows(
        cls, total: WeightedSum, points: Tensor, residual: Tensor, weight: Tensor
    ) -> Sums:
        """Return the sums of residuals and weights ``S x m x n``, without a graph."""
        # Sums of k k^T would be faster, but the nugget divides their rounding errors.
        with torch.no_grad():
            inducing = at_points(total, points)
            root = root_of(inducing)
            square, cross = torch.zeros_like(root), torch.zeros_like(root[..., 0])
            for rows in blocks(residual.shape[-1], root):
                k = inducing.cross(total.of_rows(rows))
                v = torch.linalg.solve_triangular(root, k, upper=False)
                w = weight[..., rows]
                square += (v * w.unsqueeze(-2)) @ v.mT
                cross += (v @ (w * residual[..., rows]).unsqueeze(-1)).squeeze(-1)
        return cls(root, square, cross)


def bound(
    total: WeightedSum, points: Tensor, rest: WeightedSum, residual: Tensor, noise: Tensor,
    observed: Tensor, with_gradient: bool,
) -> SumLikelihood:  # fmt: skip
    r"""Return the evidence lower bound of Titsias (2009), and its derivatives.

    With :math:`\Lambda = I + \sum_i w_i v_i v_i^T`, :math:`c = \sum_i w_i r_i v_i` and weights
    :math:`w_i = 1 / \sigma_i^2`, it is, at the best distribution of the inducing values,

    .. math::
        -\tfrac12 \Big(\sum_i \log \frac{2 \pi}{w_i} + \log |\Lambda| + \sum_i w_i r_i^2
        - c^T \Lambda^{-1} c + \sum_i w_i (k_{ii} - v_i^T v_i)\Big).

    Derivatives by the covariances of a block of rows at a time are pulled back by autograd.
    The inducing points are rows ``m x M`` of the total; the rest is noise to the inducing values.
    Residuals are ``S x m x n``, 0 where a target is not observed, noise variances too (or 1).
    """
    values = {name: v.detach().clone().requires_grad_() for name, v in total.values.items()}
    weights = {n: w.detach().expand(residual.shape).clone() for n, w in total.weights.items()}
    leaves = {f"{n}.weight": w.requires_grad_() for n, w in weights.items()}
    leaf_sum = WeightedSum(total.terms, values, total.x, total.mean.detach(), weights)
    with torch.enable_grad():
        rest_variance = WeightedSum(rest.terms, values, rest.x, rest.mean, rest.weights).variance()
        variance = leaf_sum.variance()
    sigma2 = (noise + rest_variance.detach()).expand(residual.shape)
    weight = observed / sigma2
    root, square, cross = Sums.over_rows(total, points, residual, weight)
    eye = torch.eye(square.shape[-1]).to(square)
    chol, info = torch.linalg.cholesky_ex(eye + square)
    best = torch.cholesky_solve(cross.unsqueeze(-1), chol)  # Lambda^-1 c, S x m x M x 1
    # sum_i log(2 pi / w_i), and log |Lambda|
    size = ((2 * math.pi * sigma2).log() * observed).sum(-1)
    log_det = 2 * chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    # sum_i w_i r_i^2 - c^T Lambda^-1 c, and sum_i w_i (k_ii - v_i^T v_i)
    misfit = (weight * residual.square()).sum(-1) - (cross * best.squeeze(-1)).sum(-1)
    trace = (weight * variance.detach()).sum(-1) - square.diagonal(dim1=-1, dim2=-2).sum(-1)
    value = -0.5 * (size + log_det + misfit + trace)
    value = value.masked_fill(info > 0, -torch.inf)
    if not with_gradient or not value.isfinite().any():
        return SumLikelihood(value, {}, torch.zeros_like(residual), torch.zeros_like(residual))
    # Derivatives by the sums: 2 G = I - Lambda^-1 - Lambda^-1 c c^T Lambda^-1, and Lambda^-1 c.
    by_square = eye - torch.cholesky_inverse(chol) - best @ best.mT
    # By v_i: w_i (2 G v_i + r_i Lambda^-1 c); by k_i = L v_i the same, solved with L^T.
    solved = torch.linalg.solve_triangular(root.mT, torch.cat([by_square, best], -1), upper=True)
    by_weight, by_residual = torch.zeros_like(residual), torch.zeros_like(residual)
    for rows in blocks(residual.shape[-1], root):
        r, w = residual[..., rows], weight[..., rows]
        with torch.enable_grad():
            k = at_points(leaf_sum, points).cross(leaf_sum.of_rows(rows))
        v = torch.linalg.solve_triangular(root, k.detach(), upper=False)
        by_v = solved[..., :-1] @ v
        mean = (best.mT @ v).squeeze(-2)
        quadratic = (k.detach() * by_v).sum(-2) / 2  # v^T G v
        by_weight[..., rows] = quadratic + r * mean
        by_residual[..., rows] = w * (mean - r)
        by_k = w.unsqueeze(-2) * by_v + solved[..., -1:] * (w * r).unsqueeze(-2)
        torch.autograd.backward([k], [by_k])
    by_weight = by_weight - 0.5 * (residual.square() + variance.detach() - sigma2)
    by_noise = -by_weight * weight.square()  # dw / dsigma^2 = -w^2; 0 for a missing target
    # By L, of all rows at once: -L^-T (by v) v^T
    by_root = solved[..., :-1] @ square + solved[..., -1:] * cross.unsqueeze(-2)
    with torch.enable_grad():
        inducing_root = root_of(at_points(leaf_sum, points))
    torch.autograd.backward([inducing_root, variance], [-by_root.tril(), -0.5 * weight])
    if rest_variance.requires_grad:
        rest_variance.backward(by_noise.sum_to_size(rest_variance.shape))
    by = {name: leaf.grad for name, leaf in (values | leaves).items() if leaf.grad is not None}
    return SumLikelihood(value, by, -by_residual, by_noise)
