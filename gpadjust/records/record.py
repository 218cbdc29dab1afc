"""A trajectory of a machine: as it was measured, in control steps, and at even times."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import checked_number
from gpadjust.core.data import ArrayLike, as_tensor
from gpadjust.states import StateSpec

_GAP = 1.5  # typical steps: a longer time between two rows is a gap
_OFTEN = 0.1  # of all times between rows: so many gaps are none
_SAME = 0.01  # of a step, by which another one may differ from it
_ROUNDING = 1e-6  # of a step
_FINEST = 0.5  # sampling steps: with shorter ones most new rows would lie between the same two
_JITTER = 0.1  # of the sampling step, by which the time between two rows may differ from it


class Record:
    """A measured trajectory: times, and the states and actions of a machine there.

    Row k has the state at its time, and the mean of the action from there to the next row. (That of
    the last row counts for nothing: if it is not known, repeat the one before.) A record may be in
    parts, by ``segments`` or because rows are missing, which is a gap: wherever two rows are more
    than 1.5 times the median time apart. Rows on either side of a gap do not follow each other.

    Args:
        times: ``N`` times, in s or the unit of time of the velocities, that rise within a segment.
            Dates and durations, as the index of a pandas frame, become seconds since the first.
        states: ``N x state_dim``; NaN where an entry was not measured.
        actions: ``N x action_dim``.
        segments: ``N`` labels; a segment ends wherever the label changes. Default: one for all.
        name: What errors call it.

    Tensors in float64, NumPy arrays, and columns of a pandas frame will do.

    Raises:
        TypeError: If values are no numbers, or a tensor is not in float64.
        ValueError: If shapes disagree, times do not rise or are not finite, a state is infinite, an
            action or a label is missing, or no row follows another.

    Example:
        >>> import torch
        >>> from gpadjust.records import Record
        >>> times = 0.01 * torch.arange(100, dtype=torch.float64)
        >>> Record(times, times.sin().unsqueeze(-1), times.cos().unsqueeze(-1), name="swing")
        Record('swing', 100 rows every 0.01, 1 state, 1 action)
    """

    def __init__(
        self,
        times: ArrayLike,
        states: ArrayLike,
        actions: ArrayLike,
        segments: ArrayLike | Iterable[object] = None,
        name: str = "unnamed",
    ) -> None:
        self.name = name
        self.times = self._numbers(_in_seconds(times), "times", 1)
        self.states = self._numbers(states, "states", 2)
        self.actions = self._numbers(actions, "actions", 2)
        labels: Any = segments.tolist() if hasattr(segments, "tolist") else segments
        self.segments = None if labels is None else tuple(labels)
        self._check_rows()
        self._check_values()

    def __repr__(self) -> str:
        states, actions = self.states.shape[1], self.actions.shape[1]
        return (
            f"Record({self.name!r}, {len(self.times)} rows every {self.sampling_step:.4g}, "
            f"{states} state{'s' * (states > 1)}, {actions} action{'s' * (actions > 1)})"
        )

    @property
    def sampling_step(self) -> float:
        """The mean time from one row to the next, without gaps."""
        steps = self.times.diff()[~self._breaks]
        return float(steps[steps <= _GAP * steps.median()].mean())

    def stretches(self, max_gap: float | None = None) -> list[slice]:
        """The rows that follow each other, stretch by stretch.

        Args:
            max_gap: The longest time between two rows that follow each other. Default: 1.5 times
                the median.

        Raises:
            ValueError: If times differ so much that it takes ``max_gap`` to say what a gap is.
        """
        steps, ends = self.times.diff(), self._breaks
        if max_gap is None:
            within = steps[~ends]
            max_gap = _GAP * float(within.median())
            longer = int((within > max_gap).sum())
            if longer > max(1, _OFTEN * len(within)):
                raise ValueError(
                    f"{self._called}: expected even sampling with few gaps, found {longer} of "
                    f"{len(within)} times between rows longer than {_GAP:g} times the median, "
                    f"{max_gap / _GAP:.4g}. Bring it to even steps with `records.resampled(step, "
                    "max_gap=...)`, where max_gap is the longest time to interpolate over."
                )
        edges = [0, *((ends | (steps > max_gap)).nonzero().flatten() + 1).tolist(), len(self.times)]
        return [slice(first, end) for first, end in pairwise(edges)]

    def check_even(self) -> None:
        """Raise a ValueError unless the sampling is even, to a tenth of its step."""
        step = self.sampling_step
        for rows in self.stretches():
            found = self.times[rows].diff()
            if len(found) and (off := (found - step).abs()).max() > _JITTER * step:
                row = int(off.argmax())
                raise ValueError(
                    f"{self._called}: expected even sampling, to a tenth of its step {step:.4g}, "
                    f"found {float(found[row]):.4g} from row {rows.start + row} to the next. Bring "
                    "it to even steps with `records.resampled(step)`."
                )

    @property
    def _called(self) -> str:
        return f"Record {self.name!r}"

    @cached_property
    def _breaks(self) -> Tensor:
        """True for each row but the first that begins a segment: ``N - 1`` booleans."""
        if self.segments is None:
            return torch.zeros(len(self.times) - 1, dtype=torch.bool)
        changes = [label != following for label, following in pairwise(self.segments)]
        return torch.tensor(changes, dtype=torch.bool)

    def _numbers(self, values: ArrayLike, name: str, dims: int) -> Tensor:
        tensor = as_tensor(values, name).detach().clone()
        if tensor.dim() != dims or 0 in tensor.shape[1:]:
            expected = "N" if dims == 1 else f"N x {name.removesuffix('s')}_dim"
            raise ValueError(
                f"{self._called}: expected {name} of shape {expected}, got {tuple(tensor.shape)}"
                + ("; of a single column, use `.reshape(-1, 1)`." if dims > tensor.dim() else ".")
            )
        return tensor

    def _check_rows(self) -> None:
        """Raise an error unless all have as many rows, two or more, one of which follows another.

        A label that is NaN is no label, and would be a segment of its own.
        """
        parts = {"times": self.times, "states": self.states, "actions": self.actions}
        rows = {name: len(tensor) for name, tensor in parts.items()}
        if self.segments is not None:
            rows["segments"] = len(self.segments)
        if len({*rows.values()}) > 1:
            found = ", ".join(f"{number} of {name}" for name, number in rows.items())
            raise ValueError(f"{self._called}: expected as many rows of each, found {found}.")
        for row, label in enumerate(self.segments or ()):
            if label is None or label != label:
                raise ValueError(
                    f"{self._called}, row {row}: expected a label of its segment, found {label}; "
                    "leave out rows that are of no segment."
                )
        if len(self.times) < 2 or self._breaks.all():
            raise ValueError(
                f"{self._called}: expected two rows or more of a segment, one after the other, "
                f"found {len(self.times)} in all; leave the record out, or correct `segments`."
            )

    def _check_values(self) -> None:
        """Raise an error unless times rise and are finite, as actions are; states may be NaN."""
        bad = {
            "times": ~self.times.isfinite().unsqueeze(-1),
            "states": self.states.isinf(),
            "actions": ~self.actions.isfinite(),
        }
        for name, where in bad.items():
            if where.any():
                row, column = (int(i) for i in where.nonzero()[0])
                found = float(getattr(self, name).reshape(len(where), -1)[row, column])
                ways_out = {
                    "times": "leave the row out",
                    "states": "put NaN where an entry was not measured",
                    "actions": "split the record there, by `segments` or in two, without that row",
                }
                raise ValueError(
                    f"{self._called}, row {row}: expected finite numbers, found {found} in column "
                    f"{column} of {name}; {ways_out[name]}."
                )
        stops = (self.times.diff() <= 0) & ~self._breaks
        if stops.any():
            row = int(stops.nonzero()[0]) + 1
            before, time = self.times[row - 1 : row + 1].tolist()
            raise ValueError(
                f"{self._called}, row {row}: expected times that rise, found {time:.10g} after "
                f"{before:.10g}. Leave out rows that were written twice; where the clock was set "
                "again, begin a new segment by `segments`."
            )


def _in_seconds(times: ArrayLike) -> ArrayLike:
    """Dates and durations as seconds since the first; anything else as it is."""
    found = np.asarray(times) if hasattr(times, "dtype") and not isinstance(times, Tensor) else None
    if found is None or not len(found):
        return times
    if found.dtype.kind == "O" and isinstance(found.flat[0], datetime | timedelta):
        # Of a time zone; those that are measured without one NumPy knows.
        kind = "datetime64[ns]" if isinstance(found.flat[0], datetime) else "timedelta64[ns]"
        with_zone = getattr(found.flat[0], "tzinfo", None) is not None
        each = [t.astimezone(UTC).replace(tzinfo=None) if with_zone else t for t in found]
        found = np.array(each, dtype=kind)
    return (found - found[0]) / np.timedelta64(1, "s") if found.dtype.kind in "mM" else times


class Stretch(NamedTuple):
    """Control steps that follow each other."""

    states: Tensor  # before the first step and after each, n + 1 x state_dim
    actions: Tensor  # n x action_dim
    times: Tensor  # of the states, n + 1
    record: int  # its number


def in_control_steps(
    records: Sequence[Record], spec: StateSpec, step: float | None
) -> list[Stretch]:
    """All stretches of the records; for ``step`` see :class:`~gpadjust.records.Records`."""
    every, stretches = _rows_a_step(records, spec, step), []
    for number, record in enumerate(records):
        for rows in record.stretches():
            num_steps = (rows.stop - rows.start - 1) // every
            kept = slice(rows.start, rows.start + num_steps * every + 1, every)
            states = record.states[kept].clone()
            actions = record.actions[rows][: num_steps * every]
            actions = actions.unflatten(0, (num_steps, every)).mean(1)
            if every > 1:  # recorded ones are of a row before, not of a step
                states[:1, spec.previous_columns] = math.nan
            for _ in spec.previous:  # as often as the longest chain of them needs
                spec.remember(states[1:], states[:-1].clone(), actions)
            stretches.append(Stretch(states, actions, record.times[kept], number))
    if not any(len(stretch.actions) for stretch in stretches):
        raise ValueError(
            f"Expected a stretch of {every + 1} rows or more, which are a control step, found none "
            f"of {len(stretches)}; take a shorter step."
        )
    return stretches


def _rows_a_step(records: Sequence[Record], spec: StateSpec, step: float | None) -> int:
    """The number of rows of the records that make a control step."""
    for record in records:
        record.check_even()
    fast, *_, slow = sorted((records[0], *records), key=lambda record: record.sampling_step)
    sampling = fast.sampling_step
    if slow.sampling_step - sampling > _SAME * sampling:
        raise ValueError(
            f"Expected records of one sampling step, found {sampling:.4g} of {fast.name!r} and "
            f"{slow.sampling_step:.4g} of {slow.name!r}; bring them to one by "
            f"`records.resampled({slow.sampling_step:.4g})`."
        )
    wanted = spec.step if step is None else checked_number("step", step, above=0)
    if wanted is None:
        return 1
    if spec.step is not None and abs(wanted - spec.step) > _SAME * spec.step:
        raise ValueError(
            f"Expected the step of the spec, {spec.step:.4g}, got {wanted:.4g}; leave `step` out, "
            "or make a spec with this step."
        )
    every = round(wanted / sampling)
    if abs(wanted - every * sampling) > _SAME * wanted:
        other = f", or first `records.resampled({wanted:.4g})`" if every else ""
        raise ValueError(
            f"Expected a control step that is a whole multiple of the sampling step, "
            f"{sampling:.4g}, got {wanted:.4g}; take {max(every, 1) * sampling:.4g}{other}."
        )
    return every


def resampled(record: Record, spec: StateSpec, step: float, max_gap: float | None) -> Record | None:
    """A record with rows of this step, as of :meth:`~gpadjust.records.Records.resampled`.

    Of a stretch shorter than a step there is its first row; None if no stretch is as long.
    """
    finest = _FINEST * record.sampling_step
    if step < finest:
        raise ValueError(
            f"Record {record.name!r}: expected a step of half a sampling step, {finest:.4g}, or "
            f"more, as nothing was measured between rows; got {step:.4g}."
        )
    parts = []
    for label, rows in enumerate(record.stretches(max_gap)):
        times = record.times[rows]
        num_steps = int((times[-1] - times[0]) / step + _ROUNDING)
        if not num_steps:
            first = slice(rows.start, rows.start + 1)
            row = record.times[first], record.states[first], record.actions[first]
            parts.append((*row, torch.tensor([label])))
            continue
        edges = times[0] + step * torch.arange(num_steps + 2, dtype=torch.float64)
        states = _states_at(spec, times, record.states[rows], edges[:-1])
        actions = _means_between(times, record.actions[rows], edges)
        parts.append((edges[:-1], states, actions, torch.full((num_steps + 1,), label)))
    times, states, actions, segments = (torch.cat(each) for each in zip(*parts, strict=True))
    if len(times) == len(parts):
        return None
    return Record(times, states, actions, segments, record.name)


def _places(times: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """The row before each time (but the last row), and which share of the way to the next it is."""
    rows = (torch.searchsorted(times, at, right=True) - 1).clamp(0, len(times) - 2)
    share = ((at - times[rows]) / (times[rows + 1] - times[rows])).clamp(0, 1)
    at_row = (share - share.round()).abs() < _ROUNDING
    return rows, torch.where(at_row, share.round(), share)


def _states_at(spec: StateSpec, times: Tensor, states: Tensor, at: Tensor) -> Tensor:
    """States ``n x state_dim`` on the lines between those measured at ``times``."""
    rows, share = _places(times, at)
    before, after, share = states[rows], states[rows + 1], share.unsqueeze(-1)
    between = before + share * spec.change(before, after)
    # At a row it is what was measured there, whether its neighbour was or not.
    return torch.where(share == 0, before, torch.where(share == 1, after, between))


def _means_between(times: Tensor, actions: Tensor, edges: Tensor) -> Tensor:
    """Means ``n x action_dim`` from edge to edge, of actions constant from row to row."""
    times = torch.cat([times, times[-1:] + edges[-1:] - edges[:1]])  # the last one goes on
    parts = actions * times.diff().unsqueeze(-1)
    sums = torch.cat([torch.zeros_like(parts[:1]), parts]).cumsum(0)
    rows, share = _places(times, edges)
    total = torch.lerp(sums[rows], sums[rows + 1], share.unsqueeze(-1))
    return total.diff(dim=0) / edges.diff().unsqueeze(-1)
