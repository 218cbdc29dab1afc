"""Row-by-row calls of a NumPy function, in parallel under ``joblib.parallel_config``."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpadjust.checks import real_array

RowFunction = Callable[..., ArrayLike]


def call_rows(
    function: RowFunction, X: NDArray[np.float64], *more: Sequence[Any]
) -> list[NDArray[np.float64] | Exception]:
    """Calls a function on each row, in parallel if a ``joblib.parallel_config`` says so.

    It maps a row ``(d,)``, and ``more`` for each, to a scalar or ``(m,)``. For each row there are
    its outputs ``(m,)``, or the exception it raised.

    Example:
        >>> call_rows(lambda x: 1 / int(x[0]), np.array([[2.0], [0.0]]))
        [array([0.5]), ZeroDivisionError('division by zero')]
    """
    from joblib import Parallel, delayed  # slow to import

    results: list[NDArray[np.float64] | Exception] = Parallel(n_jobs=None)(
        delayed(_call_row)(function, *row) for row in zip(X, *more, strict=True)
    )
    return results


def _call_row(function: RowFunction, *row: Any) -> NDArray[np.float64] | Exception:
    try:
        y = np.atleast_1d(real_array(function(*row)))
        if y.ndim > 1:
            raise ValueError(f"expected a scalar or outputs of shape (m,), found {y.shape}")
        return y
    except Exception as error:
        try:  # one that does not survive a pickle would break the pool, and lose the other rows
            pickle.loads(pickle.dumps(error))
        except Exception:
            return RuntimeError(f"{type(error).__name__}: {error}")
        return error
