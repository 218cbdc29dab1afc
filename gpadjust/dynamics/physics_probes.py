"""Whether a physics is the one that dynamics were used with."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.states import StateSpec

_PROBES = 3
_OF_SPREAD = 1e-4  # of what the physics says, by which another machine's may differ
_OF_SIZE = 1e-6  # of the states that it is computed from


class PhysicsProbes(NamedTuple):
    """A few transitions, and what a physics says of them.

    Args:
        states: ``k x state_dim``.
        actions: ``k x action_dim``.
        values: ``k x m``.
        tolerance: By how much the same physics may differ, ``m``.
    """

    states: Tensor
    actions: Tensor
    values: Tensor
    tolerance: Tensor

    @classmethod
    def of(
        cls, states: Tensor, actions: Tensor, values: Tensor, columns: list[int]
    ) -> PhysicsProbes:
        """At most 3 of ``N`` rows: of each third that where the physics says what is least usual.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            values: What the physics says of some states, ``N x m``.
            columns: Which states, ``m``.
        """
        departure = (values - values.mean(0)).abs()
        spread = departure.square().mean(0).sqrt()
        unusual = (departure / spread.clamp_min(torch.finfo(spread.dtype).tiny)).amax(-1)
        rows = torch.arange(len(values)).tensor_split(_PROBES)
        chosen = torch.stack([some[unusual[some].argmax()] for some in rows if len(some)])
        size = torch.cat([states[:, columns], values]).abs().amax(0)
        tolerance = _OF_SPREAD * spread + _OF_SIZE * size
        return cls(states[chosen], actions[chosen], values[chosen], tolerance)

    @classmethod
    def checked(cls, given: Any, spec: StateSpec, num_values: int) -> PhysicsProbes:
        """Take probes from a state.

        Raises:
            RuntimeError: If they are none.
        """
        widths = (spec.state_dim, spec.action_dim, num_values)
        whole = isinstance(given, list | tuple) and all(map(torch.is_tensor, given))
        k = given[0].shape[:1] if whole and given else ()
        expected = [*((*k, width) for width in widths), (num_values,)]
        if not whole or expected != [tuple(t.shape) for t in given if t.dtype == torch.float64]:
            raise RuntimeError(
                "The state is damaged: expected 'probes' as float64 tensors of k rows each, with "
                f"{widths} columns, and {num_values} tolerances."
            )
        return cls(*(tensor.clone() for tensor in given))

    def check(self, found: Tensor, physics: str, spec: StateSpec, columns: list[int]) -> None:
        """Raise a RuntimeError, as PyTorch does of a state, if a physics says something else.

        Args:
            found: What it says, ``k x m``.
            physics: Its name.
            spec: What the entries of the state are.
            columns: Which states these are, ``m``.
        """
        names = [spec.states[i] for i in columns]
        gap = found - self.values
        for i in (i for i, name in enumerate(names) if name in spec.angles):
            gap[:, i] = torch.atan2(gap[:, i].sin(), gap[:, i].cos())
        excess = gap.abs() - self.tolerance
        if (excess <= 0).all():
            return
        row, column = divmod(int(excess.argmax()), excess.shape[-1])
        raise RuntimeError(
            f"The state is of dynamics with another physics than {physics!r} here. In the state "
            f"{self.states[row].tolist()}, after the action {self.actions[row].tolist()}, that "
            f"one said {float(self.values[row, column]):.6g} of {names[column]!r}, this one says "
            f"{float(found[row, column]):.6g}. Load the state into dynamics of the physics that it "
            "was learnt with, or learn from its transitions again. A physics that is not "
            "deterministic looks the same: dynamics need one that says the same each time."
        )
