"""Variation of a physics' parameters from one stretch of records to another."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gpadjust.records import kalman
from gpadjust.records.kalman import Array, Link

_MEDIAN = 0.05  # of a variation a priori, in standard deviations of a parameter's prior


def variation_of(
    links: Sequence[Link],
    starts: Sequence[tuple[Array, Array]],
    parameters: Array,
    variances: Array,
) -> Tensor:
    r"""Estimate standard deviations of stretches' parameters, ``p``, in those of the priors.

    Links are of each stretch, near the path by all; starts are means and covariances of its first
    state and the parameters, whose estimate by all is ``p``; variances are of noise and process
    noise, ``2 x d``.

    With :math:`\theta_s = \theta + \eta_s` in the coordinates in which priors are standard normal,
    :math:`\eta_s \sim N(0, \operatorname{diag}(v^2))` for stretch s, and the noises of the
    estimate, v is where its posterior density is highest (empirical Bayes for random effects,
    Laird and Ware 1982), with :math:`\log v \sim N(\log 0.05, 1)`, which it is where the stretches
    do not tell.
    """
    precision, pull = _of_each_stretch(links, starts, parameters, variances)
    start = math.log(_MEDIAN)
    log_v = torch.full_like(pull[0], start).requires_grad_()
    search = torch.optim.LBFGS([log_v], max_iter=60, line_search_fn="strong_wolfe")

    def cost() -> Tensor:
        search.zero_grad()
        # -log p(v) - log p(stretches | v)
        prior = 0.5 * (log_v - start).square().sum()
        value = prior - log_evidence(precision, pull, log_v.exp())
        value.backward()
        return value

    search.step(cost)
    return log_v.detach().exp()


def log_evidence(precision: Tensor, pull: Tensor, v: Tensor) -> Tensor:
    r"""Return the log density of all stretches by v, up to a constant.

    The likelihood of stretch s is
    :math:`\exp(h_s^\top \theta_s - \theta_s^\top \Lambda_s \theta_s / 2)`; :math:`\eta_s`, and then
    :math:`\theta \sim N(0, I)`, are integrated out. Precisions :math:`\Lambda_s` are
    ``S x p x p``, pulls :math:`h_s` ``S x p``, standard deviations v of the :math:`\eta_s` ``p``.
    """
    eye = torch.eye(len(v), dtype=v.dtype)
    scaled = precision * v  # Lambda_s V
    h = pull * v  # V h_s
    # I + V Lambda_s V, of the integral over eta_s / v
    root = torch.linalg.cholesky(eye + v.unsqueeze(-1) * scaled)
    shift = torch.cholesky_solve(h.unsqueeze(-1), root).squeeze(-1)
    of_stretches = 0.5 * (h * shift).sum() - root.diagonal(dim1=-2, dim2=-1).log().sum()
    # I + sum_s (Lambda_s - Lambda_s V (I + V Lambda_s V)^-1 V Lambda_s), of the one over theta
    precisions = eye + (precision - scaled @ torch.cholesky_solve(scaled.mT, root)).sum(0)
    pulls = (pull - (scaled @ shift.unsqueeze(-1)).squeeze(-1)).sum(0).unsqueeze(-1)
    root = torch.linalg.cholesky((precisions + precisions.mT) / 2)
    shared = 0.5 * (pulls * torch.cholesky_solve(pulls, root)).sum()
    return of_stretches + shared - root.diagonal().log().sum()


def _of_each_stretch(
    links: Sequence[Link],
    starts: Sequence[tuple[Array, Array]],
    parameters: Array,
    variances: Array,
) -> tuple[Tensor, Tensor]:
    """Return precision and pull of each stretch, smoothed alone near the estimate by all."""
    precisions, pulls = [], []
    for link, (mean, covariance) in zip(links, starts, strict=True):
        d = len(mean) - len(parameters)
        # The prior of the parameters of a stretch is standard normal about those of all.
        start = np.concatenate([mean[:d], parameters]), covariance
        (alone,), _ = kalman.smooth_chain([link], [start], *variances)
        covariance = alone.states.covariances[0, d:, d:]
        # Lambda_s = C^-1 - I, positive but for rounding
        values, vectors = np.linalg.eigh(np.linalg.inv(covariance) - np.eye(len(covariance)))
        precisions.append((vectors * values.clip(0)) @ vectors.T)
        pulls.append(np.linalg.solve(covariance, alone.states.means[0, d:] - parameters))
    return torch.from_numpy(np.stack(precisions)), torch.from_numpy(np.stack(pulls))
