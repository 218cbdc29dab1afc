"""An outcome transform whose shift and scale are given, not estimated from the targets."""

from __future__ import annotations

from typing import Self

import torch
from botorch.models.transforms.outcome import OutcomeTransform, Standardize
from torch import Tensor


class FixedStandardize(Standardize):
    r"""The map :math:`y \mapsto (y - \mu) / \sigma` with :math:`\mu` and :math:`\sigma` given.

    BoTorch's ``Standardize`` takes both from the targets. A model with physics wants the scale of
    the *residual* :math:`y - f_p(x)`, so that a good physics does not push the noise under the
    likelihood's floor, and no shift, so that :math:`\rho` keeps its meaning.
    """

    @classmethod
    def from_moments(cls, means: Tensor, stdvs: Tensor) -> FixedStandardize:
        """Make the transform from ``batch_shape x 1 x m`` shifts and (positive) scales."""
        transform = cls(m=means.shape[-1], batch_shape=means.shape[:-2])
        transform.means = means
        transform.stdvs = stdvs
        transform._stdvs_sq = stdvs.square()
        transform._is_trained = torch.tensor(True)
        return transform.eval()

    @classmethod
    def from_residual(cls, train_Y: Tensor, mean: Tensor) -> FixedStandardize:
        """Divide by the root mean square of ``train_Y - mean``.

        Args:
            train_Y: Targets, ``batch_shape x n x m``, NaN where there is none.
            mean: The prior mean at the training inputs, of the same shape. Where it meets the
                targets exactly, the scale is a millionth of theirs (or 1 if they are zero).
        """

        def rms(values: Tensor) -> Tensor:
            return values.square().nanmean(-2, keepdim=True).sqrt()

        scale, size = rms(train_Y - mean), rms(train_Y)
        tiny = 1e-6 * size.where(size > 0, torch.full_like(size, 1e6))
        return cls.from_moments(torch.zeros_like(scale), scale.where(scale > 0, tiny))

    @classmethod
    def from_transform(
        cls, transform: OutcomeTransform | None, train_Y: Tensor, X: Tensor
    ) -> FixedStandardize | None:
        """Take over the shift and scale that BoTorch's ``Standardize`` puts on the targets.

        Raises:
            ValueError: If the transform is not a shift and scale of each output.
        """
        if transform is None or type(transform) is FixedStandardize:
            return transform
        if type(transform) is not Standardize:
            raise ValueError(
                f"The outcome transform {type(transform).__name__} is not supported: f_p lives in "
                "the units of the targets, so the transform must be one shift and scale per "
                "output. Use Standardize, None, or the default, which divides by the residual's "
                "scale; to model log(y), say, take the logarithm of both train_Y and the physics."
            )
        transform.train()
        transform(train_Y, X=X)
        return cls.from_moments(transform.means, transform.stdvs)

    def train(self, mode: bool = True) -> Self:
        """Stay in eval mode: there is nothing to estimate."""
        return super().train(False)
