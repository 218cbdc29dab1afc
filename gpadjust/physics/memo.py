"""A memo of function values, keyed by input rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import repeat
from threading import RLock
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gpadjust.physics.error import PhysicsError


def row_keys(rows: Tensor) -> list[bytes]:
    """One hashable key per row: equal rows, and only those, have equal keys.

    Args:
        rows: ``N x d``, ``d >= 1``.

    Returns:
        ``N`` keys, the float64 bytes of the rows.

    Example:
        >>> keys = row_keys(torch.tensor([[0.0, 1.0], [-0.0, 1.0], [2.0, 1.0]]))
        >>> keys[0] == keys[1], keys[0] == keys[2]
        (True, False)
    """
    # Adding zero turns -0.0 into 0.0: they are equal, but their bytes are not.
    table = np.ascontiguousarray(rows.detach().cpu().double().numpy() + 0.0)
    row_bytes = np.dtype((np.void, table.itemsize * table.shape[1]))
    return cast(list[bytes], table.view(row_bytes).ravel().tolist())


class RowMemo:
    """Remembers the output rows of a function, keyed by its input rows (see ``row_keys``).

    When a new batch does not fit, it forgets everything and starts again with that batch. A deep
    copy is empty: what is copied is about to go its own way. Threads can share it; rows that two of
    them ask for at the same moment may be evaluated by both.

    Args:
        capacity: The most rows it holds; 0 for none.
        state: What the values depend on besides the rows. It is copied, and kept for the owner.

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

    def __init__(self, capacity: int, state: Sequence[Tensor] = ()) -> None:
        self.capacity = capacity
        self.state = [tensor.detach().clone() for tensor in state]
        self._lock = RLock()
        self.clear()

    def __len__(self) -> int:
        """The number of rows remembered."""
        return len(self._slots)

    def clear(self) -> None:
        """Forgets every row."""
        with self._lock:
            self._slots: dict[bytes, int] = {}
            self._used = 0  # rows of the table; more than slots where two threads were at one row
            self._values: Tensor | None = None

    def recall(self, rows: Tensor, evaluate: Callable[[Tensor], Tensor]) -> Tensor:
        """The values of some rows, of which a function is asked for those not remembered.

        Args:
            rows: ``N x d``, ``N >= 1``.
            evaluate: Maps the distinct unknown rows ``k x d`` to values ``k x m``. If it raises a
                ``PhysicsError`` with a ``partial`` result, the finite rows of that are remembered.

        Returns:
            ``N x m``, a copy.

        Raises:
            PhysicsError: That of ``evaluate``, its ``rows`` restated as indices into ``rows``.
        """
        if self.capacity == 0:
            return evaluate(rows)
        keys = row_keys(rows)
        if self._slots.keys().isdisjoint(keys) and len(set(keys)) == len(keys):
            # All new and distinct: the usual case of cheap physics, kept free of index tables.
            return self._learn(keys, rows, evaluate).clone()
        with self._lock:
            slots = self.lookup(keys)
            known = slots >= 0
            recalled = self.gather(slots[known]) if known.any() else None
        if recalled is not None and len(recalled) == len(keys):
            return recalled

        new = (~known).nonzero().flatten().tolist()
        asked = sorted({keys[i]: i for i in reversed(new)}.values())
        numbers = {keys[i]: number for number, i in enumerate(asked)}
        origin = torch.tensor([numbers.get(key, -1) for key in keys])
        try:
            values = self._learn(list(numbers), rows[asked], evaluate)
        except PhysicsError as error:
            if error.inputs is None:
                error.relocate(origin)
            raise
        result = values.new_empty(len(keys), values.shape[1])
        result[new] = values[origin[new]]
        if recalled is not None:
            result[known] = recalled
        return result

    def _learn(
        self, keys: list[bytes], rows: Tensor, evaluate: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Evaluates and remembers some rows, outside of the lock: a simulator may take hours."""
        try:
            values = evaluate(rows)
        except PhysicsError as error:
            if error.partial is not None:
                partial, error.partial = error.partial, None
                good = partial.isfinite().all(-1)
                self.store([keys[i] for i in good.nonzero().flatten().tolist()], partial[good])
            raise
        self.store(keys, values)
        return values

    def lookup(self, keys: Sequence[bytes]) -> Tensor:
        """Finds where the values of some rows are kept.

        Returns:
            ``N`` slots for ``gather``, -1 for rows it does not know.
        """
        slots = map(self._slots.get, keys, repeat(-1))
        return torch.from_numpy(np.fromiter(slots, dtype=np.int64, count=len(keys)))

    def gather(self, slots: Tensor) -> Tensor:
        """The remembered values in some slots.

        Args:
            slots: ``N`` slots, none of them -1.

        Returns:
            ``N x m`` values, a copy.

        Raises:
            LookupError: If it remembers nothing.
        """
        if self._values is None:
            raise LookupError("The memo is empty: it has no values to gather.")
        return self._values[slots]

    def store(self, keys: Sequence[bytes], values: Tensor) -> None:
        """Remembers new rows, and no more than ``capacity`` of them.

        Args:
            keys: ``N`` distinct keys.
            values: ``N x m``, without an autograd graph.
        """
        # The table outlives inference mode, whose tensors could not be written to afterwards.
        with self._lock, torch.inference_mode(False):
            if self._used + len(keys) > self.capacity:
                self.clear()
                keys, values = keys[: self.capacity], values[: self.capacity]
            start, end = self._used, self._used + len(keys)
            if self._values is None:
                self._values = values.clone()
            elif end > self._values.shape[0]:
                # Doubling keeps the cost of many small batches linear.
                room = values.new_empty(max(start, len(keys)), values.shape[1])
                self._values = torch.cat([self._values[:start], room])
            self._values[start:end] = values
            self._slots.update(zip(keys, range(start, end), strict=True))
            self._used = end

    def __getstate__(self) -> dict[str, Any]:
        """The state for a pickle, without the lock and the table's spare rows."""
        with self._lock:
            values = None if self._values is None else self._values[: self._used].clone()
            state = {**self.__dict__, "_values": values, "_slots": self._slots.copy()}
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Takes the state of a pickle, with a lock of its own."""
        self.__dict__.update(state)
        self._lock = RLock()

    def __deepcopy__(self, memo: dict[int, Any]) -> RowMemo:
        """An empty memo of the same capacity."""
        return RowMemo(self.capacity)
