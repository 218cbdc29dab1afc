"""Trajectories of a system, and windows of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import check_columns, check_finite, check_observed, checked_whole
from gpadjust.states import StateSpec


class Windows(NamedTuple):
    """Parts of trajectories, of the same length, for free runs: ``w`` windows of ``T`` steps.

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
        """Return the windows of these numbers, or those where ``w`` booleans are true."""
        return Windows(*(part[rows] for part in self))

    def spread(self, number: int, seed: int = 0) -> Windows:
        """Draw a number of the windows evenly, as by :meth:`Trajectories.spread`."""
        return self.some(spread_rows(len(self.actions), number, seed))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories of a system: rows of transitions, and to which episode each belongs.

    The next state of a row is the state of the row after it if both are of the same episode. They
    unpack to states, actions and next states, ``dynamics.update(*trajectories)``.

    Args:
        states: ``N x state_dim``.
        actions: ``N x action_dim``.
        next_states: ``N x state_dim``; NaN where an entry was not measured.
        episode: ``N`` whole numbers; the rows of an episode follow each other. Default: each row is
            an episode, as of transitions that were measured one by one.
        rewards: ``N``, of an agent's real steps. Default: none.
        terminated: ``N`` booleans, whether the next state ended the episode. Default: none.

    Raises:
        ValueError: If they differ in their numbers of rows, or an episode has rows of another one
            between its own.

    Example:
        >>> x = torch.arange(6, dtype=torch.float64).unsqueeze(-1)
        >>> two = Trajectories(x, x, x + 1, episode=[0, 0, 0, 0, 1, 1])
        >>> two.windows(2).states[..., 0]
        tensor([[0., 1., 2.],
                [2., 3., 4.],
                [4., 5., 6.]], dtype=torch.float64)
        >>> two.spread(2).states.flatten() // 3
        tensor([0., 1.], dtype=torch.float64)
    """

    states: Tensor
    actions: Tensor
    next_states: Tensor
    episode: Tensor = None  # type: ignore[assignment]
    rewards: Tensor = None  # type: ignore[assignment]
    terminated: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Number the episodes, and check the numbers of rows."""
        given: Any = self.episode
        episode = torch.arange(len(self.states)) if given is None else torch.as_tensor(given)
        if episode.is_floating_point() and (episode != episode.round()).any():
            raise ValueError(f"Expected episode as whole numbers, found {episode.tolist()[:5]}.")
        object.__setattr__(self, "episode", episode.long())
        found = {name: len(tensor) for name, tensor in self._columns.items()}
        if len({*found.values()}) > 1 or self.episode.dim() != 1:
            raise ValueError(
                f"Expected {', '.join(found)} with as many rows each, found "
                f"{', '.join(f'{number} of {name}' for name, number in found.items())}."
            )
        if len(self.episode.unique_consecutive()) > len(self.episode.unique()):
            raise ValueError(
                "Expected the rows of an episode one after the other, found rows of another "
                "episode between them; sort the rows, or number the parts as episodes."
            )

    @classmethod
    def checked(
        cls,
        spec: StateSpec,
        states: Tensor,
        actions: Tensor,
        next_states: Tensor,
        episode: Tensor | Sequence[int] | None = None,
    ) -> Trajectories:
        """Take the user's tensors, copied.

        Raises:
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree, there are no rows, values are not finite, or nothing
                was measured of a next state that a model predicts.
        """
        named = {"states": states, "actions": actions, "next_states": next_states}
        for name, tensor in named.items():
            check_doubles(name, tensor, spec.action_dim if name == "actions" else spec.state_dim)
        if states.dim() != 2 or len({t.shape[:-1] for t in named.values()}) > 1 or not len(states):
            raise ValueError(
                "Expected states, actions and next_states with as many rows each, and at least "
                f"one; got shapes {', '.join(str(tuple(t.shape)) for t in named.values())}."
            )
        check_finite("states", states)
        check_finite("actions", actions)
        check_observed("next_states", next_states)
        predicted = next_states[:, spec.predicted]
        check_observed("the predicted entries of next_states", predicted)
        copies = {name: tensor.detach().clone() for name, tensor in named.items()}
        return cls(**copies, episode=episode)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Tensor]:
        """Yield states, actions and next states."""
        return iter((self.states, self.actions, self.next_states))

    def __len__(self) -> int:
        """Return the number of transitions."""
        return len(self.states)

    @property
    def steps(self) -> Tensor:
        """The number of each step in its episode, from 1."""
        return torch.cat([torch.arange(n) for n in self._lengths or [0]]) + 1

    @property
    def longest(self) -> int:
        """Number of steps of the longest episode."""
        return max(self._lengths, default=0)

    @property
    def _lengths(self) -> list[int]:
        lengths: list[int] = self.episode.unique_consecutive(return_counts=True)[1].tolist()
        return lengths

    @property
    def _columns(self) -> dict[str, Tensor]:
        return {name: value for name, value in vars(self).items() if value is not None}

    def append(self, other: Trajectories) -> Trajectories:
        """Return these trajectories, then others; no episode goes on in them."""
        last = self.episode.max() if len(self) else -1
        first = other.episode.min() if len(other) else 0
        parts = self._columns, other._columns
        parts[1]["episode"] = other.episode - first + last + 1
        names = parts[0].keys() & parts[1].keys()
        return Trajectories(**{name: torch.cat([part[name] for part in parts]) for name in names})

    def some(self, rows: Tensor | slice) -> Trajectories:
        """Return the rows of these numbers, a slice, or those where ``N`` booleans are true.

        Episodes are numbered again: one ends wherever the row after it is left out.
        """
        numbers = torch.arange(len(self))[rows]
        columns = {name: column[numbers] for name, column in self._columns.items()}
        begins = (numbers.diff() != 1) | (columns["episode"].diff() != 0)
        columns["episode"][1:] = begins.cumsum(0)
        columns["episode"][:1] = 0
        return Trajectories(**columns)

    def episodes(self) -> list[Trajectories]:
        """Return the episodes, each by itself."""
        return [self.some(rows) for rows in torch.arange(len(self)).split(self._lengths)]

    def spread(self, number: int, seed: int = 0) -> Trajectories:
        """Draw a number of the rows evenly: one of each of as many parts of the same length."""
        return self.some(spread_rows(len(self), number, seed))

    def windows(self, length: int, stride: int | None = None) -> Windows:
        """Cut windows within episodes, to compare with :meth:`Dynamics.free_run`.

        A window starts only at a state that was measured in full; else at the next one that was.

        Args:
            length: The number ``T`` of steps.
            stride: Steps from the start of a window to that of the next. Default: ``length``.

        Raises:
            ValueError: If no episode is as long, or a number is no positive whole one.
        """
        checked_whole("length", length, 1)
        stride = length if stride is None else checked_whole("stride", stride, 1)
        complete, starts, end = (~self.states.isnan().any(-1)).tolist(), [], 0
        for steps in self._lengths:
            row, end = end, end + steps
            while row + length <= end:
                if complete[row]:
                    starts.append(row)
                row += stride if complete[row] else 1
        if not starts:
            raise ValueError(
                f"Expected stretches of {length} steps from a state measured in full, found none; "
                f"the longest stretch has {self.longest}. Take a smaller length."
            )
        rows = torch.tensor(starts).unsqueeze(-1) + torch.arange(length)
        return Windows(self.states[rows[:, 0]], self.actions[rows], self.next_states[rows])


def check_doubles(name: str, tensor: Tensor, columns: int) -> None:
    """Raise an error unless a tensor is ``... x columns``, in float64."""
    check_columns(name, tensor, columns)
    if tensor.dtype != torch.float64:
        raise TypeError(f"Expected {name} in float64, got {tensor.dtype}; use `{name}.double()`.")


def spread_rows(total: int, number: int, seed: int) -> Tensor:
    """Draw from the numbers below ``total``, one of each of ``number`` parts of the same length."""
    if checked_whole("number", number, 1) > total:
        raise ValueError(f"Expected number <= {total}, that of all there are, got {number}.")
    edges = torch.arange(number + 1) * total // number
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(number, generator=generator, dtype=torch.float64)
    return edges[:-1] + (share * edges.diff()).long()
