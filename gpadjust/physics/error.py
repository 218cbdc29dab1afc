"""The error of a physics that cannot be evaluated."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

_SHOWN = 5
_LONGEST = 500  # characters of what a subprocess wrote


class PhysicsError(RuntimeError):
    """A physics failed, or gave something other than one finite row of outputs per input row.

    Args:
        message: What was found, what was expected, and the way out.
        rows: The failing rows, as indices into the rows that were asked for.
        partial: ``N x m`` outputs when only some rows failed, not finite in those; the others are
            remembered.

    Attributes:
        rows: Indices of the failing rows, counted over the flattened leading dimensions of X;
            empty if unknown.
        inputs: ``len(rows) x d`` inputs of those rows, and then unknown parameters, if the physics
            has any; or None if unknown.

    Example:
        >>> error = PhysicsError("physics 'pendulum' returned NaN.", rows=[7])
        >>> error.rows
        (7,)
        >>> print(error)
        physics 'pendulum' returned NaN.
          row 7
    """

    def __init__(
        self, message: str, rows: Iterable[int] = (), *, partial: Tensor | None = None
    ) -> None:
        super().__init__(message)
        self.rows: tuple[int, ...] = tuple(rows)
        self.inputs: Tensor | None = None
        self.partial = partial

    def relocate(self, origin: Tensor) -> None:
        """Restates ``rows`` as positions in a list whose entry ``i`` is row ``origin[i]`` or -1."""
        failed = torch.isin(origin, torch.tensor(self.rows, dtype=origin.dtype))
        self.rows = tuple(failed.nonzero().flatten().tolist())

    def __str__(self) -> str:
        lines = [str(self.args[0])]
        for position, row in enumerate(self.rows[:_SHOWN]):
            values = "" if self.inputs is None else f": {self.inputs[position].tolist()}"
            lines.append(f"  row {row}{values}")
        if len(self.rows) > _SHOWN:
            lines.append(f"  and {len(self.rows) - _SHOWN} more")
        return "\n".join(lines)


def described(error: Exception) -> str:
    """The type and message of an error, and the end of what a subprocess wrote to stderr."""
    written = getattr(error, "stderr", None)
    text = written.decode(errors="replace") if isinstance(written, bytes) else str(written or "")
    said = f"; it wrote: {text.strip()[-_LONGEST:]}" if text.strip() else ""
    return f"{type(error).__name__}: {str(error).rstrip('.')}{said}"
