"""Why a run stopped, with all that was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

if TYPE_CHECKING:
    from gpadjust.active.collection import Collection


class CollectionError(RuntimeError):
    """A run stopped before its budget was spent.

    Args:
        message: What happened.
        collection: The collection so far.
        X: The points that were being measured, ``q x d``.
        result: What the oracle returned for them, if the collection could not take it.
    """

    def __init__(self, message: str, collection: Collection, X: Tensor, result: Any = None) -> None:
        super().__init__(message, collection, X, result)
        self.collection, self.X, self.result = collection, X, result

    def __str__(self) -> str:
        return str(self.args[0])
