"""The ridge regression adjustment as printed in the paper."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust import RRA
from gpadjust.models.rra import WeightConditioning, regression
from gpadjust.models.training_data import ArrayLike
from gpadjust.physics import Physics


class PaperConditioning(WeightConditioning):
    """Weight conditioning with the covariance of the paper."""

    def regress(self) -> tuple[Tensor, Tensor]:
        """The paper's mean and root of the covariance of weights."""
        design = self.kernel.at(self.train_inputs[0]).features(self.features)
        _, root = regression(design, self.targets, torch.ones_like(design[..., 0]))
        return super().regress()[0], root


class PaperRRA(RRA):
    r"""RRA that regresses y itself, so that it falls to zero far from the data.

    Weights have the prior variance 1 in the user's units, the noise variance is the ridge
    :math:`\lambda`:

    .. math:: \hat\beta = (\Phi^T\Phi + \lambda I)^{-1}\Phi^T y, \quad
        \mathrm{Cov}(\beta) = (\Phi^T\Phi + I)^{-1},

    which is no posterior's unless :math:`\lambda = 1`, so that it cannot be fully Bayesian. The
    arguments are those of :class:`~gpadjust.RRA`, without prior means, and always in the user's
    units.
    """

    conditioning_class = PaperConditioning
    not_sampled = (
        "PaperRRA cannot be fully Bayesian: its covariance is not that of a posterior. Take RRA, "
        "or fit it by method 'map'."
    )

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: Physics | Any,
        **options: Any,
    ) -> None:
        own: dict[str, Any] = {"rho_mean": 0.0, "center": 0.0, "outcome_transform": None}
        super().__init__(train_X, train_Y, train_Yvar, physics=physics, **{**own, **options})
        for term in self.covar_module.terms:
            term.kernel.raw_outputscale.requires_grad_(False).zero_()  # an outputscale of 1
