"""The loop of asking, measuring and telling."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from torch import Tensor
from tqdm import tqdm

from gpadjust.active.arguments import as_outcomes
from gpadjust.active.measurement_log import LogError
from gpadjust.active.measurements import refusal
from gpadjust.models.sampled_functions import check_number

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


def measure_on(
    collection: Collection,
    oracle: Callable[[Tensor], Any],
    budget: int,
    progress: bool,
    max_failures: int,
) -> None:
    """Do what :meth:`~gpadjust.active.Collection.run` says."""
    if not callable(oracle):
        raise TypeError(f"Expected the oracle to be callable, got {oracle!r}.")
    check_number(budget, "budget")
    check_number(max_failures, "max_failures")
    done, failures = min(budget, collection.num_measured), 0
    with tqdm(total=budget, initial=done, unit="measurement", disable=not progress) as bar:
        while (left := budget - collection.num_measured) > 0:
            q = min(collection.batch_size, left)
            # After a resumption the points that it was killed at come first.
            X = collection.pending[:q] if len(collection.pending) else collection.ask(q)
            known = len(collection.X)
            error = _measure(collection, oracle, X)
            bar.update(len(X))
            bar.set_postfix(failed=len(collection.failed_X))
            failures = 0 if len(collection.X) > known else failures + 1
            if failures >= max_failures:
                raise CollectionError(
                    f"The oracle failed {failures} times in a row, the last time at "
                    f"{X.tolist()}: {error or 'NaN or infinity'}. {len(collection.X)} measurements "
                    f"are in the error's `.collection`; {_place(collection)}.",
                    collection,
                    X,
                ) from error


def _measure(
    collection: Collection, oracle: Callable[[Tensor], Any], X: Tensor
) -> Exception | None:
    """Measure points and tell them; return what went wrong."""
    try:
        result = oracle(X.clone())
    except Exception as error:
        collection.fail(X, error)
        return error
    try:
        Y = as_outcomes(result, len(X), collection.num_outputs)
    except (TypeError, ValueError) as error:
        if collection.log is not None:
            with suppress(LogError):
                collection.log.append([refusal(X, result, error)])
        raise CollectionError(
            f"The oracle returned no measured values of the points {X.tolist()}: {error} It is in "
            f"this error's `.result`; {_place(collection)}. The points are still pending: tell() "
            "`.collection` their values, mend the oracle, and run it again. To say that a "
            "measurement failed, it may raise an exception or return NaN.",
            collection,
            X,
            result,
        ) from error
    try:
        collection.tell(X, Y)
    except LogError as error:
        message = f"The values measured are in this error's `.result`. {error}"
        raise CollectionError(message, collection, X, result) from error
    return None


def _place(collection: Collection) -> str:
    """Where the log is."""
    return "no log was kept" if collection.log is None else f"the log is at {collection.log.path}"
