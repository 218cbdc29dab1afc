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
    """Parts of trajectories with the same length, for free runs: ``w`` windows of ``T`` steps.

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
        """The initial states, then the measured ones: ``w x (T + 1) x state_dim``."""
        return torch.cat([self.initial_states.unsqueeze(1), self.measured], dim=1)

    def subset(self, rows: Tensor | list[int]) -> Windows:
        """Return the windows by their numbers, or by a mask of ``w`` booleans."""
        return Windows(*(part[rows] for part in self))

    def spread(self, number: int, seed: int = 0) -> Windows:
        """Draw some windows evenly, as :meth:`Trajectories.spread` does."""
        return self.subset(_spread_rows(len(self.actions), number, seed))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories of a system: rows of transitions, each with the number of its episode.

    The next state of a row is the state of the row after it if both belong to the same episode.
    They unpack to states, actions and next states, ``dynamics.update(*trajectories)``.

    Args:
        states: ``N x state_dim``.
        actions: ``N x action_dim``.
        next_states: ``N x state_dim``; NaN where an entry was not measured.
        episode: ``N`` whole numbers; the rows of an episode follow each other. Default: an episode
            for each row, for transitions measured one by one.
        rewards: ``N``, of an agent's real steps. Default: none.
        terminated: ``N`` booleans, True if the next state ended the episode. Default: none.

    Raises:
        ValueError: If numbers of rows differ, or rows of another episode interrupt an episode.

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
        """Set the numbers of episodes, and check the numbers of rows."""
        episode: Any = self.episode
        if episode is None:
            episode = range(len(self.states))
        episode = torch.as_tensor(episode)
        if episode.is_floating_point() and (episode != episode.round()).any():
            raise ValueError(f"Expected episode as whole numbers, found {episode.tolist()[:5]}.")
        object.__setattr__(self, "episode", episode.long())
        lengths = {name: len(tensor) for name, tensor in self._columns.items()}
        if len({*lengths.values()}) > 1 or self.episode.dim() != 1:
            counts = ", ".join(f"{number} of {name}" for name, number in lengths.items())
            raise ValueError(f"Expected columns with equally many rows, found {counts}.")
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
        """Return trajectories from copies of the user's tensors.

        Raises:
            TypeError, ValueError: If the arguments are not finite float64 tensors of ``N`` rows, or
                a row has no measured entry that a model predicts.
        """
        columns = {"states": states, "actions": actions, "next_states": next_states}
        for name, column in columns.items():
            check_doubles(name, column, spec.action_dim if name == "actions" else spec.state_dim)
        shapes = [tuple(column.shape) for column in columns.values()]
        if states.dim() != 2 or len({shape[:-1] for shape in shapes}) > 1 or not len(states):
            raise ValueError(
                "Expected states, actions and next_states with equally many rows, one or more; "
                f"got shapes {', '.join(map(str, shapes))}."
            )
        check_finite("states", states)
        check_finite("actions", actions)
        check_observed("next_states", next_states)
        predicted = next_states[:, spec.predicted]
        check_observed("the predicted entries of next_states", predicted)
        copies = {name: column.detach().clone() for name, column in columns.items()}
        return cls(**copies, episode=episode)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Tensor]:
        """Return an iterator over states, actions and next states."""
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
        return list(self.episode.unique_consecutive(return_counts=True)[1].tolist())

    @property
    def _columns(self) -> dict[str, Tensor]:
        return {name: value for name, value in vars(self).items() if value is not None}

    def append(self, other: Trajectories) -> Trajectories:
        """Return these trajectories, then the episodes of others."""
        last = self.episode.max() if len(self) else -1
        first = other.episode.min() if len(other) else 0
        ours, theirs = self._columns, other._columns
        # The numbers of the other episodes begin after the last one here.
        theirs["episode"] = other.episode - first + last + 1
        names = ours.keys() & theirs.keys()
        return Trajectories(**{name: torch.cat([ours[name], theirs[name]]) for name in names})

    def subset(self, rows: Tensor | slice) -> Trajectories:
        """Return the rows by their numbers, a slice, or a mask of ``N`` booleans.

        Episodes get new numbers: one ends wherever the next row is left out.
        """
        numbers = torch.arange(len(self))[rows]
        columns = {name: column[numbers] for name, column in self._columns.items()}
        # An episode begins after each gap of the row numbers, too.
        begins = (numbers.diff() != 1) | (columns["episode"].diff() != 0)
        columns["episode"][1:] = begins.cumsum(0)
        columns["episode"][:1] = 0
        return Trajectories(**columns)

    def episodes(self) -> list[Trajectories]:
        """Return a list of the episodes."""
        return [self.subset(rows) for rows in torch.arange(len(self)).split(self._lengths)]

    def spread(self, number: int, seed: int = 0) -> Trajectories:
        """Draw a row from each of ``number`` parts of the same length."""
        return self.subset(_spread_rows(len(self), number, seed))

    def windows(self, length: int, stride: int | None = None) -> Windows:
        """Cut windows within episodes, to compare with :meth:`Dynamics.free_run`.

        A window starts at a fully measured state; if a state is incomplete, at the next full one.

        Args:
            length: The number ``T`` of steps.
            stride: Steps between the starts of two windows. Default: ``length``.

        Raises:
            ValueError: If no episode is as long, or a number is not whole and positive.
        """
        checked_whole("length", length, 1)
        stride = checked_whole("stride", length if stride is None else stride, 1)
        is_complete = (~self.states.isnan().any(-1)).tolist()
        starts: list[int] = []
        end = 0
        for steps in self._lengths:
            row = end
            end += steps
            while row + length <= end:
                if is_complete[row]:
                    starts.append(row)
                    row += stride
                else:
                    row += 1
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


def _spread_rows(total: int, number: int, seed: int) -> Tensor:
    """Draw numbers below ``total``, one from each of ``number`` parts of the same length."""
    if checked_whole("number", number, 1) > total:
        raise ValueError(f"Expected number <= {total}, the number of all rows, got {number}.")
    # A random row within each of `number` equal parts.
    edges = torch.arange(number + 1) * total // number
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(number, generator=generator, dtype=torch.float64)
    return edges[:-1] + (share * edges.diff()).long()
