"""The error of a physics that cannot be evaluated, and the warning of one that is obviously off."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

_SHOWN = 5  # rows
_LONGEST = 500  # characters of a subprocess's stderr


class PhysicsError(RuntimeError):
    """A physics failed, or returned something other than one finite row of outputs per input row.

    Its ``inputs``, ``len(rows) x (d + p)``, are columns and parameters of the rows, or None.

    Args:
        message: The problem, the expectation, and the way out.
        rows: The failing rows, counted over the flattened leading dimensions of X; empty if they
            are unknown.
        partial: ``N x m`` outputs when only some rows failed, NaN in those.

    Example:
        >>> print(PhysicsError("physics 'pendulum' returned NaN.", rows=[7]))
        physics 'pendulum' returned NaN.
          row 7
    """

    def __init__(
        self, message: str, rows: Iterable[int] = (), *, partial: Tensor | None = None
    ) -> None:
        super().__init__(message)  # alone, so that the error can be pickled
        self.rows: tuple[int, ...] = tuple(rows)
        self.inputs: Tensor | None = None
        self.partial = partial

    def __str__(self) -> str:
        lines = [str(self.args[0])]
        for position, row in enumerate(self.rows[:_SHOWN]):
            lines.append(f"  row {row}")
            if self.inputs is not None:
                lines[-1] += f": {self.inputs[position].tolist()}"
        if len(self.rows) > _SHOWN:
            lines.append(f"  and {len(self.rows) - _SHOWN} more")
        return "\n".join(lines)


class PhysicsWarning(UserWarning):
    """A physics is obviously off at five or more observations: a factor, sign, offset, or scaling.

    Comparisons, the report and ``CKARegressor`` give it, except of a physics with unknown
    parameters; fits of dynamics, if the transitions do not determine one of these.
    """


def described(error: Exception) -> str:
    """Return the type and message of an error, and the end of a subprocess's stderr."""
    written = str(getattr(error, "stderr", None) or "").strip()
    message = f"{type(error).__name__}: {str(error).rstrip('.')}"
    if written:
        message += f"; it wrote: {written[-_LONGEST:]}"
    return message


def outline(value: Any) -> str:
    """Return dtype and shape of a tensor, or the type of another value, for messages."""
    if torch.is_tensor(value):
        return f"{value.dtype}, {tuple(value.shape)}"
    return type(value).__name__
