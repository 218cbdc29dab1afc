"""Measurements: made, failed and pending, with checks of their numbers."""

from __future__ import annotations

import json
import math
from inspect import signature
from typing import Any

import torch
from botorch.optim import optimize_acqf
from botorch.optim.initializers import gen_batch_initial_conditions
from torch import Tensor

from gpadjust.active.measurement_log import Record
from gpadjust.active.points import NEAR, among, distances
from gpadjust.checks import check_observed, checked_points, checked_tensor
from gpadjust.words import plural

_EXAMPLES = {  # of functions, with their numbers of arguments
    "model_factory": (2, "functools.partial(CKA, physics=f_p)"),
    "acquisition": (
        1,
        "lambda model: qLogExpectedImprovement(model, best_f=model.data.Y.max())",
    ),
    "fit": (1, "lambda model: fit(model, num_draws=256)"),
    "keep": (1, "lambda Y: Y - 3"),
}


class Measurements:
    """The state after a sequence of records, new or from a log.

    A record is one of

    - ``{"asked": [x, ...], "left_out": [x, ...]}``: points to measure, and excluded better ones;
    - ``{"x": x, "y": y}``: a measurement, null for a missing output;
    - ``{"x": x, "failed": message}``: a failed measurement, with or without ``"y"``;
    - ``{"withdrawn": [x, ...]}``: pending points that will not be measured;
    - ``{"refused": result, "of": [x, ...], "because": message}``: an invalid result of an oracle.

    A measurement belongs to the nearest pending point within a hundredth of the bounds' widths: a
    laboratory seldom sets inputs to the last digit.

    Attributes:
        X: The measured points, ``n x d``, ``data`` first.
        Y: The measured values, ``n x m``; NaN for a missing output.
        failed_X: Points of failed measurements, ``k x d``.
        pending: Points without a result yet, ``l x d``.
        left_out: Better points that limits excluded, ``k x d``.
        num_measured: Number of measurements, including failures but not ``data``.
        num_outputs: Number ``m`` of outputs; None before the first measurement.
    """

    def __init__(self, bounds: Tensor, data: tuple[Tensor, Tensor] | None) -> None:
        self.bounds = bounds
        # All begin with 0 x d.
        self.X = self.failed_X = self.pending = self.left_out = self._asked = bounds[:0]
        self.Y = torch.zeros(0, 0, dtype=torch.float64)
        self.num_measured = 0
        self.num_outputs: int | None = None
        self._num_asks = 0
        if data is not None:
            if not isinstance(data, tuple | list) or len(data) != 2:
                raise TypeError(f"Expected data to be a pair (X, Y), got {data!r}.")
            X = checked_points("the X of data", data[0], bounds.shape[-1])
            Y = checked_outcomes(data[1], len(X), None)
            check_observed("the Y of data", Y)
            self.X, self.Y = X, Y
            self.num_outputs = Y.shape[-1]

    @property
    def num_observed(self) -> int:
        """Number of measurements of the output with the fewest."""
        return int((~self.Y.isnan()).sum(0).min()) if len(self.X) else 0

    def _take(self, record: Record) -> None:
        """Apply one record."""
        if "refused" in record:
            return
        # `_asked` has all points of the design, so that it does not repeat measured ones.
        if "asked" in record:
            points = self._points(record["asked"])
            self.pending = torch.cat([self.pending, points])
            self._asked = torch.cat([self._asked, points])
            self.left_out = torch.cat([self.left_out, self._points(record.get("left_out", []))])
            self._num_asks += 1
        elif "withdrawn" in record:  # neither pending nor measured
            for x in self._points(record["withdrawn"]):
                point = self._no_longer_pending(x)
                self._asked = self._asked[~among(self._asked, point)]  # it may come again
        else:
            self._take_measurement(record)

    def _take_measurement(self, record: Record) -> None:
        """Apply one measurement."""
        x = self._points([record["x"]])
        if "failed" in record:
            self.failed_X = torch.cat([self.failed_X, x])
        else:
            values = [math.nan if value is None else value for value in record["y"]]
            y = checked_outcomes([values], 1, self.num_outputs)
            check_observed("y", y)
            self.num_outputs = y.shape[-1]
            self.X = torch.cat([self.X, x])
            self.Y = torch.cat([self.Y, y]) if len(self.Y) else y
        self._no_longer_pending(x[0])
        self.num_measured += 1

    def _no_longer_pending(self, x: Tensor) -> Tensor:
        """Remove the pending point at ``x`` and return it, ``1 x d``, or ``0 x d`` if none is."""
        if not len(self.pending):
            return self.pending
        # The nearest one: several may be within the distance.
        distance, i = distances(x, self.pending, self.bounds).min(-1)
        if distance > NEAR:
            return self.pending[:0]
        point = self.pending[i : i + 1]
        self.pending = torch.cat([self.pending[:i], self.pending[i + 1 :]])
        return point

    def _points(self, rows: list[list[float]]) -> Tensor:
        """Return the points of a record, ``n x d``."""
        if not rows:
            return self.X[:0]
        return checked_points("X", rows, self.X.shape[-1])


def refusal(X: Tensor, result: Any, error: Exception) -> Record:
    """Return the record of an invalid result of an oracle for points ``q x d``."""

    def plain(part: Any) -> Any:  # arrays and tensors as lists
        return part.tolist() if hasattr(part, "tolist") else repr(part)

    # Through JSON and back, so that the log can have it; NaN becomes a text.
    try:
        result = json.loads(json.dumps(result, default=plain), parse_constant=str)
    except (TypeError, ValueError, RecursionError):
        result = repr(result)
    return {"refused": result, "of": X.tolist(), "because": str(error)}


def measurement(x: list[float], y: list[float]) -> Record:
    """Return the record of a measurement; of a failed one if no value is finite."""
    # JSON has no NaN: null stands for it.
    record: Record = {"x": x, "y": [value if math.isfinite(value) else None for value in y]}
    if not any(map(math.isfinite, y)):
        record["failed"] = f"measured {y}"
    return record


def checked_outcomes(Y: Any, num_points: int, num_outputs: int | None) -> Tensor:
    """Return values ``n x m`` or ``n``, or a number, as ``n x m``; they may be NaN or infinite."""
    Y = checked_tensor("measured values", Y)
    columns = Y
    if Y.dim() < 2:  # one output
        columns = Y.reshape(-1, 1)
    fits = columns.dim() == 2 and len(columns) == num_points and columns.shape[-1] > 0
    if not fits or num_outputs not in (None, columns.shape[-1]):
        raise ValueError(
            f"Expected measured values of shape {num_points} x {num_outputs or 'm'}, a row for "
            f"each point, got {tuple(Y.shape)}."
        )
    return columns


def as_options(options: Any) -> dict[str, Any]:
    """Return options of ``optimize_acqf``; others, and those set here, are errors."""
    if options is None:
        return {}
    if not isinstance(options, dict):
        raise TypeError(f"Expected optimizer_options to be a dictionary, got {options!r}.")
    twice = {"acq_function", "bounds", "q", "return_best_only", "return_full_tree"} & set(options)
    if twice:
        raise ValueError(f"Expected optimizer_options without {sorted(twice)}, which are set here.")
    functions = (optimize_acqf, gen_batch_initial_conditions)
    arguments = {name for function in functions for name in signature(function).parameters}
    unknown = sorted({*options} - (arguments - {"ic_gen_kwargs"}))
    # A generator of starts may have further arguments.
    if unknown and "ic_generator" not in options:
        raise ValueError(
            f"Unknown optimizer_options {unknown}; expected arguments of BoTorch's optimize_acqf, "
            "such as num_restarts and raw_samples."
        )
    return options


def check_call(name: str, function: Any) -> None:
    """Raise a TypeError unless a function of a collection can be called as it will be."""
    if not callable(function):
        raise TypeError(f"Expected {name} to be callable, got {function!r}.")
    num_arguments, example = _EXAMPLES[name]
    try:
        call = signature(function)
    except ValueError:  # a function in C may have none
        return
    try:
        call.bind(*range(num_arguments))
    except TypeError as error:
        raise TypeError(
            f"Expected {name} as a function of {plural(num_arguments, 'argument')}, such as "
            f"`{example}`; {function!r} cannot be called so: {error}."
        ) from error
