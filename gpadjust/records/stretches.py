"""Stretches of measured records, in control steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import NamedTuple

from torch import Tensor

from gpadjust.records.record import Record
from gpadjust.states import StateSpec

_SAME = 0.01  # of a step, by which another one may differ from it


class Stretch(NamedTuple):
    """Control steps that follow each other.

    Args:
        states: Before the first step and after each, ``n + 1 x state_dim``.
        actions: ``n x action_dim``.
        times: Of the states, ``n + 1``.
        record: The number of the record.
    """

    states: Tensor
    actions: Tensor
    times: Tensor
    record: int


def in_control_steps(
    records: Sequence[Record], spec: StateSpec, step: float | None
) -> list[Stretch]:
    """All stretches of the records; see :class:`~gpadjust.records.Records`.

    Args:
        records: The records.
        spec: What the entries of states and actions are.
        step: The control step; None for that of the spec, or else the sampling step.

    Raises:
        ValueError: If no stretch is as long as a step, sampling steps differ or are uneven, or the
            step is no multiple of them or not that of the spec.
    """
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


def checked_step(step: float, name: str = "step") -> float:
    """A time that is positive and finite.

    Raises:
        TypeError: If it is no number.
        ValueError: If it is none above zero.
    """
    if isinstance(step, bool) or not isinstance(step, Real):
        raise TypeError(f"Expected {name} as a number, found {step!r}.")
    if not 0 < step < math.inf:
        raise ValueError(f"Expected {name} to be positive and finite, found {step}.")
    return float(step)


def _rows_a_step(records: Sequence[Record], spec: StateSpec, step: float | None) -> int:
    """How many rows of the records make a control step."""
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
    wanted = spec.step if step is None else checked_step(step)
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
