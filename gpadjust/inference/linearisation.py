"""A prior mean that is linear in unknown parameters, and what targets then say of these."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor


class Around(NamedTuple):
    """The prior mean at the training inputs, near points of the unknown parameters.

    Attributes:
        point: Their coordinates z, ``... x p``.
        residual: The targets less the mean there, ``... x B x n``; 0 where there is no target, and
            infinite where the physics fails.
        slope: Derivatives of the mean, ``... x B x n x p``; 0 likewise.
    """

    point: Tensor
    residual: Tensor
    slope: Tensor

    @property
    def target(self) -> Tensor:
        """What the slopes times the parameters are to make, :math:`r + J z`, ``... x B x n``."""
        return self.residual + (self.slope @ self.point[..., None, :, None]).squeeze(-1)


class Information(NamedTuple):
    """What the targets of each output say of the parameters, if the mean is linear in them.

    Attributes:
        precision: :math:`J^T K^{-1} J`, ``... x B x p x p``.
        pull: :math:`J^T K^{-1} (r + J z)`, ``... x B x p``.
    """

    precision: Tensor
    pull: Tensor

    def posterior(self, outputs: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean ``... x p`` and Cholesky factor of the precision, by the prior and all outputs.

        With a matrix of ones and zeros, ``b x B``, for each of its rows by some of them.
        """
        if outputs is None:
            precision, pull = self.precision.sum(-3), self.pull.sum(-2)
        else:
            precision = torch.einsum("bc,...cpq->...bpq", outputs, self.precision)
            pull = outputs @ self.pull
        chol = torch.linalg.cholesky(precision + torch.eye(pull.shape[-1]).to(pull))
        return torch.cholesky_solve(pull.unsqueeze(-1), chol).squeeze(-1), chol


class Shared(NamedTuple):
    """What unknown parameters add to the distribution of the targets.

    Attributes:
        mean: Added to their mean, ``(m) x n``.
        covariance: Added to their covariance, ``(m) x n x n``.
    """

    mean: Tensor
    covariance: Tensor

    def of_rows(self, rows: Any) -> Shared:
        """That of some of the targets."""
        return Shared(self.mean[..., rows], self.covariance[..., rows, :][..., rows])
