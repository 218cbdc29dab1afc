"""Angles as points of the circle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor


class AngleInput(InputTransform):
    r"""Replaces each angle :math:`\theta` in its place by :math:`\sin\theta, \cos\theta`.

    A stationary kernel on the result has no seam where the angle wraps.

    Args:
        columns: The columns of X that are angles in rad.

    Raises:
        TypeError: If ``columns`` is no sequence of whole numbers.
        ValueError: If ``columns`` is empty, or has a negative or repeated number.

    Example:
        >>> import torch
        >>> AngleInput([0])(torch.tensor([[0.0, 7.0]]))
        tensor([[0., 1., 7.]])
    """

    is_one_to_many = False
    transform_on_train = True
    transform_on_eval = True
    transform_on_fantasize = True

    def __init__(self, columns: Sequence[int]) -> None:
        super().__init__()
        if not isinstance(columns, Sequence) or not all(isinstance(i, int) for i in columns):
            raise TypeError(
                f"Expected columns as a sequence of numbers, such as [0], got {columns!r}."
            )
        self.columns = tuple(columns)
        distinct = set(self.columns)
        if not distinct or len(distinct) < len(self.columns) or min(distinct) < 0:
            raise ValueError(
                f"Expected columns to be one or more different numbers >= 0, got {columns}."
            )

    def transform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d`` to ``... x n x (d + k)``, for ``k`` angles."""
        if X.shape[-1] <= max(self.columns):
            raise ValueError(
                f"Expected X with an angle in column {max(self.columns)}, got shape "
                f"{tuple(X.shape)}."
            )
        parts: list[Tensor] = []
        for i, column in enumerate(X.unbind(-1)):
            parts += [column.sin(), column.cos()] if i in self.columns else [column]
        return torch.stack(parts, dim=-1)

    def column_names(self, names: Sequence[str]) -> list[str]:
        """The names of the columns of :meth:`transform`, of those of X."""
        found: list[str] = []
        for i, name in enumerate(names):
            found += [f"sin({name})", f"cos({name})"] if i in self.columns else [name]
        return found

    @property
    def settings(self) -> dict[str, list[int]]:
        """The arguments that make it again."""
        return {"columns": [*self.columns]}

    def equals(self, other: InputTransform) -> bool:
        """True if ``other`` replaces the same columns."""
        return isinstance(other, AngleInput) and self.columns == other.columns
