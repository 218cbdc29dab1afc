"""Noise that grows with the size of what is measured."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.gp.kernels import RBF, Stationary
from gpadjust.gp.noise import RowNoise, RowSource
from gpadjust.models.component_noise import ComponentNoise

_FLOOR = 1e-3  # of the largest size, that a size is at least
_NEAR = 0.5  # of the shortest lengthscale, within which sizes are alike
_STILL = 0.2  # change of the logarithm of a size that needs no other fit
_ROUNDS = 4


class RelativeNoise(ComponentNoise, RowSource):
    r"""Noise of the variance :math:`s_0 + s_1 g(x)^2`, both numbers learnt.

    The size g is that of the physics (of several, of their sum with the prior means of the rhos).
    Without physics it is that of the posterior mean, which rough fits find: at training inputs,
    between them by a weighted mean of its logarithm.

    Attributes:
        weights: Of all columns of physics in f_p over its root mean square at the training inputs,
            ``batch_shape x (m) x 1 x k``.
        points: Training inputs, ``n x d``; none where there is a physics.
        log_sizes: Logarithms of the size there, ``batch_shape x (m) x n``.
        lengthscale: That of the weights, ``batch_shape x (m) x 1 x d``.
    """

    weights: Tensor
    points: Tensor
    log_sizes: Tensor
    lengthscale: Tensor

    def __init__(self, make: Any) -> None:
        super().__init__(2, make.batch_shape)
        self._num_inputs, m = make.num_inputs, make.data.Y.shape[-1]
        f_p, k = make.prior_mean(), len(make.f)
        size = f_p.square().mean(-2, keepdim=True).sqrt()  # batch_shape x 1 x m
        size = size.where(size > 0, torch.ones_like(size))
        columns = torch.eye(m).to(f_p).repeat(1, k)  # of each output, m x (k m)
        means = torch.cat([mean + torch.zeros_like(size) for mean in make.means], -1) if k else None
        weights = columns if means is None else columns * means
        weights = (weights / size.mT).unsqueeze(-2)
        self.register_buffer("weights", weights if m > 1 else weights.squeeze(-3))
