"""A memo of function values, keyed by input rows."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat
from typing import Any

import numpy as np
import torch
from torch import Tensor


def row_keys(rows: Tensor) -> list[bytes]:
    """One hashable key per row: equal rows, and only those, have equal keys.

    Args:
        rows: `N x d`, `d >= 1`.

    Returns:
        `N` keys, the float64 bytes of the rows.

    Example:
        >>> keys = row_keys(torch.tensor([[0.0, 1.0], [-0.0, 1.0], [2.0, 1.0]]))
        >>> keys[0] == keys[1], keys[0] == keys[2]
        (True, False)
    """
    # Adding zero turns -0.0 into 0.0: they are equal, but their bytes are not.
    table = np.ascontiguousarray(rows.detach().cpu().double().numpy() + 0.0)
    row_bytes = np.dtype((np.void, table.itemsize * table.shape[1]))
    keys: list[bytes] = table.view(row_bytes).ravel().tolist()
    return keys


class RowMemo:
    """Remembers the output rows of a function, keyed by its input rows (see `row_keys`).

    When a new batch does not fit, it forgets everything and starts again with that batch. A deep
    copy is empty: what is copied is about to go its own way.

    Args:
        capacity: The most rows it holds; 0 for none.

    Example:
        >>> memo = RowMemo(capacity=100)
        >>> X = torch.tensor([[1.0], [2.0]])
        >>> memo.store(row_keys(X), X**2)
        >>> slots = memo.lookup(row_keys(torch.tensor([[2.0], [3.0]])))
        >>> slots
        tensor([ 1, -1])
        >>> memo.gather(slots[:1])
        tensor([[4.]])
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.clear()

    def __len__(self) -> int:
        """The number of rows remembered."""
        return len(self._slots)

    def clear(self) -> None:
        """Forgets every row."""
        self._slots: dict[bytes, int] = {}
        self._values: Tensor | None = None

    def lookup(self, keys: Sequence[bytes]) -> Tensor:
        """Finds where the values of some rows are kept.

        Returns:
            `N` slots for `gather`, -1 for rows it does not know.
        """
        slots = map(self._slots.get, keys, repeat(-1))
        return torch.from_numpy(np.fromiter(slots, dtype=np.int64, count=len(keys)))

    def gather(self, slots: Tensor) -> Tensor:
        """The remembered values in some slots.

        Args:
            slots: `N` slots, none of them -1.

        Returns:
            `N x m` values, a copy.

        Raises:
            LookupError: If it remembers nothing.
        """
        if self._values is None:
            raise LookupError("The memo is empty: it has no values to gather.")
        return self._values[slots]

    def store(self, keys: Sequence[bytes], values: Tensor) -> None:
        """Remembers new rows, and no more than `capacity` of them.

        Args:
            keys: `N` keys, distinct and unknown so far.
            values: `N x m`, without an autograd graph.
        """
        if len(self) + len(keys) > self.capacity:
            self.clear()
            keys, values = keys[: self.capacity], values[: self.capacity]
        start, end = len(self), len(self) + len(keys)
        # The table outlives inference mode, whose tensors could not be written to afterwards.
        with torch.inference_mode(False):
            if self._values is None:
                self._values = values.clone()
            elif end > self._values.shape[0]:
                # Doubling keeps the cost of many small batches linear.
                room = values.new_empty(max(start, len(keys)), values.shape[1])
                self._values = torch.cat([self._values[:start], room])
            self._values[start:end] = values
        self._slots.update(zip(keys, range(start, end), strict=True))

    def __getstate__(self) -> dict[str, Any]:
        """The state for a pickle, without the table's spare rows."""
        values = None if self._values is None else self._values[: len(self)].clone()
        return {**self.__dict__, "_values": values}

    def __deepcopy__(self, memo: dict[int, Any]) -> RowMemo:
        """An empty memo of the same capacity."""
        return RowMemo(self.capacity)
