"""Deterministic functions made of weights on random features."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.gp import FourierKernel, PhysicsColumn, PhysicsMean

if TYPE_CHECKING:
    from gpadjust.models.rra import RRA


class AdjustmentFeatures(Module):
    r"""The design of an RRA, :math:`\Phi(x) = [(f_p(x) - c)\,\varphi_\rho(x), \varphi_\delta(x)]`.

    Args:
        model: The RRA whose feature maps, mean and center it reads.
    """

    rho: FourierKernel
    delta: FourierKernel
    column: PhysicsColumn

    def __init__(self, model: RRA) -> None:
        super().__init__()
        self.rho = model.rho_covar_module.base_kernel
        self.delta = model.delta_covar_module.base_kernel
        self.column = model._column
        self.mean = model.mean_module

    def forward(self, inputs: Tensor) -> Tensor:
        """Return ``... x n x 2D`` in the user's units, from transformed ``... x n x (d + m)``."""
        x = inputs[..., : self.column.num_inputs]
        f_p = self.column(inputs) * self.column.scale
        return torch.cat(
            [f_p.unsqueeze(-1) * self.rho.feature_map(x), self.delta.feature_map(x)], dim=-1
        )

    def prior_mean(self, inputs: Tensor) -> Tensor:
        """Return the mean of the regression, f_p or zero, ``... x n`` in the user's units."""
        mean: Tensor = self.user_units(self.mean(inputs))
        return mean

    def user_units(self, targets: Tensor) -> Tensor:
        """Undo the shift and scale of the targets, ``... x n``."""
        values = targets * self.column.scale
        if isinstance(self.mean, PhysicsMean) and isinstance(self.mean.physics, PhysicsColumn):
            values = values + self.mean.physics.offset
        return values


class AdjustedFunctions(Module):
    r"""Functions :math:`f_i(x) = m(x) + \Phi(x) \beta_i`, one for each row of weights.

    They are deterministic and can be called anywhere, so that particles that follow one of them
    stay consistent along a trajectory; gradients flow to the inputs as far as f_p allows.

    Args:
        model: The RRA that gives features and mean; later changes of it have no effect here.
        weights: ``k x batch_shape x (m) x 2D`` in the user's units.
    """

    weights: Tensor

    def __init__(self, model: RRA, weights: Tensor) -> None:
        super().__init__()
        expected = (*model._aug_batch_shape, 2 * model.num_features)
        if weights.dim() != len(expected) + 1 or weights.shape[1:] != expected:
            raise ValueError(
                f"Expected weights of shape k x {' x '.join(map(str, expected))}, got "
                f"{tuple(weights.shape)}."
            )
        self.input_transform = deepcopy(model.input_transform).eval()
        self.features = deepcopy(AdjustmentFeatures(model)).requires_grad_(False)
        self.has_outputs = model.num_outputs > 1
        self.register_buffer("weights", weights)

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        inputs = self.input_transform(X)
        if self.has_outputs:
            inputs = inputs.unsqueeze(-3)
        features = self.features(inputs)
        k, *batch_shape, num_weights = self.weights.shape
        extra = features.dim() - 2 - len(batch_shape)
        weights = self.weights.reshape(k, *[1] * extra, *batch_shape, num_weights, 1)
        values = self.features.prior_mean(inputs) + (features @ weights).squeeze(-1)
        return values.mT if self.has_outputs else values.unsqueeze(-1)

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own.

        Args:
            X: Raw inputs, ``k x q x d``; of a model without a batch shape.

        Returns:
            ``k x q x m``: the i-th function at the i-th block of points.
        """
        inputs = self.input_transform(X)
        inputs = inputs.unsqueeze(-3) if self.has_outputs else inputs
        deviation = (self.features(inputs) @ self.weights.unsqueeze(-1)).squeeze(-1)
        values = self.features.prior_mean(inputs) + deviation
        return values.mT if self.has_outputs else values.unsqueeze(-1)
