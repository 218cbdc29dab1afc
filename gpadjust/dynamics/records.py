"""Measured trajectories, as transitions and windows of a control step."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import checked_number, checked_whole
from gpadjust.dynamics.control_steps import in_control_steps
from gpadjust.dynamics.csv_record import checked_columns, read_record
from gpadjust.dynamics.open_loop import steps_ahead
from gpadjust.dynamics.record import Record
from gpadjust.dynamics.resampling import resampled
from gpadjust.dynamics.transitions import Transitions, spread_rows
from gpadjust.states import StateSpec


class Windows(NamedTuple):
    """Parts of records, of the same length, for free runs: ``w`` windows of ``T`` control steps.

    Args:
        initial_states: ``w x state_dim``.
        actions: ``w x T x action_dim``.
        measured: The states after each action, ``w x T x state_dim``; NaN where an entry was not
            measured.
    """

    initial_states: Tensor
    actions: Tensor
    measured: Tensor

    @property
    def states(self) -> Tensor:
        """The initial states, then what was measured: ``w x (T + 1) x state_dim``."""
        return torch.cat([self.initial_states.unsqueeze(1), self.measured], dim=1)

    def some(self, rows: Tensor | list[int]) -> Windows:
        """The windows of these numbers, or those where a tensor of ``w`` booleans is true.

        Example:
            >>> import torch
            >>> from gpadjust.dynamics import Record, Records, StateSpec
            >>> x = torch.arange(9, dtype=torch.float64).unsqueeze(-1)
            >>> windows = Records(Record(x[:, 0], x, x), StateSpec(["x"], ["u"])).windows(2)
            >>> fast = (windows.states.abs() > 3).any(1).any(-1)
            >>> windows.some(fast).states[..., 0]
            tensor([[2., 3., 4.],
                    [4., 5., 6.],
                    [6., 7., 8.]], dtype=torch.float64)
        """
        return Windows(*(part[rows] for part in self))

    def spread(self, number: int, seed: int = 0) -> Windows:
        """So many of the windows, drawn evenly, as by :meth:`Transitions.spread`."""
        return self.some(spread_rows(len(self.states), number, seed, "windows"))

    def as_records(self, spec: StateSpec, step: float) -> Records:
        """A record of each window, such as to :func:`smooth` them.

        Args:
            spec: What the entries of states and actions are.
            step: The control step.
        """
        step = checked_number("step", step, above=0)
        times = step * torch.arange(self.states.shape[1], dtype=torch.float64)
        actions = torch.cat([self.actions, self.actions[:, -1:]], dim=1)  # the last one is not read
        parts = enumerate(zip(self.states, actions, strict=True))
        return Records([Record(times, *part, name=f"window {i}") for i, part in parts], spec)


class Records:
    """Measured trajectories of one system.

    The control step is a whole multiple of the sampling step: of its states each k-th row of a
    stretch is one, and its action the mean of the k actions. No step leads from one segment, record
    or side of a gap to another. States that hold previous values (lagged actions and outputs) are
    filled in: what was there a step before, and at the first row of a stretch what was recorded
    there. Where nothing was, steps begin later by as many as the spec looks back.

    Args:
        records: The records, a :class:`Record` each.
        spec: What the entries of their states and actions are.

    Raises:
        TypeError: If ``spec`` is no :class:`StateSpec`, or a record no :class:`Record`.
        ValueError: If there are none, or one has not the columns of the spec.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import Record, Records, StateSpec
        >>> spec = StateSpec(["x"], ["v"])
        >>> times = 0.01 * torch.arange(101, dtype=torch.float64)
        >>> record = Record(times, times.sin().unsqueeze(-1), times.cos().unsqueeze(-1))
        >>> records = Records([record], spec)
        >>> states, actions, next_states = records.transitions(0.05)
        >>> len(states), bool((next_states - states - 0.05 * actions).abs().max() < 0.001)
        (20, True)
        >>> records.windows(10, 0.05).measured.shape
        torch.Size([2, 10, 1])
    """

    def __init__(self, records: Iterable[Record], spec: StateSpec) -> None:
        _check_spec(spec)
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
            >>> from gpadjust.dynamics import Records, StateSpec
            >>> spec = StateSpec(["theta", "omega"], ["torque"], angles=["theta"])
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     file = Path(folder, "swing.csv")
            ...     _ = file.write_text("time,q,dq,u\n0,0.1,0,1\n0.5,0.2,0.4,1\n1,0.5,0.8,0\n")
            ...     columns = {"theta": "q", "omega": "dq"}
            ...     records = Records.read_csv(file, spec, states=columns, actions={"torque": "u"})
            >>> records.transitions().states
            tensor([[0.1000, 0.0000],
                    [0.2000, 0.4000]], dtype=torch.float64)
        """
        _check_spec(spec)
        columns = (
            checked_columns(states, spec.states, "states"),
            checked_columns(actions, spec.actions, "actions"),
        )
        several = [files] if isinstance(files, str | Path) else files
        records = [
            read_record(f, spec, *columns, time, segment, delimiter, decimal) for f in several
        ]
        return cls(records, spec)

    def transitions(self, step: float | None = None) -> Transitions:
        """The transitions of all records, as dynamics learn them and score them.

        Rows are in the order of the records, so that
        :meth:`~gpadjust.dynamics.Dynamics.score_trajectories` finds the stretches. That takes a row
        to lead to the next one if what was measured of its next state is the state there. A row of
        which this would be chance, as its next state was not measured in full, is left out.

        Args:
            step: The control step, in the unit of the times. Default: the step of the spec, and
                without one the sampling step.

        Raises:
            ValueError: If there are no transitions, the sampling steps of records differ or are
                uneven, the step is no multiple of them, or another one than the spec says.

        Warns:
            UserWarning: If steps are left out, because they start at a state that was not measured
                in full, or end at one of which nothing was measured that a model predicts, or as
                above; or stretches, because they are shorter than a step.
        """
        stretches = in_control_steps(self.records, self.spec, step)
        parts = [(each.states[:-1], each.actions, each.states[1:]) for each in stretches]
        data = Transitions(*(torch.cat(columns) for columns in zip(*parts, strict=True)))
        complete = ~data.states.isnan().any(-1)
        says = ~data.next_states[:, self.spec.predicted].isnan().all(-1)
        kept = data.some(complete & says)
        while (joined := self._joined_by_chance(kept)).any():
            kept = kept.some(~joined)
        if not len(kept.states):
            columns = zip(self.spec.states, (~data.states.isnan()).sum(0).tolist(), strict=True)
            raise ValueError(
                f"Expected steps from a state that was measured in full, found none of "
                f"{len(data.states)}; of these were measured, state by state: "
                f"{', '.join(f'{name} {number}' for name, number in columns)}."
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

        Args:
            length: The number ``T`` of control steps.
            step: The control step, as of :meth:`transitions`.
            stride: How many steps after a window starts the next one. Default: ``length``, so that
                they do not overlap.

        Raises:
            ValueError: If no stretch is as long, or as :meth:`transitions`.
        """
        checked_whole("length", length, 1)
        stride = length if stride is None else stride
        checked_whole("stride", stride, 1)
        stretches, found = in_control_steps(self.records, self.spec, step), []
        for states, actions, *_ in stretches:
            complete, start = (~states.isnan().any(-1)).tolist(), 0
            while start + length <= len(actions):
                end = start + length
                if complete[start]:
                    found.append((states[start], actions[start:end], states[start + 1 : end + 1]))
                start += stride if complete[start] else 1
        if not found:
            raise ValueError(
                f"Expected stretches of {length} steps from a state measured in full, found none; "
                f"the longest stretch has {max(len(each.actions) for each in stretches)}. Take a "
                "smaller length."
            )
        return Windows(*(torch.stack(parts) for parts in zip(*found, strict=True)))

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

    def _joined_by_chance(self, data: Transitions) -> Tensor:
        """Rows after which an episode would seem to go on, as entries were not measured: ``N``.

        Where one does go on, the next state is one that a transition starts at: complete.
        """
        if not len(data.states):
            return torch.zeros(0, dtype=torch.bool)
        return (steps_ahead(self.spec, data) > 1) & data.next_states.isnan().any(-1)


def _check_spec(spec: StateSpec) -> None:
    if not isinstance(spec, StateSpec):
        raise TypeError(
            f"Expected spec as a StateSpec, such as StateSpec(['x', 'v'], ['force']); found "
            f"{spec!r}."
        )
