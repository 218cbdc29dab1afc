"""An outcome transform whose scale is given, not estimated from the targets."""

from __future__ import annotations

from typing import Self

import torch
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors import GPyTorchPosterior, Posterior, TransformedPosterior
from gpytorch.settings import min_variance
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

    def untransform_posterior(
        self, posterior: Posterior, X: Tensor | None = None
    ) -> GPyTorchPosterior | TransformedPosterior:
        """Bring a posterior back to the user's units; its variance is right however small."""
        untransformed = super().untransform_posterior(posterior, X=X)
        if type(untransformed) is GPyTorchPosterior:
            return RescaledPosterior(untransformed.distribution, posterior, self._stdvs_sq)
        return untransformed


class RescaledPosterior(GPyTorchPosterior):
    """A posterior in the user's units whose variance is computed in the model's.

    GPyTorch raises every variance to an absolute minimum (1e-10), which small units and noise-free
    data would fall below. ``.variance`` is free of that; what is computed from ``.distribution``,
    by a posterior transform, say, is not: bring targets far below 1e-4 to larger units.

    Args:
        distribution: The distribution in the user's units.
        scaled: The posterior in the model's units.
        factor: What its variance is to be multiplied by, ``batch_shape x 1 x m``.
    """

    def __init__(self, distribution: object, scaled: GPyTorchPosterior, factor: Tensor) -> None:
        super().__init__(distribution)
        self._scaled = scaled
        self._factor = factor

    @property
    def variance(self) -> Tensor:
        """The posterior variance, ``batch_shape x q x m``."""
        with min_variance(double_value=0.0):
            variance: Tensor = self._scaled.variance * self._factor
        return variance
