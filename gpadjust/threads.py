"""The number of threads in a fit of few points: one."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache
from threading import Lock

import torch
from threadpoolctl import ThreadpoolController

_limiting = Lock()  # held by the thread that limits those of other libraries
_setting = Lock()  # held by the thread that sets PyTorch's number of threads
_controller = cache(ThreadpoolController)  # it lists the process's libraries, once
_SMALL = 600  # points of a covariance, up to which two threads took longer than one


@contextmanager
def threads_for(num_points: int) -> Iterator[None]:
    """Compute a small problem with one thread, then with the user's settings again.

    Threads that wait for each other at every small product are slower than one. PyTorch is limited
    in the calling thread alone, NumPy's and SciPy's libraries in the process, by the first thread.
    """
    with ExitStack() as stack:
        if num_points <= _SMALL:
            stack.callback(_set_own_threads, _set_own_threads(1))
            if _limiting.acquire(blocking=False):
                stack.callback(_limiting.release)
                stack.enter_context(_controller().limit(limits=1, user_api="blas"))
        yield


def _set_own_threads(number: int) -> int:
    """Set the number of threads that PyTorch uses in the calling thread alone; return the last."""
    # PyTorch's own call also sets what new threads begin with; another thread sets that back.
    with _setting, ThreadPoolExecutor(1) as another:
        before = torch.get_num_threads()
        common = another.submit(torch.get_num_threads).result()
        torch.set_num_threads(number)
        another.submit(torch.set_num_threads, common)
    return before
