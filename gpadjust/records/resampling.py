"""Records brought to even steps."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.records.record import Record
from gpadjust.states import StateSpec

_ROUNDING = 1e-6  # of a step
_FINEST = 0.5  # sampling steps: with shorter ones most new rows would lie between the same two


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
