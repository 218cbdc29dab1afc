"""Observed transitions of a system."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import check_columns, check_finite, check_observed, checked_whole
from gpadjust.states import StateSpec


class Transitions(NamedTuple):
    """Transitions of a system, row by row.

    Args:
        states: ``N x state_dim``.
        actions: ``N x action_dim``.
        next_states: ``N x state_dim``; NaN where an entry was not measured.
    """

    states: Tensor
    actions: Tensor
    next_states: Tensor

    @classmethod
    def checked(
        cls, spec: StateSpec, states: Tensor, actions: Tensor, next_states: Tensor
    ) -> Transitions:
        """Take the user's tensors, copied.

        Raises:
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree, there are no rows, values are not finite, or of a next
                state nothing was measured that a model predicts.
        """
        named = {"states": states, "actions": actions, "next_states": next_states}
        for name, tensor in named.items():
            columns = spec.action_dim if name == "actions" else spec.state_dim
            check_columns(name, tensor, columns)
            if tensor.dtype != torch.float64:
                raise TypeError(
                    f"Expected {name} in float64, got {tensor.dtype}; use `{name}.double()`."
                )
            if tensor.dim() != 2 or len(tensor) != len(states) or not len(tensor):
                raise ValueError(
                    "Expected states, actions and next_states with as many rows each, and at least "
                    f"one; got shapes {', '.join(str(tuple(t.shape)) for t in named.values())}."
                )
            if name == "next_states":
                check_observed(name, tensor)
                check_observed("the predicted entries of next_states", tensor[:, spec.predicted])
            else:
                check_finite(name, tensor)
        return cls(*(tensor.detach().clone() for tensor in named.values()))

    def append(self, other: Transitions) -> Transitions:
        """These transitions, then others."""
        return Transitions(*(torch.cat(pair) for pair in zip(self, other, strict=True)))

    def rows(self, start: int, end: int) -> Transitions:
        """Rows that follow each other."""
        return Transitions(*(tensor[start:end] for tensor in self))

    def some(self, rows: Tensor) -> Transitions:
        """The rows of these numbers."""
        return Transitions(*(tensor[rows] for tensor in self))

    def spread(self, number: int, seed: int = 0) -> Transitions:
        """So many of the rows, drawn evenly: one of each of as many parts of the same length.

        Args:
            number: How many rows.
            seed: Seed of the draw; PyTorch's generator is left as it is.

        Raises:
            ValueError: If there are fewer, or ``number`` is no positive whole number.

        Example:
            >>> import torch
            >>> from gpadjust.dynamics import Transitions
            >>> rows = torch.arange(100, dtype=torch.float64).unsqueeze(-1)
            >>> Transitions(rows, rows, rows + 1).spread(4).states.flatten() // 25
            tensor([0., 1., 2., 3.], dtype=torch.float64)
        """
        return self.some(spread_rows(len(self.states), number, seed, "transitions"))


def spread_rows(total: int, number: int, seed: int, what: str) -> Tensor:
    """So many of the numbers below ``total``, one of each of as many parts of the same length.

    Raises:
        ValueError: If there are fewer, or ``number`` is no positive whole number.
    """
    checked_whole("number", number, 1)
    if number > total:
        raise ValueError(f"Expected number <= {total}, the {what} that there are, got {number}.")
    edges = torch.arange(number + 1) * total // number
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(number, generator=generator, dtype=torch.float64)
    return edges[:-1] + (share * edges.diff()).long()
