"""Measured trajectories of a machine: checked, read from files, in control steps, at even times."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import checked_number
from gpadjust.core.data import ArrayLike, as_tensor
from gpadjust.dynamics import Trajectories, Windows
from gpadjust.dynamics.targets import check_spec
from gpadjust.files.table_columns import TableColumns
from gpadjust.states import StateSpec

_GAP = 1.5  # typical steps: a longer time between two rows is a gap
_OFTEN = 0.1  # of all times between rows: so many gaps are none
_SAME = 0.01  # of a step, by which another one may differ from it
_ROUNDING = 1e-6  # of a step
_FINEST = 0.5  # sampling steps: with shorter ones most new rows would lie between the same two
_JITTER = 0.1  # of the sampling step, by which the time between two rows may differ from it

Rows = tuple[Tensor, Tensor, Tensor]  # times, states and actions


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
        self._check()

    def __repr__(self) -> str:
        states, actions = self.states.shape[1], self.actions.shape[1]
        return (
            f"Record({self.name!r}, {len(self.times)} rows every {self.sampling_step:.4g}, "
            f"{states} state{'s' * (states > 1)}, {actions} action{'s' * (actions > 1)})"
        )

    @property
    def sampling_step(self) -> float:
        """The mean time from one row to the next, without gaps."""
        steps = self.times.diff()[self._follows]
        return float(steps[steps <= _GAP * steps.median()].mean())

    def stretches(self, max_gap: float | None = None) -> list[slice]:
        """Return the rows that follow each other, stretch by stretch.

        Args:
            max_gap: The longest time between two such rows. Default: 1.5 times the median.

        Raises:
            ValueError: If times differ so much that it takes ``max_gap`` to say what a gap is.
        """
        steps = self.times.diff()
        if max_gap is None:
            within = steps[self._follows]
            max_gap = _GAP * float(within.median())
            longer = int((within > max_gap).sum())
            if longer > max(1, _OFTEN * len(within)):
                raise self._error(
                    f": expected even sampling with few gaps, found {longer} of {len(within)} "
                    f"times between rows longer than {_GAP:g} times the median, "
                    f"{max_gap / _GAP:.4g}. Bring it to even steps with `records.resampled(step, "
                    "max_gap=...)`, where max_gap is the longest time to interpolate over."
                )
        ends = (~self._follows | (steps > max_gap)).nonzero().flatten() + 1
        return [slice(*edges) for edges in pairwise([0, *ends.tolist(), len(self.times)])]

    def check_even(self) -> None:
        """Raise a ValueError unless the sampling is even, to a tenth of its step."""
        step = self.sampling_step
        for rows in self.stretches():
            steps = self.times[rows].diff()
            off = (steps - step).abs()
            if len(off) and off.max() > _JITTER * step:
                row = int(off.argmax())
                raise self._error(
                    f": expected even sampling, to a tenth of its step {step:.4g}, found "
                    f"{float(steps[row]):.4g} from row {rows.start + row} to the next. Bring it to "
                    "even steps with `records.resampled(step)`."
                )

    @cached_property
    def _follows(self) -> Tensor:
        """True for each row but the first that is of the segment of the one before, ``N - 1``."""
        labels = self.segments or [0] * len(self.times)
        same = [label == after for label, after in pairwise(labels)]
        return torch.tensor(same, dtype=torch.bool)

    def _error(self, message: str) -> ValueError:
        return ValueError(f"Record {self.name!r}{message}")

    def _numbers(self, values: ArrayLike, name: str, dims: int) -> Tensor:
        tensor = as_tensor(values, name).detach().clone()
        if tensor.dim() != dims or 0 in tensor.shape[1:]:
            expected = "N" if dims == 1 else f"N x {name.removesuffix('s')}_dim"
            raise self._error(
                f": expected {name} of shape {expected}, got {tuple(tensor.shape)}"
                + ("; of a single column, use `.reshape(-1, 1)`." if dims > tensor.dim() else ".")
            )
        return tensor

    def _check(self) -> None:
        """Raise an error unless rows are as many, two follow each other, and values are known."""
        parts = {"times": self.times, "states": self.states, "actions": self.actions}
        rows = {name: len(part) for name, part in parts.items()}
        rows |= {} if self.segments is None else {"segments": len(self.segments)}
        if len({*rows.values()}) > 1:
            counts = ", ".join(f"{number} of {name}" for name, number in rows.items())
            raise self._error(f": expected as many rows of each, found {counts}.")
        for row, label in enumerate(self.segments or ()):
            if label is None or label != label:  # NaN, which would be a segment of its own
                raise self._error(
                    f", row {row}: expected a label of its segment, found {label}; leave out rows "
                    "that are of no segment."
                )
        if not self._follows.any():
            raise self._error(
                ": expected two rows or more of a segment, one after the other, found "
                f"{len(self.times)} in all; leave the record out, or correct `segments`."
            )
        ways_out = {
            "times": "leave the row out",
            "states": "put NaN where an entry was not measured",
            "actions": "split the record there, by `segments` or in two, without that row",
        }
        for name, part in parts.items():
            values = part.reshape(len(part), -1)
            bad = values.isinf() if name == "states" else ~values.isfinite()
            if bad.any():
                row, column = bad.nonzero()[0].tolist()
                raise self._error(
                    f", row {row}: expected finite numbers, found {float(values[row, column])} in "
                    f"column {column} of {name}; {ways_out[name]}."
                )
        stops = (self.times.diff() <= 0) & self._follows
        if stops.any():
            row = int(stops.nonzero()[0]) + 1
            before, time = self.times[row - 1 : row + 1].tolist()
            raise self._error(
                f", row {row}: expected times that rise, found {time:.10g} after {before:.10g}. "
                "Leave out rows that were written twice; where the clock was set again, begin a "
                "new segment by `segments`."
            )


def _in_seconds(times: ArrayLike) -> ArrayLike:
    """Return dates and durations as seconds since the first, anything else as it is."""
    if not hasattr(times, "dtype") or isinstance(times, Tensor) or not len(times):
        return times
    dates = np.asarray(times)
    first = dates.flat[0]
    if dates.dtype.kind == "O" and isinstance(first, datetime | timedelta):
        kind = "datetime64[ns]" if isinstance(first, datetime) else "timedelta64[ns]"
        if getattr(first, "tzinfo", None) is not None:  # NumPy has no time zones
            dates = np.array([date.astimezone(UTC).replace(tzinfo=None) for date in dates])
        dates = dates.astype(kind)
    return (dates - dates[0]) / np.timedelta64(1, "s") if dates.dtype.kind in "mM" else times


class Records:
    """Measured trajectories of one system.

    The control step is a whole multiple of the sampling step: of its states each k-th row of a
    stretch is one, and its action the mean of the k actions. No step leads from one segment, record
    or side of a gap to another. States that hold previous values (lagged actions and outputs) are
    filled in: what was there a step before, and at the first row of a stretch what was recorded
    there. Where nothing was, steps begin later by as many as the spec looks back.

    Args:
        records: The records, a :class:`Record` each, or one.
        spec: What the entries of their states and actions are.

    Raises:
        TypeError: If ``spec`` is no :class:`StateSpec`, or a record no :class:`Record`.
        ValueError: If there are none, or one has not the columns of the spec.

    Example:
        >>> import torch
        >>> from gpadjust.records import Record, Records
        >>> from gpadjust.states import StateSpec
        >>> times = 0.01 * torch.arange(101, dtype=torch.float64)
        >>> record = Record(times, times.sin().unsqueeze(-1), times.cos().unsqueeze(-1))
        >>> records = Records([record], StateSpec(["x"], ["v"]))
        >>> states, actions, next_states = records.trajectories(0.05)
        >>> len(states), bool((next_states - states - 0.05 * actions).abs().max() < 0.001)
        (20, True)
        >>> records.windows(10, 0.05).measured.shape
        torch.Size([2, 10, 1])
    """

    def __init__(self, records: Record | Iterable[Record], spec: StateSpec) -> None:
        check_spec(spec)
        self.records = (records,) if isinstance(records, Record) else tuple(records)
        self.spec = spec
        if not self.records:
            raise ValueError("Expected one record or more, found none.")
        for record in self.records:
            if not isinstance(record, Record):
                raise TypeError(
                    f"Expected each record as a Record(times, states, actions), found {record!r}."
                )
            for name in ("states", "actions"):
                expected, columns = getattr(spec, name), getattr(record, name).shape[1]
                if columns != len(expected):
                    raise ValueError(
                        f"Record {record.name!r}: expected {len(expected)} columns of {name}, "
                        f"{', '.join(expected)}, as the spec says, found {columns}."
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
        files: str | Path | Iterable[str | Path],
        spec: StateSpec,
        *,
        states: Mapping[str, str | None] | None = None,
        actions: Mapping[str, str] | None = None,
        time: str | float = "time",
        segment: str | None = None,
        delimiter: str = ",",
        decimal: str = ".",
    ) -> Records:
        r"""Read records from CSV files, one from each.

        The first line of a file names its columns, of which there may be others. A field of a state
        is empty or NaN where it was not measured. States that hold previous values need no column.

        Args:
            files: The file, or several.
            spec: What the entries of states and actions are.
            states: Which columns have the states, such as ``{"theta": "q"}``; None for a state that
                is hidden, which :func:`smooth` estimates. Default, also for states that are not
                said: the columns of their names.
            actions: The same for the actions.
            time: The column of times, or where there is none the time from one row to the next.
            segment: The column of the labels of segments. Default: a file is one segment.
            delimiter: What is between two fields.
            decimal: The decimal mark of numbers, a point or a comma.

        Raises:
            OSError: If a file cannot be read.
            TypeError: If ``spec`` is no :class:`StateSpec`.
            ValueError: If a name is none of the spec, a file has no rows or not these columns, a
                field is no number or a time or action is missing, with file, line and column; and
                as :class:`Record`.

        Example:
            >>> import tempfile
            >>> from pathlib import Path
            >>> from gpadjust.records import Records
            >>> from gpadjust.states import StateSpec
            >>> spec = StateSpec(["theta", "omega"], ["torque"], angles=["theta"])
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     file = Path(folder, "swing.csv")
            ...     _ = file.write_text("time,q,dq,u\n0,0.1,0,1\n0.5,0.2,0.4,1\n1,0.5,0.8,0\n")
            ...     columns = {"theta": "q", "omega": "dq"}
            ...     records = Records.read_csv(file, spec, states=columns, actions={"torque": "u"})
            >>> records.trajectories().states
            tensor([[0.1000, 0.0000],
                    [0.2000, 0.4000]], dtype=torch.float64)
        """
        check_spec(spec)
        state_columns = _columns(states, spec.states, "states")
        action_columns = _columns(actions, spec.actions, "actions")
        records = []
        for file in [files] if isinstance(files, str | Path) else files:
            table = TableColumns(file, delimiter, decimal=decimal)
            if isinstance(time, str):
                times = table.numbers(time)
            else:
                rows = torch.arange(len(table), dtype=torch.float64)
                times = checked_number("time", time, above=0) * rows
            measured = []
            for name, column in state_columns.items():
                filled_in = name in spec.previous and name == column and name not in table.names
                if column is None or filled_in:
                    measured.append(torch.full_like(times, math.nan))
                else:
                    measured.append(table.numbers(column, may_miss=True))
            taken = [table.numbers(column) for column in action_columns.values()]
            labels = None if segment is None else table.texts(segment)
            columns = torch.stack(measured, -1), torch.stack(taken, -1)
            records.append(Record(times, *columns, labels, str(file)))
        return cls(records, spec)

    @classmethod
    def of_windows(cls, windows: Windows, spec: StateSpec, step: float) -> Records:
        """Make a record of each window, such as of an agent's episodes, to :func:`smooth` them.

        Args:
            windows: Windows, in control steps.
            spec: What the entries of states and actions are.
            step: The control step, in the unit of the times.

        Raises:
            TypeError: If ``spec`` is no :class:`StateSpec`, or ``step`` no number.
            ValueError: If ``step`` is not positive, or windows have not the columns of the spec.
        """
        rows = torch.arange(windows.states.shape[1], dtype=torch.float64)
        times = checked_number("step", step, above=0) * rows
        actions = torch.cat([windows.actions, windows.actions[:, -1:]], dim=1)  # the last: not read
        parts = enumerate(zip(windows.states, actions, strict=True))
        return cls([Record(times, *part, name=f"window {i}") for i, part in parts], spec)

    def trajectories(self, step: float | None = None) -> Trajectories:
        """Return the trajectories of all records, as dynamics learn them and score them.

        Rows are in the order of the records. An episode is what follows each other without a gap,
        and without a row that is left out.

        Args:
            step: The control step, in the unit of the times. Default: the step of the spec, and
                without one the sampling step.

        Raises:
            ValueError: If there are no transitions, the sampling steps of records differ or are
                uneven, the step is no multiple of them, or another one than the spec says.

        Warns:
            UserWarning: If steps are left out, because they start at a state that was not measured
                in full, or end at one of which nothing was measured that a model predicts; or
                stretches, because they are shorter than a step.
        """
        data, short = self._transitions(step)
        complete = ~data.states.isnan().any(-1)
        kept = data.some(complete & ~data.next_states[:, self.spec.predicted].isnan().all(-1))
        if not len(kept.states):
            columns = zip(self.spec.states, (~data.states.isnan()).sum(0).tolist(), strict=True)
            raise ValueError(
                f"Expected steps from a state that was measured in full, found none of "
                f"{len(data.states)}; of these were measured, state by state: "
                f"{', '.join(f'{name} {number}' for name, number in columns)}.{self._hidden(data)}"
            )
        if short or len(kept.states) < len(data.states):
            total = short + len(data.episode.unique())
            warnings.warn(
                f"Left out: {short} of {total} stretches, shorter than a step; "
                f"{len(data.states) - len(kept.states)} of {len(data.states)} steps, "
                f"{int((~complete).sum())} of which start at a state not measured in full.",
                UserWarning,
                stacklevel=2,
            )
        return kept

    def windows(self, length: int, step: float | None = None, stride: int | None = None) -> Windows:
        """Cut windows, to compare with :meth:`~gpadjust.dynamics.Dynamics.free_run`.

        A window starts only at a state that was measured in full; else at the next one that was.
        What follows may lack entries.

        Args:
            length: The number ``T`` of control steps.
            step: The control step, as of :meth:`trajectories`.
            stride: Steps from the start of a window to that of the next. Default: ``length``.

        Raises:
            ValueError: If no stretch is as long, a state is hidden, or as :meth:`trajectories`.
        """
        data, _ = self._transitions(step)
        if hidden := self._hidden(data):
            raise ValueError(f"Expected states measured in full, for windows to start at.{hidden}")
        return data.windows(length, stride)

    def resampled(self, step: float, *, max_gap: float | None = None) -> Records:
        """Return records with even rows of this step, from the beginning of each stretch.

        States are on the line between the two rows about them (angles the shortest way round),
        which errs by up to an eighth of their acceleration times the square of the time between
        the rows, and NaN if one of these is; actions are means over the new steps. Stretches are
        segments of the new record, of a single row where they are shorter than a step.

        Args:
            step: The time from one new row to the next.
            max_gap: The longest time between two rows to interpolate over. Default: 1.5 times the
                median of a record.

        Raises:
            ValueError: If the step is less than half a sampling step, no stretch is as long as a
                step, or times differ so much that it takes ``max_gap`` to say what a gap is.

        Warns:
            UserWarning: If whole records are left out.
        """
        step = checked_number("step", step, above=0)
        max_gap = None if max_gap is None else checked_number("max_gap", max_gap, above=0)
        records, left_out = [], []
        for record in self.records:
            parts = _even_parts(record, self.spec, step, max_gap)
            if any(len(times) > 1 for times, *_ in parts):
                records.append(joined(parts, record.name))
            else:
                left_out.append(record.name)
        if not records:
            raise ValueError(
                f"Expected stretches as long as a step, {step:.4g}, found none; take a shorter "
                "step, or a longer max_gap."
            )
        if left_out:
            warnings.warn(
                f"Records are left out that have no stretch as long as a step of {step:.4g}: "
                f"{', '.join(left_out)}.",
                UserWarning,
                stacklevel=2,
            )
        return Records(records, self.spec)

    def _transitions(self, step: float | None) -> tuple[Trajectories, int]:
        """Return all steps, an episode for each stretch, and how many stretches are shorter."""
        steps, short = in_control_steps(self, step)
        stretches = [(each, rows) for each in steps for rows in each.stretches()]
        states = [each.states[rows] for each, rows in stretches]
        actions = torch.cat([each.actions[rows][:-1] for each, rows in stretches])
        before = torch.cat([part[:-1] for part in states])
        after = torch.cat([part[1:] for part in states])
        episode = [i for i, part in enumerate(states) for _ in part[1:]]
        return Trajectories(before, actions, after, torch.tensor(episode)), short

    def _hidden(self, data: Trajectories) -> str:
        """The way out if states were never measured; empty if there are none."""
        never = data.states.isnan().all(0).nonzero().flatten().tolist()
        if not never:
            return ""
        names = " and ".join(repr(self.spec.states[i]) for i in never)
        return (
            f" {names} was never measured: take states that smoothing finds, as in "
            "`smooth(records, physics, start=...).draw().windows(20)`."
        )


def _columns(given: Any, names: Sequence[str], argument: str) -> dict[str, Any]:
    """Return the column of each name: the one given, or else that of the same name."""
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise TypeError(
            f"Expected {argument} as a dictionary from names of the spec to columns, such as "
            f"{{{names[0]!r}: 'q'}}, found {given!r}."
        )
    if unknown := [name for name in given if name not in names]:
        raise ValueError(
            f"There is no {unknown[0]!r} among the {argument} of the spec, {tuple(names)}."
        )
    return {name: given.get(name, name) for name in names}


def in_control_steps(records: Records, step: float | None) -> tuple[Records, int]:
    """Return records whose rows are control steps, each stretch a segment.

    Also return how many stretches are left out, as they are shorter than a step. For ``step`` see
    :meth:`Records.trajectories`.
    """
    if not isinstance(records, Records):
        raise TypeError(f"Expected records as Records([record, ...], spec), found {records!r}.")
    every, spec = _rows_a_step(records, step), records.spec
    steps, short = [], 0
    for record in records:
        parts = []
        for rows in record.stretches():
            num_steps = (rows.stop - rows.start - 1) // every
            if not num_steps:
                short += 1
                continue
            taken = slice(rows.start, rows.start + num_steps * every + 1, every)
            states = record.states[taken].clone()
            if every > 1:  # recorded ones are of a row before, not of a step
                states[0, spec.previous_columns] = math.nan
            actions = record.actions[rows][: num_steps * every]
            actions = actions.unflatten(0, (num_steps, every)).mean(1)
            actions = torch.cat([actions, actions[-1:]])  # the last: not read
            parts.append((record.times[taken], states, actions))
        if parts:
            steps.append(remember(joined(parts, record.name), spec))
    if not steps:
        raise ValueError(
            f"Expected a stretch of {every + 1} rows or more, which are a control step, found none "
            f"of {short}; take a shorter step."
        )
    return Records(steps, spec), short


def remember(record: Record, spec: StateSpec) -> Record:
    """Write earlier states and actions into the states of control steps that hold them."""
    rows = record._follows.nonzero().flatten()
    for _ in spec.previous:  # as often as the longest chain of them needs
        earlier = record.states[rows], record.actions[rows]
        record.states[rows + 1] = spec.remember(record.states[rows + 1], *earlier)
    return record


def joined(parts: Sequence[Rows], name: str) -> Record:
    """Return a record with a segment for each part."""
    labels = [i for i, (times, *_) in enumerate(parts) for _ in times]
    times, states, actions = (torch.cat(column) for column in zip(*parts, strict=True))
    return Record(times, states, actions, labels, name)


def _rows_a_step(records: Records, step: float | None) -> int:
    """Return the number of rows of the records that make a control step."""
    for record in records:
        record.check_even()
    fast, *_, slow = sorted((*records, records.records[0]), key=lambda each: each.sampling_step)
    sampling, spec_step = fast.sampling_step, records.spec.step
    if slow.sampling_step - sampling > _SAME * sampling:
        raise ValueError(
            f"Expected records of one sampling step, found {sampling:.4g} of {fast.name!r} and "
            f"{slow.sampling_step:.4g} of {slow.name!r}; bring them to one by "
            f"`records.resampled({slow.sampling_step:.4g})`."
        )
    wanted = spec_step if step is None else checked_number("step", step, above=0)
    if wanted is None:
        return 1
    if spec_step is not None and abs(wanted - spec_step) > _SAME * spec_step:
        raise ValueError(
            f"Expected the step of the spec, {spec_step:.4g}, got {wanted:.4g}; leave `step` out, "
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


def _even_parts(record: Record, spec: StateSpec, step: float, max_gap: float | None) -> list[Rows]:
    """Return rows of this step, stretch by stretch; of a shorter one its first row."""
    finest = _FINEST * record.sampling_step
    if step < finest:
        raise ValueError(
            f"Record {record.name!r}: expected a step of half a sampling step, {finest:.4g}, or "
            f"more, as nothing was measured between rows; got {step:.4g}."
        )
    parts = []
    for rows in record.stretches(max_gap):
        times, states, actions = record.times[rows], record.states[rows], record.actions[rows]
        num_steps = int((times[-1] - times[0]) / step + _ROUNDING)
        if not num_steps:
            parts.append((times[:1], states[:1], actions[:1]))
            continue
        edges = times[0] + step * torch.arange(num_steps + 2, dtype=torch.float64)
        states = _interpolated(times, states, edges[:-1], spec.change)
        # The mean of an action is the difference of its integral, which is linear between rows.
        times = torch.cat([times, times[-1:] + edges[-1:] - edges[:1]])  # the last one goes on
        integral = torch.nn.functional.pad(actions * times.diff()[:, None], (0, 0, 1, 0)).cumsum(0)
        integral = _interpolated(times, integral, edges, lambda before, after: after - before)
        parts.append((edges[:-1], states, integral.diff(dim=0) / edges.diff()[:, None]))
    return parts


def _interpolated(
    times: Tensor, values: Tensor, at: Tensor, change: Callable[[Tensor, Tensor], Tensor]
) -> Tensor:
    """Return values ``n x k`` on the lines between rows; at a row that row, but for rounding."""
    rows = (torch.searchsorted(times, at, right=True) - 1).clamp(0, len(times) - 2)
    share = ((at - times[rows]) / (times[rows + 1] - times[rows])).clamp(0, 1)
    share = torch.where((share - share.round()).abs() < _ROUNDING, share.round(), share)[:, None]
    before, after = values[rows], values[rows + 1]
    between = before + share * change(before, after)
    # At a row it is what was measured there, whether its neighbour was or not.
    return torch.where(share == 0, before, torch.where(share == 1, after, between))
