"""An outcome transform whose scale is given, not estimated from the targets."""

from __future__ import annotations

from typing import Self

import torch
from botorch.models.transforms.outcome import Standardize
from torch import Tensor


class FixedStandardize(Standardize):
    r"""The map :math:`y \mapsto (y - \mu) / \sigma` with :math:`\mu` and :math:`\sigma` given.

    BoTorch's ``Standardize`` takes both from the targets. A model with physics wants the scale of
    the *residual* :math:`y - f_p(x)`, so that a good physics does not push the noise under the
    likelihood's floor, and no shift, so that :math:`\rho` keeps its meaning.
    """

    @classmethod
    def of(cls, means: Tensor, stdvs: Tensor) -> FixedStandardize:
        """Make the transform from ``batch_shape x 1 x m`` shifts and (positive) scales."""
        transform = cls(m=means.shape[-1], batch_shape=means.shape[:-2])
        transform.means = means
        transform.stdvs = stdvs
        transform._stdvs_sq = stdvs.square()
        transform._is_trained = torch.tensor(True)
        return transform.eval()

    def train(self, mode: bool = True) -> Self:
        """Stay in eval mode: there is nothing to estimate."""
        return super().train(False)
