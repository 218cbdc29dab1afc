"""The ridge regression adjustment as printed in the paper."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust import RRA
from gpadjust.core.gaussian import Conditioning
from gpadjust.core.terms import WeightedSum
from gpadjust.core.unknowns import Table


class PaperRRA(RRA):
    r"""RRA that regresses y itself, so that it falls to zero far from the data.

    Weights have the prior variance 1 in the user's units, the noise variance is the ridge
    :math:`\lambda`:

    .. math:: \hat\beta = (\Phi^T\Phi + \lambda I)^{-1}\Phi^T y, \quad
        \mathrm{Cov}(\beta) = (\Phi^T\Phi + I)^{-1},

    which is no posterior's unless :math:`\lambda = 1`, so that it is for ``fit(model, "map")``
    alone. Args as of :class:`~gpadjust.RRA`, without prior means, center and constants.
    """

    def __init__(self, train_X: Any, train_Y: Any, train_Yvar: Any = None, **options: Any) -> None:
        own: dict[str, Any] = {"rho_mean": 0.0, "center": 0.0, "constants": False}
        super().__init__(train_X, train_Y, train_Yvar, **own, **options)
        logs = {"rho.kernel.outputscale": 0 * self.unit.log()}
        logs["delta.kernel.outputscale"] = -2 * self.unit.log()
        rows = {row.name: row for row in self.table.own}
        rows |= {n: rows[n]._replace(location=log, scale=0.0) for n, log in logs.items()}
        self.table = Table([*rows.values()], self.num_outputs)

    def conditioned(
        self, train: WeightedSum, noise: Tensor, targets: Tensor, old: Any = None
    ) -> PaperConditioning:
        """Return the paper's mean and covariance given observations of a sum."""
        found = PaperConditioning(train, noise, targets, old)
        one = self.unit.square().reciprocal()
        found.wide = Conditioning(train, one, targets, None if old is None else old.wide)
        return found

    def fit_itself(self, method: str, num_draws: int | None, seed: int) -> None:
        """Raise a ValueError unless the method is ``"map"``."""
        if method != "map":
            raise ValueError(
                "Expected method 'map', as the covariance of PaperRRA is not that of a posterior; "
                f"found {method!r}. Take RRA."
            )


class PaperConditioning(Conditioning):
    """A posterior with the covariance of another one, whose noise has the variance 1."""

    wide: Conditioning

    def moments(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and variances at each point."""
        return self.mean(sought)[0], self.wide.moments(sought)[1]

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and covariances."""
        return self.mean(sought)[0], self.wide.joint(sought)[1]

    def update(self, prior: Tensor, generator: torch.Generator) -> Tensor:
        """Return what makes functions from the prior ones of this posterior."""
        return self.wide.update(prior, generator) + self.alpha - self.wide.alpha
