"""By how much the parameters of a machine differ from one stretch of its records to the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.records.chain import Chain, Path
from gpadjust.records.kalman import Array, smooth_chain
from gpadjust.records.smoothing import Estimate

_MEDIAN = 0.05  # of a variation beforehand, in standard deviations of a parameter's prior
_SPREAD = 1.0  # of its logarithm
_ROUNDS = 60


class _Likelihood(NamedTuple):
    """What stretches say of their parameters, each of its own: log Gaussians about one place.

    Args:
        precision: ``S x p x p``.
        pull: Precision times mean, less the place, ``S x p``.
    """

    precision: Tensor
    pull: Tensor


def variation(chain: Chain, found: Estimate) -> Tensor:
    r"""How far stretches' parameters lie from those of the machine, ``p``, in priors' deviations.

    With :math:`\theta_s = \theta + \eta_s` in the coordinates in which priors are standard normal,
    :math:`\eta_s \sim N(0, \operatorname{diag}(v^2))` for stretch s, and the noises as they were
    found, v is where its posterior density is highest (empirical Bayes for random effects,
    Laird and Ware 1982), with :math:`\log v \sim N(\log 0.05, 1)`: what the stretches say nothing
    of stays there.
    """
    told = _told(chain, found)
    start = math.log(_MEDIAN)
    log_v = torch.full_like(told.pull[0], start).requires_grad_()
    search = torch.optim.LBFGS([log_v], max_iter=_ROUNDS, line_search_fn="strong_wolfe")

    def cost() -> Tensor:
        search.zero_grad()
        prior = 0.5 * ((log_v - start) / _SPREAD).square().sum()
        value = prior - log_evidence(told.precision, told.pull, log_v.exp())
        value.backward()
        return value

    search.step(cost)
    return log_v.detach().exp()


def log_evidence(precision: Tensor, pull: Tensor, v: Tensor) -> Tensor:
    r"""The log density of all stretches by v, but for a constant.

    What stretch s says of its parameters is
    :math:`\exp(h_s^\top \theta_s - \theta_s^\top \Lambda_s \theta_s / 2)`; :math:`\eta_s`, and then
    :math:`\theta \sim N(0, I)`, are integrated out.

    Args:
        precision: The :math:`\Lambda_s`, ``S x p x p``.
        pull: The :math:`h_s`, ``S x p``.
        v: Standard deviations of the :math:`\eta_s`, ``p``.
    """
    eye = torch.eye(len(v), dtype=v.dtype)
    scaled, h = precision * v, pull * v  # Lambda_s V, V h_s
    root = torch.linalg.cholesky(eye + v.unsqueeze(-1) * scaled)
    shift = torch.cholesky_solve(h.unsqueeze(-1), root).squeeze(-1)
    own = 0.5 * (h * shift).sum() - root.diagonal(dim1=-2, dim2=-1).log().sum()
    shared = eye + (precision - scaled @ torch.cholesky_solve(scaled.mT, root)).sum(0)
    left = (pull - (scaled @ shift.unsqueeze(-1)).squeeze(-1)).sum(0).unsqueeze(-1)
    whole = torch.linalg.cholesky((shared + shared.mT) / 2)
    common = 0.5 * (left * torch.cholesky_solve(left, whole)).sum()
    return own + common - whole.diagonal().log().sum()


def _told(chain: Chain, found: Estimate) -> _Likelihood:
    """By smoothing each stretch alone, with a standard normal prior about what all say."""
    d, p = len(found.noise), chain.num_parameters
    parameters = found.stretches[0].states.means[0, d:]
    path = _path(chain, [s.states.means[:, :d] for s in found.stretches], parameters)
    precisions, pulls = [], []
    for link, (mean, variance) in zip(chain.linearised(path), chain.starts, strict=True):
        mean, variance = mean.copy(), variance.copy()
        mean[d:], variance[d:] = parameters, 1.0
        (alone,), _ = smooth_chain([link], [(mean, variance)], found.noise, found.process_noise)
        covariance = alone.states.covariances[0, d:, d:]
        # No stretch knows less than its prior, but by rounding.
        values, vectors = np.linalg.eigh(np.linalg.inv(covariance) - np.eye(p))
        precisions.append((vectors * values.clip(0)) @ vectors.T)
        pulls.append(np.linalg.solve(covariance, alone.states.means[0, d:] - parameters))
    return _Likelihood(torch.from_numpy(np.stack(precisions)), torch.from_numpy(np.stack(pulls)))


def _path(chain: Chain, states: Sequence[Array], parameters: Array) -> Path:
    rows = np.concatenate([x[:-1] for x in states])
    return Path([*states], parameters, chain.asked(rows, chain.actions, parameters))
