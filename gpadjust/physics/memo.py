"""Output rows of a simulator, remembered by its input rows."""

from __future__ import annotations

from collections.abc import Callable
from threading import RLock
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gpadjust.physics.error import PhysicsError


def row_keys(rows: Tensor) -> list[bytes]:
    """One hashable key for each of ``N x d`` rows: equal rows, and only those, have equal keys."""
    # Adding zero turns -0.0 into 0.0: they are equal, but their bytes are not.
    table = np.ascontiguousarray(rows.detach().cpu().double().numpy() + 0.0)
    row_bytes = np.dtype((np.void, table.itemsize * table.shape[1]))
    return cast(list[bytes], table.view(row_bytes).ravel().tolist())


class RowMemo:
    """A dictionary of at most ``capacity`` input rows to output rows, which threads may share.

    When new rows do not fit, it forgets all and begins again with these. Rows that two threads ask
    for at the same moment may be evaluated by both.

    Example:
        >>> memo = RowMemo(capacity=100)
        >>> def square(X):
        ...     print(f"{len(X)} new row(s)")
        ...     return X**2
        >>> memo.recall(torch.tensor([[2.0], [2.0]]), square)
        1 new row(s)
        tensor([[4.],
                [4.]])
        >>> memo.recall(torch.tensor([[2.0]]), square)
        tensor([[4.]])
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._rows: dict[bytes, Tensor] = {}
        self._lock = RLock()

    def __len__(self) -> int:
        return len(self._rows)

    def recall(
        self, rows: Tensor, evaluate: Callable[[Tensor], Tensor], learn: bool = True
    ) -> Tensor:
        """The values of some rows, of which a function is asked for those not remembered.

        Args:
            rows: ``N x d``.
            evaluate: Maps the distinct unknown rows ``k x d`` to values ``k x m``. If it raises a
                ``PhysicsError``, the finite rows of its ``partial`` result are remembered, and its
                ``rows`` restated.
            learn: Whether new values are remembered.
        """
        if not len(rows):
            return evaluate(rows)
        keys = row_keys(rows)
        with self._lock:
            found = {key: self._rows[key] for key in keys if key in self._rows}
        first: dict[bytes, int] = {}  # where each new row is
        for i, key in enumerate(keys):
            if key not in found:
                first.setdefault(key, i)
        if new := [*first]:
            try:
                values = evaluate(rows[[*first.values()]])
            except PhysicsError as error:
                partial, error.partial = error.partial, None
                if partial is not None and learn:
                    good = partial.isfinite().all(-1)
                    kept = good.nonzero().flatten().tolist()
                    self.store([new[i] for i in kept], partial[kept])
                if error.inputs is None:
                    numbers = {key: number for number, key in enumerate(new)}
                    error.relocate(torch.tensor([numbers.get(key, -1) for key in keys]))
                raise
            if learn:
                self.store(new, values)
            found |= zip(new, values, strict=True)
        return torch.stack([found[key] for key in keys]).to(rows)

    def store(self, keys: list[bytes], values: Tensor) -> None:
        """Remember values ``N x m``, without an autograd graph, by distinct keys."""
        values = values.detach().clone()
        with self._lock:
            if len(self._rows) + len(keys) > self.capacity:
                self._rows = {}
            pairs = zip(keys[: self.capacity], values[: self.capacity], strict=True)
            self._rows.update(pairs)

    def __getstate__(self) -> dict[str, Any]:
        with self._lock:
            return {"capacity": self.capacity, "_rows": self._rows.copy()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=RLock())

    def __deepcopy__(self, memo: dict[int, Any]) -> RowMemo:
        """Return an empty memo of the same capacity, as a copy of the physics may change."""
        return RowMemo(self.capacity)
