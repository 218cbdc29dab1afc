"""Measurements: made, failed and pending; and the checks of their numbers."""

from __future__ import annotations

import json
import math
from typing import Any

import torch
from torch import Tensor

from gpadjust.active.measurement_log import Record
from gpadjust.active.points import NEAR, among, distances
from gpadjust.checks import check_observed, checked_points, checked_tensor


class Measurements:
    """The state that records add up to, whether new ones or those of a log.

    A record is one of

    - ``{"asked": [x, ...], "left_out": [x, ...]}``: points that are to be measured; and what was
      left out, if there are limits to keep;
    - ``{"x": x, "y": y}``: a measurement, null where an output was not measured;
    - ``{"x": x, "failed": message}``: one that failed, whether it has a ``"y"`` or not;
    - ``{"withdrawn": [x, ...]}``: points that are not to be measured any more;
    - ``{"refused": result, "of": [x, ...], "because": message}``: what an oracle returned for
      points and could not be their measured values. It changes nothing; a human may recover it.

    A measurement is of the pending point that it is nearest to, if that is within a hundredth of
    the bounds' widths: what a laboratory sets is seldom what was asked for to the last digit.

    Args:
        bounds: Bounds of the inputs, ``2 x d``.
        num_outputs: Number ``m`` of outputs, or None for that of the first measurement.
        data: ``(X, Y)`` measured before, or None.

    Attributes:
        X: The points measured, ``n x d``, those of ``data`` first.
        Y: The values measured there, ``n x m``; NaN where an output was not.
        failed_X: Points at which measuring failed, ``k x d``.
        pending: Points asked for and not told yet, ``l x d``.
        left_out: Points that were not asked for, though best, as limits might be left there,
            ``k x d``.
        num_measured: Number of measurements, failed ones included, those of ``data`` not.
        num_outputs: Number ``m`` of outputs; None before the first measurement.
    """

    def __init__(
        self, bounds: Tensor, num_outputs: int | None, data: tuple[Tensor, Tensor] | None
    ) -> None:
        self.bounds = bounds
        self.X = self.failed_X = self.pending = self.left_out = self._asked = bounds[:0]
        self.Y = torch.zeros(0, num_outputs or 0, dtype=torch.float64)
        self.num_measured = 0
        self.num_outputs = num_outputs
        self._num_asks = 0
        if data is not None:
            if not isinstance(data, tuple | list) or len(data) != 2:
                raise TypeError(f"Expected data to be a pair (X, Y), got {data!r}.")
            X = checked_points("the X of data", data[0], bounds.shape[-1])
            Y = checked_outcomes(data[1], len(X), num_outputs)
            check_observed("the Y of data", Y)
            self.X, self.Y, self.num_outputs = X, Y, Y.shape[-1]

    @property
    def num_observed(self) -> int:
        """Number of measurements of the output that was measured least often."""
        return int((~self.Y.isnan()).sum(0).min()) if len(self.X) else 0

    def _take(self, record: Record) -> None:
        """Take in one record."""
        if "refused" in record:
            return
        if "asked" in record:
            asked = self._points(record["asked"])
            self.pending = torch.cat([self.pending, asked])
            self._asked = torch.cat([self._asked, asked])
            self.left_out = torch.cat([self.left_out, self._points(record.get("left_out", []))])
            self._num_asks += 1
        elif "withdrawn" in record:
            for x in self._points(record["withdrawn"]):
                point = self._no_longer_pending(x)
                self._asked = self._asked[~among(self._asked, point)]
        else:
            self._take_measurement(record)

    def _take_measurement(self, record: Record) -> None:
        """Take in one measurement."""
        x = self._points([record["x"]])
        if "failed" in record:
            self.failed_X = torch.cat([self.failed_X, x])
        else:
            values = [math.nan if value is None else value for value in record["y"]]
            y = checked_outcomes([values], 1, self.num_outputs)
            check_observed("y", y)
            self.num_outputs = y.shape[-1]
            self.X, self.Y = torch.cat([self.X, x]), torch.cat([self.Y, y]) if len(self.Y) else y
        self._no_longer_pending(x[0])
        self.num_measured += 1

    def _no_longer_pending(self, x: Tensor) -> Tensor:
        """Remove the point that ``x`` is of those that are pending, and return it, ``1 x d``.

        If it is none, nothing is removed, and ``0 x d`` returned.
        """
        if not len(self.pending):
            return self.pending
        distance, i = distances(x, self.pending, self.bounds).min(-1)
        if distance > NEAR:
            return self.pending[:0]
        point = self.pending[i : i + 1]
        self.pending = torch.cat([self.pending[:i], self.pending[i + 1 :]])
        return point

    def _points(self, rows: list[list[float]]) -> Tensor:
        """Return the points of a record, ``n x d``."""
        d = self.X.shape[-1]
        return checked_points("X", rows, d) if rows else self.X.new_zeros(0, d)


def refusal(X: Tensor, result: Any, error: Exception) -> Record:
    """Return the record of a refused result of an oracle for points ``q x d``.

    Example:
        >>> refusal(torch.zeros(1, 1), {"Y": torch.tensor([1.5, math.nan])}, ValueError("no"))
        {'refused': {'Y': [1.5, 'NaN']}, 'of': [[0.0]], 'because': 'no'}
    """

    def plain(part: Any) -> Any:
        return part.tolist() if hasattr(part, "tolist") else repr(part)

    try:
        result = json.loads(json.dumps(result, default=plain), parse_constant=str)
    except (TypeError, ValueError, RecursionError):
        result = repr(result)
    return {"refused": result, "of": X.tolist(), "because": str(error)}


def measurement(x: list[float], y: list[float]) -> Record:
    """Return the record of a measurement, a failed one if no value is finite.

    Example:
        >>> measurement([0.5], [1.25, float("nan")])
        {'x': [0.5], 'y': [1.25, None]}
        >>> measurement([0.5], [float("inf")])
        {'x': [0.5], 'y': [None], 'failed': 'measured [inf]'}
    """
    values = [value if math.isfinite(value) else None for value in y]
    record: Record = {"x": x, "y": values}
    failed = all(value is None for value in values)
    return record | ({"failed": f"measured {y}"} if failed else {})


def checked_outcomes(Y: Any, num_points: int, num_outputs: int | None) -> Tensor:
    """Return measured values as ``n x m``, float64; they may be NaN or infinite.

    Args:
        Y: The values, ``n x m`` or ``n``; one number for one point will do.
        num_points: Number ``n`` of points.
        num_outputs: Number ``m`` of outputs, if it is known.

    Raises:
        TypeError: If they are no numbers.
        ValueError: If they have another shape.
    """
    Y = checked_tensor("measured values", Y)
    columns = Y.reshape(-1, 1) if Y.dim() < 2 else Y
    right = columns.dim() == 2 and len(columns) == num_points and columns.shape[-1] > 0
    if not right or num_outputs not in (None, columns.shape[-1]):
        m = "m" if num_outputs is None else num_outputs
        raise ValueError(
            f"Expected measured values of shape {num_points} x {m}, a row for each point, got "
            f"{tuple(Y.shape)}."
        )
    return columns


def as_options(options: Any) -> dict[str, Any]:
    """Return options of ``optimize_acqf``; none for None.

    Raises:
        TypeError: If they are no dictionary.
        ValueError: If one of them is not for a user to give.
    """
    options = {} if options is None else options
    if not isinstance(options, dict):
        raise TypeError(f"Expected optimizer_options to be a dictionary, got {options!r}.")
    own = {"acq_function", "bounds", "q", "return_best_only", "return_full_tree"} & set(options)
    if own:
        raise ValueError(f"Expected optimizer_options without {sorted(own)}: these are set here.")
    return options
