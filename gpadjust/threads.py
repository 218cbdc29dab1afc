"""No more threads than a problem's matrices are worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_SMALL = 256  # points of a covariance up to which a second thread costs more than it brings


@contextmanager
def threads_for(num_points: int) -> Iterator[None]:
    """Let PyTorch use one thread for a small problem; the user's setting is restored after.

    Threads that wait for each other at every small product spin, and take their time from whatever
    else the machine does: on a busy one, a fit of twelve points can take a hundred times as long.

    Args:
        num_points: Number of points of the covariances.

    Example:
        >>> import torch
        >>> before = torch.get_num_threads()
        >>> with threads_for(12):
        ...     torch.get_num_threads()
        1
        >>> torch.get_num_threads() == before
        True
    """
    before = torch.get_num_threads()
    if before == 1 or num_points > _SMALL:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
