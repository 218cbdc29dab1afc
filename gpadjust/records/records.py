"""Measured trajectories of a machine: checked, read from files, in control steps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_choice, check_finite, check_kind, checked_number
from gpadjust.core.data import ArrayLike, as_tensor
from gpadjust.dynamics import Trajectories, Windows
from gpadjust.files.fields import is_moment, seconds_of
from gpadjust.files.table import Table
from gpadjust.states import StateSpec
from gpadjust.words import plural

_GAP = 1.5  # typical steps: a longer time between two rows is a gap
_OFTEN = 0.1  # share of the times between rows above which they are not gaps, but uneven
_JITTER = 0.1  # of the sampling step, by which the time between two rows may differ from it
_SAME = 0.01  # of a step, by which another one may differ from it


class Record:
    """A measured trajectory: times, and the states and actions of a machine there.

    Row k has the state at its time, and the mean of the action from there to the next row; the last
    action is not read. A record may consist of several stretches, by ``segments`` or by gaps, where
    two rows are more than 1.5 times the median time apart. Values are tensors in float64, NumPy
    arrays, or columns of a pandas frame.

    Args:
        times: ``N`` times, in s or the unit of time of the velocities, that rise within a segment.
            Dates and durations, as the index of a pandas frame or in texts, become seconds since
            the first.
        states: ``N x state_dim``; NaN where an entry was not measured.
        actions: ``N x action_dim``.
        segments: ``N`` labels; a segment ends wherever the label changes, and a row whose label is
            NaN is by itself. Default: one for all.
        name: The name in errors.

    Attributes:
        sampling_step: The mean time from one row to the next, without gaps.

    Raises:
        TypeError: If values are not numbers, or a tensor is not in float64.
        ValueError: If shapes disagree, times do not rise or are not finite, a state is infinite, an
            action is missing, or no row follows another.

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
        self.within = self.actions.unsqueeze(1)  # N x k x action_dim: of the samples of a step
        labels: Any = [0] * len(self.times) if segments is None else segments
        self.segments = tuple(labels.tolist() if hasattr(labels, "tolist") else labels)
        rows = {name: len(getattr(self, name)) for name in ("times", "states", "actions")}
        rows["segments"] = len(self.segments)
        if len({*rows.values()}) > 1:
            counts = ", ".join(f"{number} of {name}" for name, number in rows.items())
            raise self._error(f": expected as many rows of each, found {counts}.")
        states = self.states.nan_to_num(nan=0.0, posinf=math.inf, neginf=-math.inf)
        parts = {"times": self.times.unsqueeze(-1), "states": states, "actions": self.actions}
        for part, tensor in parts.items():
            check_finite(f"{part} of record {name!r}", tensor)
        together = [label == after for label, after in pairwise(self.segments)]
        self._together = torch.tensor(together, dtype=torch.bool)  # in a segment
        steps = self.times.diff()
        if not self._together.any():
            raise self._error(
                ": expected two rows or more of a segment, one after the other, found "
                f"{len(self.times)} in all; leave the record out, or correct `segments`."
            )
        stops = (steps <= 0) & self._together
        if stops.any():
            row = int(stops.nonzero()[0]) + 1
            before, time = self.times[row - 1 : row + 1].tolist()
            raise self._error(
                f", row {row}: expected times that rise, found {time:.10g} after {before:.10g}. "
                "Leave out rows that were written twice; where the clock was set again, begin a "
                "new segment by `segments`."
            )
        self._goes_on = self._together & (steps <= _GAP * steps[self._together].median())
        self.sampling_step = float(steps[self._goes_on].mean())

    def __repr__(self) -> str:
        states, actions = self.states.shape[1], self.actions.shape[1]
        return (
            f"Record({self.name!r}, {len(self.times)} rows every {self.sampling_step:.4g}, "
            f"{plural(states, 'state')}, {plural(actions, 'action')})"
        )

    def part(self, rows: slice) -> Record:
        """Return some rows, as a record of the same name."""
        columns = self.times[rows], self.states[rows], self.actions[rows]
        part = Record(*columns, self.segments[rows], self.name)
        part.within = self.within[rows]
        return part

    def stretches(self) -> list[slice]:
        """Return the rows that follow each other without a gap, stretch by stretch."""
        ends = (~self._goes_on).nonzero().flatten() + 1
        return [slice(*edges) for edges in pairwise([0, *ends.tolist(), len(self.times)])]

    def rows_in(self, step: float) -> int:
        """Return how many rows make a control step; a ValueError unless the sampling is even."""
        times, sampling = self.times.diff(), self.sampling_step
        is_gap = (self._together & ~self._goes_on)[self._together]
        is_off = (times[self._goes_on] - sampling).abs() > _JITTER * sampling
        if is_off.any() or is_gap.sum() > max(1, _OFTEN * len(is_gap)):
            low, high = times[self._together].aminmax()
            raise self._error(
                f": expected even sampling, to a tenth of its step {sampling:.4g} and with few "
                f"gaps, found times between rows from {low:.4g} to {high:.4g}. Interpolate each "
                "column at even times first, as by `numpy.interp`; unwrap angles before."
            )
        every = round(step / sampling)
        if abs(step - every * sampling) > _SAME * step:
            raise self._error(
                f": expected a control step that is a whole multiple of the sampling step, "
                f"{sampling:.4g}, got {step:.4g}; take {max(every, 1) * sampling:.4g}."
            )
        return every

    def _error(self, message: str) -> ValueError:
        return ValueError(f"Record {self.name!r}{message}")

    def _numbers(self, values: ArrayLike, name: str, dims: int) -> Tensor:
        tensor = as_tensor(values, name).detach().clone()
        if tensor.dim() != dims or 0 in tensor.shape[1:]:
            expected = "N"
            if dims > 1:
                expected = f"N x {name.removesuffix('s')}_dim"
            way_out = ""
            if dims > tensor.dim():
                way_out = "; of a single column, use `.reshape(-1, 1)`"
            raise self._error(
                f": expected {name} of shape {expected}, got {tuple(tensor.shape)}{way_out}."
            )
        return tensor


def _in_seconds(times: ArrayLike) -> ArrayLike:
    """Return dates and durations as seconds since the first, anything else as it is."""
    kind = getattr(getattr(times, "dtype", None), "kind", "")
    if kind in ("O", "U", "T") and len(times) and is_moment(str(next(iter(times)))):
        return np.array(seconds_of([*map(str, times)]))
    if kind not in ("M", "m"):
        return times.to_numpy() if hasattr(times, "to_numpy") else times
    dates = np.asarray(times, dtype=f"{kind}8[ns]")  # in UTC, if they have a time zone
    return (dates - dates[:1]) / np.timedelta64(1, "s")


class Records:
    """Measured trajectories of one system.

    The control step is a whole multiple k of the sampling step: each k-th row of a stretch is a
    state, and its action the mean of the k actions. No step leads across a gap or from one segment
    to another. States that hold previous values (lagged actions and outputs) are filled in, at the
    first row of a stretch from the record; where that has none, steps begin later.

    Args:
        records: The records, a :class:`Record` each, or one.
        spec: The entries of their states and actions.

    Raises:
        TypeError: If ``spec`` is not a :class:`StateSpec`, or a record not a :class:`Record`.
        ValueError: If there is no record, or one does not have the columns of the spec.

    Example:
        >>> import torch
        >>> from gpadjust.records import Record, Records
        >>> from gpadjust.states import StateSpec
        >>> times = 0.01 * torch.arange(101, dtype=torch.float64)
        >>> record = Record(times, times.sin().unsqueeze(-1), times.cos().unsqueeze(-1))
        >>> records = Records([record], StateSpec(["x"], ["v"]))
        >>> len(records.trajectories(0.05).states), records.windows(10, 0.05).measured.shape
        (20, torch.Size([2, 10, 1]))
    """

    def __init__(self, records: Record | Iterable[Record], spec: StateSpec) -> None:
        check_kind("spec", spec, StateSpec, "a StateSpec, such as StateSpec(['x', 'v'], ['force'])")
        if isinstance(records, Record):
            records = [records]
        self.records = tuple(records)
        self.spec = spec
        if not self.records:
            raise ValueError("Expected one record or more, found none.")
        for record in self.records:
            if not isinstance(record, Record):
                raise TypeError(
                    f"Expected each record as a Record(times, states, actions), found {record!r}."
                )
            for name in ("states", "actions"):
                expected = getattr(spec, name)
                columns = getattr(record, name).shape[1]
                if columns != len(expected):
                    raise ValueError(
                        f"Record {record.name!r}: expected {len(expected)} columns of {name}, "
                        f"{', '.join(expected)}, as in the spec, found {columns}."
                    )

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[Record]:
        return iter(self.records)

    def __repr__(self) -> str:
        return f"Records({[*self.records]!r})"

    @classmethod
    def read_csv(
        cls,
        files: str | Path | Table | Iterable[str | Path | Table],
        spec: StateSpec,
        *,
        states: Mapping[str, str | None] | None = None,
        actions: Mapping[str, str] | None = None,
        time: str | float = "time",
        time_unit: str | None = None,
        segment: str | None = None,
        **table: Any,
    ) -> Records:
        """Read records from CSV files or workbooks, one from each.

        A line of a file names its columns; others may be there. A field of a state is empty or NaN
        where it was not measured. States that hold previous values need no column.

        Args:
            files: The file, or several; or a :class:`~gpadjust.files.table.Table` of one.
            spec: The entries of states and actions.
            states: Columns by the names of states, such as ``{"theta": "q"}``; None for a hidden
                state, which :func:`smooth` estimates. Default: the columns of their names. Units
                in brackets may be left out.
            actions: The same for the actions.
            time: The column of times, or without one the time from one row to the next. Dates
                and times of day become the time since the first.
            time_unit: The unit of times, steps and rates: s, ms, us, min, h or d. Default: seconds;
                a column in other units of time is converted.
            segment: The column of the labels of segments. Default: a file is one segment.
            **table: Options of :class:`~gpadjust.files.table.Table`: ``delimiter`` and ``decimal``,
                which are found by default, ``names`` of all columns, and ``sheet``.

        Raises:
            OSError: If a file cannot be read.
            TypeError: If ``spec`` is not a :class:`StateSpec`.
            ValueError: If a name is not in the spec, a file has no rows or not these columns, a
                field is not a number or a time or action is missing, with file, line and column;
                the time is in minutes, hours or days without ``time_unit``; and as :class:`Record`.
        """
        check_kind("spec", spec, StateSpec, "a StateSpec, such as StateSpec(['x', 'v'], ['force'])")
        columns: dict[str, Any] = {"states": states or {}, "actions": actions or {}}
        for argument, names in columns.items():
            check_kind(argument, names, Mapping, "a dictionary from names of the spec to columns")
            for name in names:
                check_choice(argument, name, getattr(spec, argument))
        records = []
        if isinstance(files, str | Path | Table):
            files = [files]
        for file in files:
            log = file if isinstance(file, Table) else Table(file, **table)
            if isinstance(time, str):
                times = log.times(time, time_unit)
            else:
                rows = torch.arange(len(log), dtype=torch.float64)
                times = checked_number("time", time, above=0) * rows
            measured = []
            for name in spec.states:
                is_filled_in = name in spec.previous and name not in log.names
                column = columns["states"].get(name, None if is_filled_in else name)
                if column is None:
                    measured.append(torch.full_like(times, math.nan))
                else:
                    measured.append(log.numbers(column, may_miss=True))
            acting = [columns["actions"].get(name, name) for name in spec.actions]
            taken = [times if name == time else log.numbers(name) for name in acting]
            labels = None if segment is None else log.texts(segment)
            parts = times, torch.stack(measured, -1), torch.stack(taken, -1)
            records.append(Record(*parts, labels, log.file))
        return cls(records, spec)

    @classmethod
    def of_windows(cls, windows: Windows, spec: StateSpec, step: float) -> Records:
        """Make a record of each window, such as of an agent's episodes, to :func:`smooth` them.

        The control step is in the unit of the times.
        """
        rows = torch.arange(windows.states.shape[1], dtype=torch.float64)
        times = checked_number("step", step, above=0) * rows
        actions = torch.cat([windows.actions, windows.actions[:, -1:]], dim=1)  # the last: not read
        parts = enumerate(zip(windows.states, actions, strict=True))
        return cls([Record(times, *part, name=f"window {i}") for i, part in parts], spec)

    def trajectories(self, step: float | None = None) -> Trajectories:
        """Return the trajectories of all records, to learn dynamics from or to score them by.

        An episode ends at a gap, and where a row is left out.

        Args:
            step: The control step, in the unit of the times. Default: the step of the spec, and
                without one the sampling step.

        Raises:
            ValueError: If there are no transitions, the sampling steps of records differ or are
                uneven, the step is not a multiple of them, or not that of the spec.

        Warns:
            UserWarning: If steps are left out, because they start at a state that was not measured
                in full, or end at one of which nothing was measured that a model predicts; or
                stretches, because they are shorter than a step.
        """
        data = _transitions(control_steps(self, step))
        complete = ~data.states.isnan().any(-1)
        usable = data.subset(complete & ~data.next_states[:, self.spec.predicted].isnan().all(-1))
        if not len(usable.states):
            raise ValueError(
                f"Expected steps from a state that was measured in full, found none of "
                f"{len(data.states)}.{self._hidden(data)}"
            )
        if len(usable.states) < len(data.states):
            warnings.warn(
                f"Left out: {len(data.states) - len(usable.states)} of {len(data.states)} steps, "
                f"{int((~complete).sum())} of which start at a state not measured in full.",
                UserWarning,
                stacklevel=2,
            )
        return usable

    def windows(self, length: int, step: float | None = None, stride: int | None = None) -> Windows:
        """Cut windows, to compare with :meth:`~gpadjust.dynamics.Dynamics.free_run`.

        For ``step`` and errors see :meth:`trajectories`, for the rest :meth:`Trajectories.windows`;
        no state may be hidden.
        """
        data = _transitions(control_steps(self, step))
        if hidden := self._hidden(data):
            raise ValueError(f"Expected states measured in full, for windows to start at.{hidden}")
        return data.windows(length, stride)

    def _hidden(self, data: Trajectories) -> str:
        """Return the way out if states were never measured; empty if all were."""
        never = data.states.isnan().all(0).nonzero().flatten().tolist()
        if not never:
            return ""
        names = " and ".join(repr(self.spec.states[i]) for i in never)
        return (
            f" {names} was never measured: take states that smoothing finds, as in "
            "`smooth(records, physics, start=...).draw().windows(20)`."
        )


def control_steps(records: Records, step: float | None) -> Records:
    """Return records whose rows are control steps, at even times: one for each stretch.

    For ``step``, errors and warnings see :meth:`Records.trajectories`.
    """
    if not isinstance(records, Records):
        raise TypeError(f"Expected records as Records([record, ...], spec), found {records!r}.")
    spec = records.spec
    step = _checked_step(records, step)
    steps = []
    short = 0
    for record in records:
        every = record.rows_in(step)
        for rows in record.stretches():
            number = (rows.stop - rows.start - 1) // every
            if not number:
                short += 1
                continue
            end = rows.start + number * every
            times = record.times[rows.start] + step * torch.arange(number + 1, dtype=torch.float64)
            states = record.states[rows.start : end + 1 : every].clone()
            if every > 1:  # recorded ones are of a row before, not of a step
                states[0, spec.previous_columns] = math.nan
            within = record.within[rows.start : end].unflatten(0, (number, every)).flatten(1, 2)
            within = torch.cat([within, within[-1:]])  # the last: not read
            actions = within.mean(1)
            remember(states, actions, spec)
            stretch = Record(times, states, actions, name=record.name)
            stretch.within = within
            steps.append(stretch)
    if not steps:
        raise ValueError(
            f"Expected a stretch as long as a control step, {step:.4g}, found none of {short}; "
            "take a shorter step."
        )
    if short:
        warnings.warn(
            f"Left out: {short} of {short + len(steps)} stretches, shorter than a step.",
            UserWarning,
            stacklevel=3,
        )
    return Records(steps, spec)


def remember(states: Tensor, actions: Tensor, spec: StateSpec) -> None:
    """Write earlier states and actions into the states of a stretch that hold them."""
    for _ in spec.previous:  # as often as the longest chain of them needs
        states[1:] = spec.remember(states[1:].clone(), states[:-1].clone(), actions[:-1])


def _checked_step(records: Records, step: float | None) -> float:
    """Return the control step: the argument, that of the spec, or the first sampling step."""
    of_spec = records.spec.step
    if step is None:
        return of_spec or records.records[0].sampling_step
    step = checked_number("step", step, above=0)
    if of_spec is not None and abs(step - of_spec) > _SAME * of_spec:
        raise ValueError(
            f"Expected the step of the spec, {of_spec:.4g}, got {step:.4g}; leave `step` out, or "
            "make a spec with this step."
        )
    return step


def _transitions(steps: Records) -> Trajectories:
    """Return all transitions of records in control steps, an episode for each."""
    lengths = torch.tensor([len(record.times) - 1 for record in steps])
    return Trajectories(
        torch.cat([record.states[:-1] for record in steps]),
        torch.cat([record.actions[:-1] for record in steps]),
        torch.cat([record.states[1:] for record in steps]),
        torch.arange(len(steps)).repeat_interleave(lengths),
    )
