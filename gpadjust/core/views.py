"""The model as GPyTorch sees it: its mean, kernel and noise as modules that read the one table.

They have no parameters: all of them are differentiable functions of the model's coordinates ``u``,
in the user's units. Draws and outputs are batch dimensions, ``... x (S) x (m) x n``, which are left
out where there is one.
"""

from __future__ import annotations

from typing import Any

import torch
from gpytorch.kernels import Kernel
from gpytorch.likelihoods.noise_models import Noise as NoiseModule
from gpytorch.means import Mean
from gpytorch.mlls import AddedLossTerm
from linear_operator.operators import DiagLinearOperator
from torch import Tensor

_MISSING = 1e12  # variance of the noise of a missing target, in squared units


def squeezed(values: Tensor, dim: int) -> Tensor:
    """Return values ``... x S x m x n (x n)`` without S and m (at ``dim``) where these are 1."""
    return values.squeeze(tuple(i for i in (dim - 1, dim) if values.shape[i] == 1))


def _of_all(values: Tensor, model: Any, dim: int) -> Tensor:
    """Return values of each draw and output, ``... (x S) (x m) x n (x n)``."""
    shape = (len(model.u), model.num_outputs, *[1] * (-dim - 1))
    return squeezed(values.expand(torch.broadcast_shapes(values.shape, shape)), dim)


class _View:
    """A reader of a model, which does not contain it."""

    model: Any

    def __init__(self, model: Any, **options: Any) -> None:
        super().__init__(**options)
        object.__setattr__(self, "model", model)  # a module would register it


class MeanView(_View, Mean):
    """The prior mean of a model, f_p for an adjustment."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the mean at ``... x n x d``."""
        return _of_all(self.model.evaluate(x).mean * self.model.unit, self.model, -2)


class TermView(_View, Kernel):
    """The kernel of a term, scaled by its basis on both sides: diag(b) (k + kappa) diag(b)."""

    def __init__(self, model: Any, name: str) -> None:
        lead = torch.Size([size for size in (len(model.u), model.num_outputs) if size > 1])
        super().__init__(model, batch_shape=lead)
        self.name = name

    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **_: Any
    ) -> Tensor:
        """Return covariances ``... x n x n'``, or variances ``... x n``."""
        model = self.model
        one = model.evaluate(x1)
        one.weights = {self.name: one.weights[self.name]}  # b (k + kappa) b' of one term alone
        if diag:
            return _of_all(one.variance() * model.unit.square(), model, -2)
        other = one if x2 is x1 else model.evaluate(x2)
        return _of_all(one.cross(other) * model.unit.square().unsqueeze(-1), model, -3)


class NoiseView(_View, NoiseModule):
    """The noise of a model's observations."""

    @property
    def noise(self) -> Tensor:
        """The variances at the training inputs, ``(S) x (m) x n``."""
        return _of_all(self._variance(self.model.data.X, True), self.model, -2)

    def forward(
        self, *params: Any, shape: Any = None, noise: Tensor | None = None, **_: Any
    ) -> DiagLinearOperator:
        """Return the diagonal covariance of observations ``shape``, in training of the targets."""
        if noise is not None:
            return DiagLinearOperator(noise)
        X = self.model.data.X
        if self.model.training and shape is not None and shape[-1] == len(X):
            variance = self._variance(X, True)
        elif params and isinstance(params[0], Tensor):
            variance = self._variance(params[0], False)
        else:
            variance = self._variance(X, False).mean(-1, keepdim=True)
        return DiagLinearOperator(_of_all(variance, self.model, -2).expand(shape))

    def _variance(self, X: Tensor, is_training: bool) -> Tensor:
        model, values = self.model, self.model.values
        v = model.noise.variance(values, model.places(X, values), is_training)
        if is_training:
            v = v + _MISSING * model.data.Y.isnan().mT
        return v.expand(*v.shape[:-1], X.shape[-2]) * model.unit.square()


class OtherPriors(_View, AddedLossTerm):
    """The log density of priors of GPyTorch's kernels over that of the coordinates."""

    def loss(self, *params: Any) -> Tensor:
        """Return the log density, of each output."""
        return self.model.table.log_prior_ratio(self.model.u).squeeze()
