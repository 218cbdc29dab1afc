"""What the data leave unknown of a model, and what observations would tell of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gpadjust.gp import SumOfTerms
from gpadjust.gp.gaussian import cholesky
from gpadjust.models.exact_conditioning import Factors, conditional_covariance
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.terms_model import TermsModel


class UnknownCovariance:
    r"""What the data leave unknown of a sum of terms, as if they were of these and noise alone.

    With the terms' covariance K of the data, noise included, and U of new points with the data,

    .. math:: k(X, X) - U K^{-1} U^T.

    Where constant means with the bases H and the prior variances :math:`\kappa` are unknown, K is
    that without them, and :math:`R (\mathrm{diag}(\kappa)^{-1} + H^T K^{-1} H)^{-1} R^T` with
    :math:`R = H_X - U K^{-1} H` is added (Rasmussen and Williams 2006, eq. 2.42), so that vague
    priors cost no digits.

    Args:
        model: The model, in eval mode.
        names: The names of the terms. Default: all.
    """

    def __init__(self, model: TermsGP, names: tuple[str, ...] | None = None) -> None:
        conditioning = model.conditioning()
        (self.train,) = model.train_inputs
        self.terms = [t for t in model.terms if names is None or t.name in names]
        self.constants = [term for term in self.terms if term.learns_mean]
        self.kernel = SumOfTerms(self.terms, known_means=True)
        self.has_kernel = any(term.kernel is not None for term in self.terms)
        if names is None and not self.constants:
            self.factors = conditioning.factors()
            return
        covariance = torch.diag_embed(model.noise.at(self.train))
        if self.has_kernel:
            covariance = covariance + self.kernel.forward(self.train, self.train)
        self.factors = Factors.of(covariance, model.train_targets)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return ``... x q x q`` without noise, at transformed inputs ``... x q x d``."""
        batch = torch.broadcast_shapes(inputs.shape[:-2], self.train.shape[:-2])
        train = self.train.expand(*batch, *self.train.shape[-2:])
        if self.has_kernel:
            prior, cross = self.kernel.forward(inputs, inputs), self.kernel.forward(inputs, train)
        else:
            q, n = inputs.shape[-2], self.train.shape[-2]
            prior, cross = inputs.new_zeros(*batch, q, q), inputs.new_zeros(*batch, q, n)
        white = self.factors.whiten(cross)
        covariance = conditional_covariance(prior, white)
        if not self.constants:
            return covariance
        # In units of the constants' prior, where the matrix to invert is at least the identity.
        known = self.factors.whiten(self._columns(self.train).mT)
        rest = self._columns(inputs) - white @ known.mT
        identity = torch.eye(known.shape[-2], dtype=known.dtype, device=known.device)
        chol = torch.linalg.cholesky(identity + known @ known.mT)
        root = torch.linalg.solve_triangular(chol, rest.mT, upper=False)
        return covariance + root.mT @ root

    def _columns(self, inputs: Tensor) -> Tensor:
        """The constants' bases, for a prior variance of one, ``... x q x k``."""
        columns: Any = self.kernel.basis_of_means(inputs)
        return columns * torch.stack([t.mean_variance.sqrt() for t in self.constants], dim=-1)


def information_gain(
    model: TermsModel,
    X: Tensor,
    unknown: Callable[[Tensor], Tensor],
    remaining: Callable[[Tensor], Tensor] | None = None,
    counted: Tensor | None = None,
) -> Tensor:
    r"""The information of noisy observations at a batch of points, in nats.

    With the covariance C of what is unknown at the points X and the noise variances S it is
    :math:`\tfrac{1}{2} \log\det(I + S^{-1/2} C S^{-1/2})`, which is never singular, less the same
    for what would remain unknown; summed over the independent outputs.

    Args:
        model: The model, in eval mode.
        X: Raw inputs, ``batch_shape x q x d``.
        unknown: What the data leave unknown.
        remaining: What would be unknown if the function in question were known. Default: nothing.
        counted: Which observations are made, ``batch_shape x q`` booleans. Default: all.

    Returns:
        The information, ``batch_shape``; of a model that holds samples of its hyper-parameters, of
        each of these, ``batch_shape x S``.
    """
    inputs = model.model_inputs(X)
    (train,) = model.conditioning().train_inputs
    batch_shape = torch.broadcast_shapes(inputs.shape[:-2], train.shape[:-2])
    inputs = inputs.expand(*batch_shape, *inputs.shape[-2:])
    noise = model.observation_noise(inputs).expand(inputs.shape[:-1])
    if counted is not None:
        for _ in range(noise.dim() - counted.dim()):
            counted = counted.unsqueeze(-2)
        noise = noise.masked_fill(~counted, torch.inf)  # such an observation tells nothing
    information = _log_sds(unknown(inputs), noise)
    if remaining is not None:
        information = information - _log_sds(remaining(inputs), noise)
    return information.sum(-1) if model.num_outputs > 1 else information


def _log_sds(covariance: Tensor, noise: Tensor) -> Tensor:
    """Half the log-determinant of noisy observations' covariance, in units of their noise."""
    sd = noise.sqrt()
    identity = torch.eye(sd.shape[-1], dtype=sd.dtype, device=sd.device)
    matrix = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2)) + identity
    chol, info = torch.linalg.cholesky_ex(matrix)
    if info.any():
        # What rounding leaves of a covariance far above the noise. Elsewhere the eigenvalues are 1
        # or more, and a nugget would be taken for information.
        failed = (info > 0)[..., None, None]
        sound = torch.linalg.cholesky(torch.where(failed, identity, matrix))
        chol = torch.where(failed, cholesky(matrix)[0], sound)
    log_sds: Tensor = chol.diagonal(dim1=-1, dim2=-2).log().sum(-1)
    return log_sds
