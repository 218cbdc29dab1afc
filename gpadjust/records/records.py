"""Measured trajectories: read from files, in control steps, and as windows."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from gpadjust.checks import checked_number
from gpadjust.dynamics import Trajectories, Windows
from gpadjust.dynamics.targets import check_spec
from gpadjust.files.table_columns import TableColumns
from gpadjust.records.record import Record, Stretch, in_control_steps, resampled
from gpadjust.states import StateSpec


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
        >>> spec = StateSpec(["x"], ["v"])
        >>> times = 0.01 * torch.arange(101, dtype=torch.float64)
        >>> record = Record(times, times.sin().unsqueeze(-1), times.cos().unsqueeze(-1))
        >>> records = Records([record], spec)
        >>> states, actions, next_states = records.trajectories(0.05)
        >>> len(states), bool((next_states - states - 0.05 * actions).abs().max() < 0.001)
        (20, True)
        >>> records.windows(10, 0.05).measured.shape
        torch.Size([2, 10, 1])
    """

    def __init__(self, records: Record | Iterable[Record], spec: StateSpec) -> None:
        check_spec(spec)
        if isinstance(records, Record):
            records = [records]
        self.records, self.spec = tuple(records), spec
        if not self.records:
            raise ValueError("Expected one record or more, found none.")
        for record in self.records:
            if not isinstance(record, Record):
                raise TypeError(
                    f"Expected each record as a Record(times, states, actions), found {record!r}."
                )
            for name in ("states", "actions"):
                expected, found = getattr(spec, name), getattr(record, name).shape[1]
                if found != len(expected):
                    raise ValueError(
                        f"Record {record.name!r}: expected {len(expected)} columns of {name}, "
                        f"{', '.join(expected)}, as the spec says, found {found}."
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

        The first line of a file names its columns; those that are not asked for are left alone. A
        field of a state is empty or NaN where it was not measured. States that hold previous values
        need no column.

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

        def read(file: str | Path) -> Record:
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
            return Record(times, *columns, labels, str(file))

        several = [files] if isinstance(files, str | Path) else files
        return cls([read(file) for file in several], spec)

    @classmethod
    def of_windows(cls, windows: Windows, spec: StateSpec, step: float) -> Records:
        """A record of each window, in control steps, such as to :func:`smooth` them.

        Args:
            windows: Windows, such as an agent's episodes in full length.
            spec: What the entries of states and actions are.
            step: The control step, in the unit of the times.

        Raises:
            TypeError: If ``spec`` is no :class:`StateSpec`, or ``step`` no number.
            ValueError: If ``step`` is not positive, or windows have not the columns of the spec.

        Example:
            >>> import torch
            >>> from gpadjust.dynamics import Trajectories
            >>> from gpadjust.records import Records
            >>> from gpadjust.states import StateSpec
            >>> x = torch.arange(6, dtype=torch.float64).unsqueeze(-1)
            >>> episodes = Trajectories(x, x, x + 1, episode=[0, 0, 0, 1, 1, 1])
            >>> [*Records.of_windows(episodes.windows(3), StateSpec(["x"], ["v"]), step=0.1)][0]
            Record('window 0', 4 rows every 0.1, 1 state, 1 action)
        """
        times = checked_number("step", step, above=0) * torch.arange(
            windows.states.shape[1], dtype=torch.float64
        )
        actions = torch.cat([windows.actions, windows.actions[:, -1:]], dim=1)  # the last: not read
        parts = enumerate(zip(windows.states, actions, strict=True))
        return cls([Record(times, *part, name=f"window {i}") for i, part in parts], spec)

    def trajectories(self, step: float | None = None) -> Trajectories:
        """The trajectories of all records, as dynamics learn them and score them.

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
        data, stretches = self._in_steps(step)
        complete = ~data.states.isnan().any(-1)
        kept = data.some(complete & ~data.next_states[:, self.spec.predicted].isnan().all(-1))
        if not len(kept.states):
            columns = zip(self.spec.states, (~data.states.isnan()).sum(0).tolist(), strict=True)
            raise ValueError(
                f"Expected steps from a state that was measured in full, found none of "
                f"{len(data.states)}; of these were measured, state by state: "
                f"{', '.join(f'{name} {number}' for name, number in columns)}.{self._hidden(data)}"
            )
        short = sum(not len(stretch.actions) for stretch in stretches)
        if short or len(kept.states) < len(data.states):
            warnings.warn(
                f"Left out: {short} of {len(stretches)} stretches, shorter than a step; "
                f"{len(data.states) - len(kept.states)} of {len(data.states)} steps, "
                f"{int((~complete).sum())} of which start at a state not measured in full.",
                UserWarning,
                stacklevel=2,
            )
        return kept

    def windows(self, length: int, step: float | None = None, stride: int | None = None) -> Windows:
        """Windows of all records, to compare with :meth:`~gpadjust.dynamics.Dynamics.free_run`.

        A window starts only at a state that was measured in full; else at the next one that was.
        What follows may lack entries.

        Args:
            length: The number ``T`` of control steps.
            step: The control step, as of :meth:`trajectories`.
            stride: How many steps after a window starts the next one. Default: ``length``, so that
                they do not overlap.

        Raises:
            ValueError: If no stretch is as long, a state is hidden, or as :meth:`trajectories`.
        """
        data, _ = self._in_steps(step)
        if hidden := self._hidden(data):
            raise ValueError(f"Expected states measured in full, for windows to start at.{hidden}")
        return data.windows(length, stride)

    def resampled(self, step: float, *, max_gap: float | None = None) -> Records:
        """Records with even rows of this step, from the beginning of each stretch.

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
        found = [resampled(record, self.spec, step, max_gap) for record in self.records]
        records = [record for record in found if record is not None]
        if not records:
            raise ValueError(
                f"Expected stretches as long as a step, {step:.4g}, found none; take a shorter "
                "step, or a longer max_gap."
            )
        if len(records) < len(found):
            names = [r.name for r, new in zip(self.records, found, strict=True) if new is None]
            warnings.warn(
                f"Records are left out that have no stretch as long as a step of {step:.4g}: "
                f"{', '.join(names)}.",
                UserWarning,
                stacklevel=2,
            )
        return Records(records, self.spec)

    def _in_steps(self, step: float | None) -> tuple[Trajectories, list[Stretch]]:
        """All control steps, an episode for each stretch; states are NaN as they were measured."""
        stretches = in_control_steps(self.records, self.spec, step)
        parts = [(each.states[:-1], each.actions, each.states[1:]) for each in stretches]
        lengths = torch.tensor([len(each.actions) for each in stretches])
        episode = torch.arange(len(stretches)).repeat_interleave(lengths)
        states, actions, following = (torch.cat(column) for column in zip(*parts, strict=True))
        return Trajectories(states, actions, following, episode), stretches

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
    """The column of each name: the one given, or else that of the same name."""
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
