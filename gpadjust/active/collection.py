"""A collection of measurements: the next points, their results, and a loop."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from functools import partial
from numbers import Real
from typing import Any, Self

import torch
from botorch.acquisition import AcquisitionFunction, AnalyticAcquisitionFunction
from botorch.models.model import Model
from torch import Tensor

from gpadjust.active.keep import Keep
from gpadjust.active.measurement_log import LogError, MeasurementLog, Record
from gpadjust.active.measurements import (
    Measurements,
    as_options,
    check_call,
    checked_outcomes,
    measurement,
    refusal,
)
from gpadjust.active.points import among, best_points, limits_among, sobol_points
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

    Attributes:
        collection: The collection so far.
        X: The points of the last call of the oracle, ``q x d``; none if the next could not be
            chosen.
        result: The values of the oracle, if the collection could not take them.
    """

    def __init__(self, message: str, collection: Collection, X: Tensor, result: Any = None) -> None:
        super().__init__(message, collection, X, result)
        self.collection, self.X, self.result = collection, X, result

    def __str__(self) -> str:
        return str(self.args[0])


class Collection(Measurements, Display):
    """Chooses the points of measurements, for a laboratory or a program.

    :meth:`ask` returns the next points, :meth:`tell` takes results, in any order and for any
    points. :meth:`run` does both with a function that measures. The first points are a scrambled
    Sobol design; later ones maximise the acquisition function of a model of all data so far. Points
    without a result are pending: acquisition functions with ``X_pending`` consider them.

    A log has each measurement and each point that was asked for, as a line of JSON on the disk. A
    new collection with the same log and the same seed continues where the last one stopped, with
    the same next and pending points. One collection at a time holds a log, until :meth:`close` (or
    the end of ``with Collection(...) as collection:``), or until it is out of scope. Nothing in a
    log is executed or unpickled.

    Args:
        model_factory: A callable that makes a new model of ``X``, ``n x d``, and ``Y``, ``n x m``,
            float64, with NaN where an output was not measured, such as
            ``functools.partial(CKA, physics=f_p)``.
        bounds: Bounds of the inputs, ``2 x d``: lower, then upper.
        acquisition: Makes a BoTorch acquisition function of the fitted model.
        batch_size: Number of points that :meth:`ask` returns.
        initial: Number of measurements before the first model, ``data`` included; or the first
            points, ``k x d``, all different, in place of Sobol's. Default: ``2 (d + 1)``.
        data: Earlier measurements ``(X, Y)``. They are not logged: pass them each time.
        keep: Limits of the outputs: a function of outputs ``... x m`` to numbers ``... x c``, each
            at most 0 if permitted, such as ``lambda Y: Y - 3`` for outputs below 3. Points then
            keep all limits with ``probability`` by the model. The first points, in ``initial`` or
            ``data``, must be safe by other knowledge, such as f_p. Default: no limits.
        probability: Probability of a measurement within the limits of ``keep``, noise included.
        fit: Fits a new model, in place. Default: :func:`gpadjust.fit`, for models of this library.
        optimizer_options: Arguments of ``optimize_acqf``, not with ``keep``. Constraints and fixed
            features need first points within them, in ``initial`` or ``data``; later points may
            then be near failed ones.
        log: The file of the log.
        seed: Seed of the design and of the maximisation of the acquisition function. The global
            random state does not change.

    Raises:
        TypeError: If an argument has a wrong type.
        ValueError: If an argument is out of range, or the log belongs to another problem.
        LogError: If another collection holds the log, or it cannot be opened for writing.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.active import Collection, qAdjustmentInformationGain
        >>> factory = partial(CKA, physics=torch.sin)
        >>> collection = Collection(factory, [[0.0], [3.0]], qAdjustmentInformationGain)
        >>> for _ in range(5):
        ...     X = collection.ask()
        ...     collection.tell(X, 2 * torch.sin(X) + X)
        >>> collection.model.num_outputs
        1
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
        fit: Callable[[Any], Any] | None = None,
        optimizer_options: dict[str, Any] | None = None,
        log: str | os.PathLike[str] | None = None,
        seed: int = 0,
    ) -> None:
        if isinstance(model_factory, Model):
            raise TypeError(
                "Expected model_factory to make a new model of all data, got a model; pass "
                f"`functools.partial({type(model_factory).__name__}, ...)`."
            )
        functions = {"model_factory": model_factory, "acquisition": acquisition}
        functions |= {n: f for n, f in {"fit": fit, "keep": keep}.items() if f is not None}
        for name, function in functions.items():
            check_call(name, function)
        if isinstance(acquisition, AcquisitionFunction):
            raise TypeError(
                "Expected acquisition to be a function of each new model, got one of a model; pass "
                f"`lambda model: {type(acquisition).__name__}(model, ...)`."
            )
        structure = partial(model_factory).func
        is_other = isinstance(structure, type) and not hasattr(structure, "log_likelihood")
        if is_other and fit is None:
            raise TypeError(
                f"The default fit takes models of gpadjust; found {model_factory!r}. Pass fit=, a "
                "function that fits a model in place."
            )
        checked_number("probability", probability, above=0, below=1)
        self.keep = None if keep is None else Keep(keep, probability)
        self.model_factory, self.acquisition = model_factory, acquisition
        self.bounds = checked_bounds("bounds", bounds)
        self.batch_size = checked_whole("batch_size", batch_size, 1)
        self.seed = checked_whole("seed", seed, 0)
        d = self.bounds.shape[-1]
        self._options = as_options(optimizer_options)
        limits = limits_among(self._options)
        if keep is not None:
            limits = ["keep"]
        self._has_limits = bool(limits)
        # A model needs a scale, that is two measurements of each output.
        if initial is None:
            initial = 2 if limits else 2 * (d + 1)
        self._first_points = self.bounds[:0]
        if not isinstance(initial, Real | str):
            self._first_points = checked_points("initial", initial, d, self.bounds)
            initial = 2
            if len(self._first_points.unique(dim=0)) < len(self._first_points):
                raise ValueError(
                    "Expected the points of initial to differ, got some twice. To measure a point "
                    "again, pass the result to tell()."
                )
        self._fit = fit or fit_by_default
        self._initial = checked_whole("initial, a number of points,", initial, 2)
        # optimize_acqf has no constraints by a model.
        if keep is not None and self._options:
            raise ValueError(
                f"Expected no optimizer_options with keep, got {sorted(self._options)}: keep takes "
                "the best of random safe points. Leave the options out."
            )
        super().__init__(self.bounds, data)
        # A model that limits points needs measurements within the limits before.
        if limits and len(self._first_points) + self.num_observed < self._initial:
            raise ValueError(
                f"With {' and '.join(limits)}, the first points must be known as safe, by f_p for "
                f"example, or as within the constraints: pass {self._initial} or more as "
                "initial=[[...], ...], or measurements as data=(X, Y); found "
                f"{len(self._first_points)} and {self.num_observed}."
            )
        self._model: Any = None
        if not isinstance(log, str | os.PathLike | None):
            raise TypeError(f"Expected log to be the path of a file, got {log!r}.")
        self.log: MeasurementLog | None = None
        if log is not None:
            self.log = MeasurementLog(log)
            try:
                self._resume(self.log)
            except BaseException:
                self.close()  # the traceback may keep this object alive, and with it the lock
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        """Return the state of the collection in a line."""
        counts = f"{len(self.X)} measurements, {len(self.failed_X)} failed, "
        counts += f"{len(self.pending)} pending"
        if self.keep is not None:
            counts += f", {len(self.left_out)} left out"
        sizes = f"inputs: {self.bounds.shape[-1]}, outputs: {self.num_outputs or 'unknown'}"
        return f"Collection({counts}; {sizes}; {self._log_path()})"

    def _repr_html_(self) -> str:
        """Return the lowest and the highest measurement of each output, and the last one."""
        rows: dict[str, int] = {}
        if len(self.X):
            rows["last"] = len(self.X) - 1
        for j, values in enumerate(self.Y.mT):
            if not values.isnan().all():
                rows[f"lowest y{j + 1}"] = int(values.nan_to_num(nan=torch.inf).argmin())
                rows[f"highest y{j + 1}"] = int(values.nan_to_num(nan=-torch.inf).argmax())
        numbers = torch.cat([self.X, self.Y], -1).tolist()
        head = ["", "number", *(f"x{i + 1}" for i in range(self.X.shape[-1]))]
        head += [f"y{j + 1}" for j in range(self.Y.shape[-1])]
        table = [[name, str(k + 1), *map(number, numbers[k])] for name, k in rows.items()]
        return html_table(repr(self), head, table)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of a copy or a pickle, which does not hold the log."""
        return {**self.__dict__, "log": copy(self.log)}

    @property
    def model(self) -> Any:
        """The model of all data so far, fitted at the first access.

        Raise a RuntimeError if there are fewer than two measurements of an output.
        """
        if self._model is None:  # new data have removed it
            if self.num_observed < 2:
                raise RuntimeError(
                    f"Expected at least 2 measurements of each output, found {self.num_observed}."
                )
            model = make_model(self.model_factory, self.X, self.Y)
            self._fit(model)
            self._model = model
        return self._model

    def ask(self, q: int | None = None) -> Tensor:
        """Choose the points to measure next, ``q x d``, which are pending from now on.

        Raises:
            RuntimeError: If with ``keep`` fewer points are safe, or the first points have too few
                results.
            TypeError: If ``acquisition`` does not make an acquisition function.
            ValueError: If it takes single points, and ``q`` is larger.
            LogError: If the points cannot be logged; then they are not pending.
        """
        if q is None:
            q = self.batch_size
        checked_whole("q", q, 1)
        record: Record = {}
        points = self._design(q)
        if points is None:
            # A seed by the number of calls: a resumed collection returns the same points.
            with seeded((1_000_003 * self.seed + self._num_asks) % 2**63):
                function = self._acquisition_function(q)
                if self.keep is None:
                    points = best_points(function, self, q, self._options)
                else:
                    points, left_out = self.keep.best_points(function, self, q)
                    record = {"left_out": left_out.tolist()}
        self._enter([{"asked": points.tolist(), **record}])
        return points

    def tell(self, X: Tensor, Y: Tensor) -> None:
        """Add results of measurements, at points of :meth:`ask` or others.

        Args:
            X: The points of the measurements, ``n x d``. A point within a hundredth of the bounds'
                widths of a pending one counts as that one.
            Y: The results, ``n x m`` or ``n``. NaN or infinity stand for a missing output; a row of
                these alone is a failed measurement.

        Raises:
            ValueError: If shapes disagree; a TypeError if there are no numbers.
            LogError: If they cannot be logged, and are then not in the collection.
        """
        X = checked_points("X", X, self.bounds.shape[-1])
        Y = checked_outcomes(Y, len(X), self.num_outputs)
        self._enter([measurement(x, y) for x, y in zip(X.tolist(), Y.tolist(), strict=True)])

    def fail(self, X: Tensor, reason: str) -> None:
        """Record failed measurements at points ``n x d``, which are not asked for again."""
        X = checked_points("X", X, self.bounds.shape[-1])
        self._enter([{"x": x, "failed": reason} for x in X.tolist()])

    def withdraw(self) -> None:
        """Withdraw all pending points; :meth:`ask` may return them again."""
        self._enter([{"withdrawn": self.pending.tolist()}])

    def run(
        self,
        oracle: Callable[[Tensor], Any],
        budget: int,
        *,
        progress: bool = False,
        max_failures: int = 5,
    ) -> Self:
        """Measure with an oracle until a budget is spent, pending points first.

        A measurement fails if the oracle raises an exception, which concerns the whole batch, or
        returns only NaN and infinity for a point. It is logged with its message, with a warning,
        and counts against the budget; later points keep a hundredth of the bounds' widths away.

        Args:
            oracle: Maps points ``q x d`` to measured values ``q x m`` (or ``q``).
            budget: Number of all measurements, including failures and the log, but not ``data``.
            progress: If True, show a progress bar.
            max_failures: Number of successive calls without any result after which to stop.

        Raises:
            LogError: If the log cannot be written.
            CollectionError: If the oracle fails too often, or its result cannot be measured values
                or cannot be logged: the error has it as ``result``, and the points are still
                pending. Also if, after the first measurement, the next points cannot be chosen.
        """
        if not callable(oracle):
            raise TypeError(f"Expected the oracle to be callable, got {oracle!r}.")
        checked_whole("budget", budget, 1)
        checked_whole("max_failures", max_failures, 1)
        done = min(budget, self.num_measured)
        failures = 0
        with progress_bar(progress, total=budget, initial=done, unit="measurement") as bar:
            while self.num_measured < budget:
                q = min(self.batch_size, budget - self.num_measured)
                # Pending points come first: a killed run has measured them or not.
                X = self._next_points(q)
                num_before = len(self.X)
                error = self._measure(oracle, X)
                # Single failures are skipped; many in a row are a broken oracle.
                bar.update(len(X))
                bar.set_postfix(failed=len(self.failed_X))
                failures += 1
                if len(self.X) > num_before:
                    failures = 0
                if failures >= max_failures:
                    message = (
                        f"The oracle failed {failures} times in a row, the last time at "
                        f"{X.tolist()}: {error or 'NaN or infinity'}. {len(self.X)} measurements "
                        f"are in the error's `.collection`; {self._log_path()}."
                    )
                    raise CollectionError(message, self, X) from error
        return self

    def close(self) -> None:
        """Release the log; :meth:`tell` locks it again, unless another collection wrote to it."""
        if self.log is not None:
            self.log.close()

    def _next_points(self, q: int) -> Tensor:
        """Return pending points, or those of :meth:`ask`; its errors do not lose measurements."""
        if len(self.pending):
            return self.pending[:q]
        try:
            return self.ask(q)
        except Exception as error:
            # A log has all measurements.
            if isinstance(error, LogError) or not self.num_measured:
                raise
            message = (
                f"The next points could not be chosen ({type(error).__name__}: {error}). The "
                f"{len(self.X)} measurements are in this error's `.collection`; "
                f"{self._log_path()}. To continue, correct the call, and pass "
                "data=(collection.X, collection.Y), or the same log."
            )
            raise CollectionError(message, self, self.pending) from error

    def _design(self, q: int) -> Tensor | None:
        """Return the next points of the design, ``q x d``, or None if a model chooses."""
        earlier = torch.cat([self.X, self.failed_X, self._asked])
        first = self._first_points[~among(self._first_points, earlier)]
        if not len(first) and len(self.X) >= self._initial and self.num_observed >= 2:
            return None
        if self._has_limits:  # Sobol points may be outside
            if len(first):
                return first[:q]
            raise RuntimeError(
                "Expected two measurements of each output, as later points need a model that keeps "
                f"the limits; found {self.num_observed}. Of the first points, {len(self.pending)} "
                "are pending: tell() their results first, or measurements at other safe points."
            )
        return torch.cat([first, sobol_points(self.bounds, q, earlier, self.seed)])[:q]

    def _acquisition_function(self, q: int) -> AcquisitionFunction:
        """Return the user's acquisition function of the model, checked."""
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
        """Log records, then apply them, and warn of failed measurements."""
        num_before = len(self.X)
        if self.log is not None:  # first, as a power cut may follow
            self.log.append(records)
        for record in records:
            self._take(record)
        if len(self.X) > num_before:
            self._model = None
        failed = [record for record in records if "failed" in record]
        if failed:
            message = (
                f"{len(failed)} of {len(records)} measurements failed, the first at x = "
                f"{failed[0]['x']}: {failed[0]['failed']}. They count against a budget, and "
                "ask() does not return them again."
            )
            warnings.warn(message, MeasurementWarning, stacklevel=3)

    def _resume(self, log: MeasurementLog) -> None:
        """Apply the records of the log."""
        for line, record in enumerate(log.open(self.bounds.tolist()), start=2):
            try:
                self._take(record)
            except (KeyError, TypeError, ValueError, RuntimeError) as error:
                m = self.num_outputs or "any number of"
                raise ValueError(
                    f"Line {line} of the log {log.path}, {str(record)[:80]}, does not belong to "
                    f"this collection of {self.bounds.shape[-1]} inputs and {m} outputs "
                    f"({type(error).__name__}: {error}). Remove it, or name another file."
                ) from error

    def _measure(self, oracle: Callable[[Tensor], Any], X: Tensor) -> Exception | None:
        """Measure points and add the results; return the error of the oracle, if any."""
        try:
            result = oracle(X.clone())  # an oracle may change its argument
        except Exception as error:
            self.fail(X, f"{type(error).__name__}: {error}")
            return error
        try:
            Y = checked_outcomes(result, len(X), self.num_outputs)
        except (TypeError, ValueError) as error:
            # Measurements may be expensive: a human may recover them from the log.
            if self.log is not None:
                with suppress(LogError):
                    self.log.append([refusal(X, result, error)])
            message = (
                f"The oracle returned no measured values for the points {X.tolist()}: {error} The "
                f"result is in this error's `.result`; {self._log_path()}. The points are still "
                "pending: tell() `.collection` their values, correct the oracle, and run it again. "
                "An oracle reports a failure by an exception or by NaN."
            )
            raise CollectionError(message, self, X, result) from error
        try:
            self.tell(X, Y)
        except LogError as error:
            message = f"The values measured are in this error's `.result`. {error}"
            raise CollectionError(message, self, X, result) from error
        return None

    def _log_path(self) -> str:
        """Return a clause with the path of the log."""
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
    """Measure at the most informative points, until the budget is spent.

    This makes a :class:`Collection` with ``options``, calls :meth:`~Collection.run`, closes and
    returns it, with their arguments, errors and warnings. With a log the same call continues after
    an interruption, or with a larger budget.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.active import collect, qAdjustmentInformationGain
        >>> problem = partial(CKA, physics=torch.sin), lambda X: 2 * X.sin() + X, [[0.0], [3.0]]
        >>> collect(*problem, qAdjustmentInformationGain, budget=5).Y.shape
        torch.Size([5, 1])
    """
    with Collection(model_factory, bounds, acquisition, **options) as collection:
        return collection.run(oracle, budget, progress=progress, max_failures=max_failures)
