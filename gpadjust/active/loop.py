"""The loop of asking, measuring and telling."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from botorch.acquisition import AcquisitionFunction
from botorch.models.model import Model
from torch import Tensor
from tqdm import tqdm

from gpadjust.active.arguments import as_outcomes
from gpadjust.active.collection import Collection
from gpadjust.models.sampled_functions import check_number


class CollectionError(RuntimeError):
    """Measuring failed too often. ``collection`` holds what was measured.

    Args:
        message: What happened.
        collection: The collection so far.
    """

    def __init__(self, message: str, collection: Collection) -> None:
        super().__init__(message)
        self.collection = collection


def collect(
    model_factory: Callable[[Tensor, Tensor], Model],
    oracle: Callable[[Tensor], Any],
    bounds: Tensor | list[list[float]],
    acquisition: Callable[[Any], AcquisitionFunction],
    budget: int,
    *,
    batch_size: int = 1,
    initial: int | Tensor | None = None,
    data: tuple[Tensor, Tensor] | None = None,
    num_outputs: int | None = None,
    fit: Callable[[Any], Any] | None = None,
    optimizer_options: dict[str, Any] | None = None,
    log: str | os.PathLike[str] | None = None,
    seed: int = 0,
    progress: bool = False,
    max_failures: int = 5,
) -> Collection:
    """Measure where it teaches most, until the budget is spent.

    A :class:`Collection` chooses the points, and its log makes the loop resumable: called again
    with the same arguments it goes on where it was killed, first with the points it was killed at.

    A measurement that fails (the oracle raises an exception or returns a wrong shape, or nothing
    but NaN and infinity) is logged with its message and skipped, with a warning. It counts against
    the budget, and no point within a hundredth of the bounds' widths of it is asked for again. An
    exception fails the whole batch. Where some outputs are NaN, each output is learnt from its own
    measurements.

    Args:
        model_factory: As of :class:`Collection`.
        oracle: Measures: maps points ``q x d`` to values ``q x m`` (or ``q``).
        bounds: Bounds of the inputs, ``2 x d``: lower, then upper.
        acquisition: Makes a BoTorch acquisition function of the fitted model, such as a class.
        budget: Number of measurements in all: failed ones and those of the log included, those of
            ``data`` not.
        batch_size: Number of points that are measured at a time.
        initial: As of :class:`Collection`.
        data: As of :class:`Collection`.
        num_outputs: As of :class:`Collection`.
        fit: As of :class:`Collection`.
        optimizer_options: As of :class:`Collection`.
        log: As of :class:`Collection`.
        seed: As of :class:`Collection`.
        progress: Whether to show a progress bar.
        max_failures: Number of calls of the oracle, in a row and without any result, that stop it.

    Returns:
        The collection, with all data in ``X`` and ``Y``, the ``model`` of them, ``failed_X``, and
        ``ask`` and ``tell`` to go on with.

    Raises:
        TypeError: As :class:`Collection`, or if the oracle is not callable.
        ValueError: As :class:`Collection`, or if a number is out of range.
        CollectionError: If the oracle fails too often.

    Warns:
        MeasurementWarning: If a measurement fails.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.active import collect, qAdjustmentInformationGain
        >>> result = collect(
        ...     lambda X, Y: CKA(X, Y, physics=torch.sin),
        ...     oracle=lambda X: 2 * torch.sin(X) + X,
        ...     bounds=[[0.0], [3.0]],
        ...     acquisition=qAdjustmentInformationGain,
        ...     budget=6,
        ...     batch_size=2,
        ...     optimizer_options={"num_restarts": 2, "raw_samples": 16},
        ... )
        >>> result.Y.shape
        torch.Size([6, 1])
    """
    if not callable(oracle):
        raise TypeError(f"Expected the oracle to be callable, got {oracle!r}.")
    check_number(budget, "budget")
    check_number(max_failures, "max_failures")
    collection = Collection(
        model_factory,
        bounds,
        acquisition,
        batch_size=batch_size,
        initial=initial,
        data=data,
        num_outputs=num_outputs,
        fit=fit,
        optimizer_options=optimizer_options,
        log=log,
        seed=seed,
    )
    failures = 0
    with _bar(budget, collection) if progress else nullcontext() as bar:
        while (left := budget - collection.num_measured) > 0:
            q = min(batch_size, left)
            # After a resumption the points that it was killed at come first.
            X = collection.pending[:q] if len(collection.pending) else collection.ask(q)
            known = len(collection.X)
            error = _measure(collection, oracle, X)
            if bar is not None:
                bar.update(len(X))
                bar.set_postfix(failed=len(collection.failed_X))
            failures = 0 if len(collection.X) > known else failures + 1
            if failures >= max_failures:
                place = "no log was kept" if log is None else f"the log is at {os.fspath(log)}"
                raise CollectionError(
                    f"The oracle failed {failures} times in a row, the last time at "
                    f"{X.tolist()}: {error or 'NaN or infinity'}. "
                    f"{len(collection.X)} measurements are in the error's `.collection`; {place}.",
                    collection,
                ) from error
    return collection


def _measure(
    collection: Collection, oracle: Callable[[Tensor], Any], X: Tensor
) -> Exception | None:
    """Measure points and tell them; return what went wrong."""
    try:
        Y = as_outcomes(oracle(X.clone()), len(X), collection.num_outputs)
    except Exception as error:
        collection.fail(X, f"{type(error).__name__}: {error}")
        return error
    collection.tell(X, Y)
    return None


def _bar(total: int, collection: Collection) -> Any:
    """A progress bar."""
    return tqdm(total=total, initial=min(total, collection.num_measured), unit="measurement")
