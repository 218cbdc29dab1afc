"""Functions drawn from several models, as functions of one."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.nn import Module, ModuleList


class MixedFunctions(Module):
    """Functions of several models of one output, in an order of their own.

    Args:
        functions: Those of each model.
        owner: Whose the i-th function is, ``k``.
    """

    def __init__(self, functions: list[Module], owner: Tensor) -> None:
        super().__init__()
        self.functions = ModuleList(functions)
        self.owner = owner

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x 1``."""
        return self._in_order([f(X) for f in self._used()])

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own, ``k x q x d``: ``k x q x 1``."""
        own = [X[self.owner == i] for i in self.owner.unique().tolist()]
        pairs = zip(cast(list[Any], self._used()), own, strict=True)
        return self._in_order([f.each(points) for f, points in pairs])

    def _used(self) -> list[Module]:
        return [self.functions[i] for i in self.owner.unique().tolist()]

    def _in_order(self, values: list[Tensor]) -> Tensor:
        return torch.cat(values)[self.owner.argsort(stable=True).argsort()]


class OutputsSideBySide(Module):
    """Functions of one output each, seen as functions of all.

    Args:
        outputs: The functions of each output, as many of each.
    """

    def __init__(self, outputs: list[MixedFunctions]) -> None:
        super().__init__()
        self.outputs: Any = ModuleList(outputs)

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        return torch.cat([functions(X) for functions in self.outputs], -1)

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own, ``k x q x d``: ``k x q x m``."""
        return torch.cat([functions.each(X) for functions in self.outputs], -1)
