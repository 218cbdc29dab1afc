"""A collection of measurements, by asking and telling or by a loop."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from numbers import Real
from typing import Any, Self

import torch
from botorch.acquisition import AcquisitionFunction, AnalyticAcquisitionFunction
from torch import Tensor

from gpadjust.active.keep import Keep
from gpadjust.active.measurement_log import LogError, MeasurementLog, Record
from gpadjust.active.measurements import (
    Measurements,
    as_options,
    checked_outcomes,
    measurement,
    refusal,
)
from gpadjust.active.points import among, best_points, sobol_points
from gpadjust.checks import (
    checked_bounds,
    checked_number,
    checked_points,
    checked_whole,
    seeded,
)
from gpadjust.core import fit as fit_by_default
from gpadjust.display import Display, html_table
from gpadjust.kinds.factory import ModelFactory, make_model
from gpadjust.progress import progress_bar
from gpadjust.words import number


class MeasurementWarning(UserWarning):
    """A measurement failed."""


class CollectionError(RuntimeError):
    """A run stopped before its budget was spent.

    Args:
        message: What happened.
        collection: The collection so far.
        X: The points that were being measured, ``q x d``.
        result: The values of the oracle, if the collection could not take them.
    """

    def __init__(self, message: str, collection: Collection, X: Tensor, result: Any = None) -> None:
        super().__init__(message, collection, X, result)
        self.collection, self.X, self.result = collection, X, result

    def __str__(self) -> str:
        return str(self.args[0])


class Collection(Measurements, Display):
    """Chooses where to measure, for a laboratory that measures when it can.

    :meth:`ask` says where, :meth:`tell` takes what came out, in any order and for any points; where
    a program can measure, :meth:`run` does both. The first points are a scrambled Sobol design;
    later ones maximise the acquisition function of a model of all data so far. Points that were
    asked for and not yet told are pending: acquisition functions that take ``X_pending`` count on
    them.

    With a log, each measurement is on the disk before :meth:`tell` does anything else, as a line of
    JSON; so are the points asked for, before :meth:`ask` returns them. A new collection with the
    same log goes on where the last one stopped, asks for the same points (with the same seed), and
    has the same points pending. One collection at a time holds a log, until :meth:`close` (or the
    end of ``with Collection(...) as collection:``), until it is out of scope, or until its process
    ends. Nothing in a log is executed or unpickled: one from a stranger can be wrong, but does no
    harm.

    Args:
        model_factory: A callable that makes a new model of ``X``, ``n x d``, and ``Y``, ``n x m``,
            float64, with NaN where an output was not measured, such as
            ``functools.partial(CKA, physics=f_p)``.
        bounds: Bounds of the inputs, ``2 x d``: lower, then upper.
        acquisition: Makes a BoTorch acquisition function of the fitted model.
        batch_size: Number of points that :meth:`ask` returns.
        initial: Number of measurements, those of ``data`` included, before the first model; or the
            first points, ``k x d``, no two alike, in place of Sobol's. Default: ``2 (d + 1)``.
        data: ``(X, Y)`` measured before. They are not logged: give them each time.
        keep: Numbers ``... x c`` of outputs ``... x m``, each of which is to be at most 0, such as
            ``lambda Y: Y - 3`` for outputs below 3: measurements are made only where the model says
            so with a ``probability``. First points, of ``initial`` or ``data``, are then to be
            given, safe by what you know, such as f_p; they are not checked. Default: no limits.
        probability: That of a measurement, noise included, being within the limits of ``keep``.
        num_outputs: Number ``m`` of outputs. Default: that of the first measurement.
        fit: Fits a new model, in place. Default: :func:`gpadjust.fit`, for models of this library.
        optimizer_options: Arguments of ``optimize_acqf``, which ``keep`` does without.
        log: The file of the log.
        seed: Seed of the design and of the acquisition function's maximisation. The global random
            state is left alone.

    Raises:
        TypeError: If ``model_factory``, ``acquisition`` or ``fit`` is not callable, or another
            argument is of a wrong type.
        ValueError: If an argument is out of range, or the log is of another problem.
        LogError: If the log is held by another collection, or cannot be opened for writing.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.active import Collection, qAdjustmentInformationGain
        >>> collection = Collection(
        ...     partial(CKA, physics=torch.sin),
        ...     bounds=[[0.0], [3.0]],
        ...     acquisition=lambda model: qAdjustmentInformationGain(model, about="rho"),
        ... )
        >>> for _ in range(5):
        ...     X = collection.ask()
        ...     collection.tell(X, 2 * torch.sin(X) + X)
        >>> collection.X.shape, collection.model.num_outputs
        (torch.Size([5, 1]), 1)
    """

    def __init__(
        self,
        model_factory: ModelFactory,
        bounds: Tensor | list[list[float]],
        acquisition: Callable[[Any], AcquisitionFunction],
        *,
        batch_size: int = 1,
        initial: int | Tensor | list[list[float]] | None = None,
        data: tuple[Tensor, Tensor] | None = None,
        keep: Callable[[Tensor], Tensor] | None = None,
        probability: float = 0.95,
        num_outputs: int | None = None,
        fit: Callable[[Any], Any] | None = None,
        optimizer_options: dict[str, Any] | None = None,
        log: str | os.PathLike[str] | None = None,
        seed: int = 0,
    ) -> None:
        for name, given in (("model_factory", model_factory), ("acquisition", acquisition)):
            if not callable(given):
                raise TypeError(f"Expected {name} to be callable, got {given!r}.")
        if isinstance(acquisition, AcquisitionFunction):
            kind = type(acquisition).__name__
            raise TypeError(
                "Expected acquisition to be a function that makes an acquisition function of each "
                f"new model, got one of a model; pass `lambda model: {kind}(model, ...)`."
            )
        for name, option in (("fit", fit), ("keep", keep)):
            if option is not None and not callable(option):
                raise TypeError(f"Expected {name} to be callable, got {option!r}.")
        checked_number("probability", probability, above=0, below=1)
        self.keep = None if keep is None else Keep(keep, probability)
        self.model_factory, self.acquisition = model_factory, acquisition
        self.bounds = checked_bounds("bounds", bounds)
        d = self.bounds.shape[-1]
        checked_whole("batch_size", batch_size, 1)
        self.batch_size, self.seed = batch_size, checked_whole("seed", seed, 0)
        if initial is None:
            initial = 2 * (d + 1) if keep is None else 2
        self._first_points = self.bounds[:0]
        if not isinstance(initial, Real | str):
            self._first_points = checked_points("initial", initial, d, self.bounds)
            initial = 2
            if len(self._first_points.unique(dim=0)) < len(self._first_points):
                raise ValueError(
                    "Expected the points of initial to differ, got some twice. To measure a point "
                    "again, tell() what came out."
                )
        self._fit = fit or fit_by_default
        self._initial = checked_whole("initial, a number of points,", initial, 2)
        self._options = as_options(optimizer_options)
        if keep is not None and self._options:
            raise ValueError(
                f"Expected no optimizer_options with keep, got {sorted(self._options)}: the best "
                "of random points that are safe is taken, without optimize_acqf. Leave them out."
            )
        if num_outputs is not None:
            checked_whole("num_outputs", num_outputs, 1)
        super().__init__(self.bounds, num_outputs, data)
        if keep is not None and len(self._first_points) + self.num_observed < 2:
            raise ValueError(
                "With keep, the first points must be known as safe, by f_p for example: give two "
                "or more as initial=[[...], ...], or measurements as data=(X, Y); found "
                f"{len(self._first_points)} and {self.num_observed}."
            )
        self._model: Any = None
        if not isinstance(log, str | os.PathLike | None):
            raise TypeError(f"Expected log to be the path of a file, got {log!r}.")
        self.log = None if log is None else MeasurementLog(log)
        if self.log is not None:
            try:
                self._resume(self.log)
            except BaseException:
                self.close()  # what is raised may keep this half of a collection alive
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        """Return the state of the collection in a line."""
        m = "unknown" if self.num_outputs is None else self.num_outputs
        left = "" if self.keep is None else f", {len(self.left_out)} left out"
        return (
            f"Collection({len(self.X)} measurements, {len(self.failed_X)} failed, "
            f"{len(self.pending)} pending{left}; inputs: {self.bounds.shape[-1]}, outputs: {m}; "
            f"{self._place()})"
        )

    def _repr_html_(self) -> str:
        """Return the lowest and the highest measurement of each output, and the last one."""
        rows = {"last": len(self.X) - 1} if len(self.X) else {}
        for j, values in enumerate(self.Y.mT):
            if not values.isnan().all():
                rows[f"lowest y{j + 1}"] = int(values.nan_to_num(nan=torch.inf).argmin())
                rows[f"highest y{j + 1}"] = int(values.nan_to_num(nan=-torch.inf).argmax())
        numbers = torch.cat([self.X, self.Y], -1).tolist()
        inputs, outputs = self.X.shape[-1], self.Y.shape[-1]
        head = ["", "number"]
        head += [f"x{i + 1}" for i in range(inputs)] + [f"y{j + 1}" for j in range(outputs)]
        table = [[name, str(k + 1), *map(number, numbers[k])] for name, k in rows.items()]
        return html_table(repr(self), head, table)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of a copy or a pickle, whose log is its own and not held."""
        return {**self.__dict__, "log": copy(self.log)}

    @property
    def model(self) -> Any:
        """The model of all data so far, fitted when it is asked for first.

        Raises:
            RuntimeError: If there are fewer than two measurements of an output.
            TypeError: If ``model_factory`` makes no model.
        """
        if self._model is None:
            if self.num_observed < 2:
                raise RuntimeError(
                    f"A model needs at least 2 measurements of each output, there are "
                    f"{self.num_observed}."
                )
            model = make_model(self.model_factory, self.X, self.Y)
            self._fit(model)
            self._model = model
        return self._model

    def ask(self, q: int | None = None) -> Tensor:
        """Choose the points to measure next.

        Args:
            q: Number of points. Default: ``batch_size``.

        Returns:
            The points, ``q x d``, which are pending from now on.

        Raises:
            RuntimeError: If with ``keep`` fewer points are safe, or the first ones are pending or
                told too little.
            TypeError: If ``acquisition`` makes no acquisition function.
            ValueError: If it takes single points, and ``q`` is larger.
            LogError: If the points cannot be logged; then they are not pending.
        """
        q = self.batch_size if q is None else q
        checked_whole("q", q, 1)
        record: Record = {}
        points = self._design(q)
        if points is None:
            with seeded((1_000_003 * self.seed + self._num_asks) % 2**63):
                function = self._acquisition_function(q)
                taken = self.pending, self.failed_X
                if self.keep is None:
                    points = best_points(function, self.bounds, q, *taken, self._options)
                else:
                    points, left_out = self.keep.best_points(
                        function, self.model, self.bounds, q, self.X, *taken
                    )
                    record = {"left_out": left_out.tolist()}
        self._enter([{"asked": points.tolist(), **record}])
        return points

    def tell(self, X: Tensor, Y: Tensor) -> None:
        """Take measurements, of points asked for or of others.

        Args:
            X: The points, ``n x d``, as they were measured: one that is within a hundredth of the
                bounds' widths of a pending one counts as that.
            Y: What was measured, ``n x m`` or ``n``. NaN or infinity stand for an output that was
                not; a row of nothing else has failed.

        Raises:
            TypeError: If they are no numbers.
            ValueError: If shapes disagree.
            LogError: If they cannot be logged. They are in neither the log nor the collection
                then; tell them again.

        Warns:
            MeasurementWarning: If one of them has failed.
        """
        X = checked_points("X", X, self.bounds.shape[-1])
        Y = checked_outcomes(Y, len(X), self.num_outputs)
        self._enter([measurement(x, y) for x, y in zip(X.tolist(), Y.tolist(), strict=True)])

    def fail(self, X: Tensor, reason: str | Exception) -> None:
        """Record that measurements failed. Their points are not asked for again.

        Args:
            X: The points, ``n x d``.
            reason: Why.

        Warns:
            MeasurementWarning: In any case.
        """
        X = checked_points("X", X, self.bounds.shape[-1])
        message = reason if isinstance(reason, str) else f"{type(reason).__name__}: {reason}"
        self._enter([{"x": x, "failed": message} for x in X.tolist()])

    def withdraw(self, X: Tensor | None = None) -> None:
        """Withdraw pending points, which will not be measured, but may be asked for again.

        Args:
            X: The points, ``n x d``. Default: all that are pending.
        """
        X = self.pending if X is None else checked_points("X", X, self.bounds.shape[-1])
        self._enter([{"withdrawn": X.tolist()}])

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
        with progress_bar(progress, total=budget, initial=done, unit="measurement") as bar:
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

    def close(self) -> None:
        """Let another collection have the log; :meth:`tell` takes it again, if none has written."""
        if self.log is not None:
            self.log.close()

    def _design(self, q: int) -> Tensor | None:
        """Return the next points that need no model, ``q x d``, or None if a model is to choose."""
        known = torch.cat([self.X, self.failed_X, self._asked])
        first = self._first_points[~among(self._first_points, known)]
        if not len(first) and len(self.X) >= self._initial and self.num_observed >= 2:
            return None
        if self.keep is not None:
            if len(first):
                return first[:q]
            if len(self.pending):
                raise RuntimeError(
                    f"All first points are asked for, and {len(self.pending)} of them are pending: "
                    "tell() these first, as later points are chosen by a model of what came out."
                )
            raise RuntimeError(
                f"{self.num_observed} measurements came of the first points, but a model that is "
                "to keep limits needs two of each output; tell others that are safe."
            )
        return torch.cat([first, sobol_points(self.bounds, q, known, self.seed)])[:q]

    def _acquisition_function(self, q: int) -> AcquisitionFunction:
        """Return the user's acquisition function of the model."""
        function = self.acquisition(self.model)
        if not isinstance(function, AcquisitionFunction):
            raise TypeError(
                "Expected acquisition(model) to be a BoTorch AcquisitionFunction, got "
                f"{type(function).__name__}."
            )
        if q > 1 and isinstance(function, AnalyticAcquisitionFunction):
            raise ValueError(
                f"{type(function).__name__} takes one point at a time, got q = {q}: set "
                "batch_size=1, or take the acquisition function whose name begins with q."
            )
        return function

    def _enter(self, records: list[Record]) -> None:
        """Log records, take them in, and warn of measurements that failed."""
        known = len(self.X)
        if self.log is not None:
            self.log.append(records)
        for record in records:
            self._take(record)
        self._model = None if len(self.X) > known else self._model
        if failed := [record for record in records if "failed" in record]:
            warnings.warn(
                f"{len(failed)} of {len(records)} measurements failed, the first at x = "
                f"{failed[0]['x']}: {failed[0]['failed']}. They count against a budget, and are "
                "not asked for again.",
                MeasurementWarning,
                stacklevel=3,
            )

    def _resume(self, log: MeasurementLog) -> None:
        """Take in what is in the log."""
        for line, record in enumerate(log.open(self.bounds.tolist()), start=2):
            try:
                self._take(record)
            except (KeyError, TypeError, ValueError, RuntimeError) as error:
                m = "any number of" if self.num_outputs is None else self.num_outputs
                raise ValueError(
                    f"Line {line} of the log {log.path}, {str(record)[:80]}, does not belong to "
                    f"this collection of {self.bounds.shape[-1]} inputs and {m} outputs "
                    f"({type(error).__name__}: {error}). Remove it, or name another file."
                ) from error

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
                "`.collection` their values, correct the oracle, and run it again. To say that a "
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
        """Return the place of the log."""
        return "no log was kept" if self.log is None else f"the log is at {self.log.path}"


def collect(
    model_factory: ModelFactory,
    oracle: Callable[[Tensor], Any],
    bounds: Tensor | list[list[float]],
    acquisition: Callable[[Any], AcquisitionFunction],
    budget: int,
    *,
    progress: bool = False,
    max_failures: int = 5,
    **options: Any,
) -> Collection:
    """Measure where it teaches most, until the budget is spent.

    It makes a :class:`Collection` with ``options``, lets it :meth:`~Collection.run`, and closes it:
    arguments, errors and warnings are those of the two. With a log the same call goes on where the
    last one was killed, or with a larger budget.

    Returns:
        The collection, with all data in ``X`` and ``Y``, the ``model`` of them, ``failed_X``, and
        ``ask``, ``tell`` and ``run`` to go on with.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.active import collect, qAdjustmentInformationGain
        >>> result = collect(
        ...     partial(CKA, physics=torch.sin),
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
    with Collection(model_factory, bounds, acquisition, **options) as collection:
        return collection.run(oracle, budget, progress=progress, max_failures=max_failures)
