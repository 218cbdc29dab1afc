"""The loop of asking, measuring and telling."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Self

from torch import Tensor
from tqdm import tqdm

from gpadjust.active.measurement_log import LogError, MeasurementLog
from gpadjust.active.measurements import Measurements, checked_outcomes, refusal
from gpadjust.checks import checked_whole


class CollectionError(RuntimeError):
    """A run stopped before its budget was spent.

    Args:
        message: What happened.
        collection: The collection so far.
        X: The points that were being measured, ``q x d``.
        result: What the oracle returned for them, if the collection could not take it.
    """

    def __init__(self, message: str, collection: Loop, X: Tensor, result: Any = None) -> None:
        super().__init__(message, collection, X, result)
        self.collection, self.X, self.result = collection, X, result

    def __str__(self) -> str:
        return str(self.args[0])


class Loop(Measurements, ABC):
    """Asks, measures and tells, whoever says where to measure next."""

    batch_size: int
    log: MeasurementLog | None

    @abstractmethod
    def ask(self, q: int | None = None) -> Tensor:
        """Say where to measure next, ``q x d``."""

    @abstractmethod
    def tell(self, X: Tensor, Y: Tensor) -> None:
        """Take measurements."""

    @abstractmethod
    def fail(self, X: Tensor, reason: str | Exception) -> None:
        """Take it that measurements failed."""

    def run(
        self,
        oracle: Callable[[Tensor], Any],
        budget: int,
        *,
        progress: bool = False,
        max_failures: int = 5,
    ) -> Self:
        """Ask, measure and tell, until a budget is spent; points that are pending come first.

        A measurement that fails (the oracle raises an exception, or returns nothing but NaN and
        infinity) is logged with its message and skipped, with a warning. It counts against the
        budget, and no point within a hundredth of the bounds' widths of it is asked for again. An
        exception fails the whole batch. Where some outputs are NaN, each output is learnt from its
        own measurements.

        Args:
            oracle: Measures: maps points ``q x d`` to values ``q x m`` (or ``q``).
            budget: Number of measurements in all: failed ones and those of the log included, those
                of ``data`` not.
            progress: Whether to show a progress bar.
            max_failures: Number of calls of the oracle, in a row and without any result, that stop
                it.

        Returns:
            This collection.

        Raises:
            TypeError: If the oracle is not callable.
            ValueError: If a number is out of range.
            LogError: If the log cannot be written.
            CollectionError: If the oracle fails too often, or what it returns can be no measured
                values or cannot be logged: it is in the error's ``result`` then, and the points
                are still pending.

        Warns:
            MeasurementWarning: If a measurement fails.
        """
        if not callable(oracle):
            raise TypeError(f"Expected the oracle to be callable, got {oracle!r}.")
        checked_whole("budget", budget, 1)
        checked_whole("max_failures", max_failures, 1)
        done, failures = min(budget, self.num_measured), 0
        with tqdm(total=budget, initial=done, unit="measurement", disable=not progress) as bar:
            while (left := budget - self.num_measured) > 0:
                q = min(self.batch_size, left)
                # After a resumption the points that it was killed at come first.
                X = self.pending[:q] if len(self.pending) else self.ask(q)
                known = len(self.X)
                error = self._measure(oracle, X)
                bar.update(len(X))
                bar.set_postfix(failed=len(self.failed_X))
                failures = 0 if len(self.X) > known else failures + 1
                if failures >= max_failures:
                    raise CollectionError(
                        f"The oracle failed {failures} times in a row, the last time at "
                        f"{X.tolist()}: {error or 'NaN or infinity'}. {len(self.X)} measurements "
                        f"are in the error's `.collection`; {self._place()}.",
                        self,
                        X,
                    ) from error
        return self

    def _measure(self, oracle: Callable[[Tensor], Any], X: Tensor) -> Exception | None:
        """Measure points and tell them; return what went wrong."""
        try:
            result = oracle(X.clone())
        except Exception as error:
            self.fail(X, error)
            return error
        try:
            Y = checked_outcomes(result, len(X), self.num_outputs)
        except (TypeError, ValueError) as error:
            if self.log is not None:
                with suppress(LogError):
                    self.log.append([refusal(X, result, error)])
            raise CollectionError(
                f"The oracle returned no measured values of the points {X.tolist()}: {error} It is "
                f"in this error's `.result`; {self._place()}. The points are still pending: tell() "
                "`.collection` their values, mend the oracle, and run it again. To say that a "
                "measurement failed, it may raise an exception or return NaN.",
                self,
                X,
                result,
            ) from error
        try:
            self.tell(X, Y)
        except LogError as error:
            message = f"The values measured are in this error's `.result`. {error}"
            raise CollectionError(message, self, X, result) from error
        return None

    def _place(self) -> str:
        """Where the log is."""
        return "no log was kept" if self.log is None else f"the log is at {self.log.path}"
