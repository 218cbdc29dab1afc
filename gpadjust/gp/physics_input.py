"""The physics as further input columns of a BoTorch model."""

from __future__ import annotations

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.physics import Physics


class PhysicsInput(InputTransform):
    r"""Appends f_p to the inputs: :math:`X \mapsto [\text{base}(X), f_p(X)]`.

    The physics always sees the user's raw ``X``; the user's own input transform (``Normalize``,
    say) acts on the other columns. A mean and a kernel that read the columns are then the whole
    prior, so that everything in BoTorch that bypasses a model's ``forward`` is right as well.

    Args:
        physics: The physics f_p, ``... x n x d`` to ``... x n x m``.
        num_inputs: Number ``d`` of raw input columns.
        base: The user's input transform, or none.
    """

    transform_on_train = True
    transform_on_eval = True
    transform_on_fantasize = True

    def __init__(
        self, physics: Physics, num_inputs: int, base: InputTransform | None = None
    ) -> None:
        super().__init__()
        if base is not None and base.is_one_to_many:
            raise ValueError(
                f"The input transform {type(base).__name__} makes several points of one, which "
                "models with physics do not support; use a one-to-one transform."
            )
        self.physics = physics
        self.num_inputs = num_inputs
        self.base = base

    def transform(self, X: Tensor) -> Tensor:
        """Map raw ``X`` (``... x n x d``) to ``... x n x (d' + m)``."""
        self._check(X)
        return self._append(X if self.base is None else self.base(X), self.physics(X))

    def without_physics(self, X: Tensor) -> Tensor:
        """Like :meth:`transform`, with zeros in place of f_p, which is then not evaluated."""
        self._check(X)
        inputs = X if self.base is None else self.base(X)
        m = self.physics.num_outputs
        assert m is not None, "the physics was evaluated at the training inputs"
        return torch.cat([inputs, inputs.new_zeros(*inputs.shape[:-1], m)], dim=-1)

    def preprocess_transform(self, X: Tensor) -> Tensor:
        """As :meth:`transform`, with the base transform's own preprocessing."""
        self._check(X)
        inputs = X if self.base is None else self.base.preprocess_transform(X)
        return self._append(inputs, self.physics(X))

    def equals(self, other: InputTransform) -> bool:
        """Whether ``other`` appends the same physics after an equal base transform."""
        return (
            isinstance(other, PhysicsInput)
            and self.physics is other.physics
            and (
                self.base is other.base
                or (
                    self.base is not None
                    and other.base is not None
                    and self.base.equals(other.base)
                )
            )
        )

    @staticmethod
    def _append(inputs: Tensor, values: Tensor) -> Tensor:
        """Join columns; the base transform may have added a batch."""
        return torch.cat([inputs, values.expand(*inputs.shape[:-1], values.shape[-1])], dim=-1)

    def _check(self, X: Tensor) -> None:
        if not isinstance(X, Tensor) or X.dtype != torch.float64:
            found = X.dtype if isinstance(X, Tensor) else type(X).__name__
            raise TypeError(f"Expected X as a float64 tensor, got {found}; use `X.double()`.")
        if X.shape[-1] != self.num_inputs:
            raise ValueError(
                f"Expected X with {self.num_inputs} columns, the inputs that the model was built "
                f"on, got shape {tuple(X.shape)}. Pass raw inputs: the model appends f_p itself."
            )
