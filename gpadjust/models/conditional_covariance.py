"""What the data leave unknown of one term of a model."""

from __future__ import annotations

from copy import deepcopy

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.kernels import Kernel
from gpytorch.settings import lazily_evaluate_kernels
from linear_operator import to_dense
from torch import Tensor

from gpadjust.gp import UnknownMeanKernel
from gpadjust.models.cholesky_strategy import CholeskyStrategy
from gpadjust.models.multi_output_gp import MultiOutputGP

_NOTHING = -230.0  # the logarithm of a variance that adds nothing to others


class ConditionalCovariance:
    r"""The covariance of one term of a model's kernel, as if the data were of it and noise alone.

    With the term's covariance K of the data, noise included, and U of the data with new points,

    .. math:: k(X, X) - U^T K^{-1} U.

    Where constant means with the bases H and the prior variances :math:`\kappa` are unknown, K is
    that without them, and :math:`R (\mathrm{diag}(\kappa)^{-1} + H^T K^{-1} H)^{-1} R^T` with
    :math:`R = H_X - U^T K^{-1} H` is added (Rasmussen and Williams 2006, eq. 2.42), so that vague
    priors cost no digits.

    Args:
        model: The model, in eval mode.
        kernel: ``covar_module``, or the covariance of one adjustment in it.
    """

    def __init__(self, model: MultiOutputGP, kernel: Kernel) -> None:
        (self.train,) = model.train_inputs
        own = {id(parameter) for parameter in kernel.parameters()}
        named = dict(model.named_parameters())
        constants = {n: b for n, b in model.constant_means.items() if id(named[n]) in own}
        self.bases = list(constants.values())
        self.kernel = kernel
        if constants:
            log_variances = [named[name].detach() for name in constants]
            self.prior_sd = torch.cat(log_variances, -1).div(2).exp()  # batch_shape x (m) x k
            self.kernel = _without_constants(kernel)
        self.strategy = model.prediction_strategy
        if self.kernel is not model.covar_module or not isinstance(self.strategy, CholeskyStrategy):
            with lazily_evaluate_kernels():
                covariance = self.kernel(self.train)
            prior = MultivariateNormal(torch.zeros_like(self.train[..., 0]), covariance)
            self.strategy = CholeskyStrategy(
                [self.train], prior, model.train_targets, model.likelihood
            )

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return ``... x q x q`` without noise, at transformed inputs ``... x q x d``."""
        train = self.train.expand(*inputs.shape[:-2], *self.train.shape[-2:])
        with lazily_evaluate_kernels(False):
            prior, cross = to_dense(self.kernel(inputs)), to_dense(self.kernel(inputs, train))
        covariance: Tensor = to_dense(self.strategy.exact_predictive_covar(prior, cross))
        if not self.bases:
            return covariance
        factors = self.strategy.factors()
        # In units of the constants' prior, where the matrix to invert is at least the identity.
        known = factors.whiten(self._columns(self.train).mT)
        rest = self._columns(inputs) - factors.whiten(cross) @ known.mT
        identity = torch.eye(known.shape[-2], dtype=known.dtype, device=known.device)
        chol = torch.linalg.cholesky(identity + known @ known.mT)
        root = torch.linalg.solve_triangular(chol, rest.mT, upper=False)
        return covariance + root.mT @ root

    def _columns(self, inputs: Tensor) -> Tensor:
        """The constants' bases, for a prior variance of one, ``... x q x k``."""
        columns = torch.stack([basis(inputs) for basis in self.bases], dim=-1)
        return columns * self.prior_sd.unsqueeze(-2)


def _without_constants(kernel: Kernel) -> Kernel:
    """A copy of a kernel in which the constant means are known."""
    kernel = deepcopy(kernel)
    for module in kernel.modules():
        if isinstance(module, UnknownMeanKernel):
            module.raw_constant.fill_(_NOTHING)
    return kernel
