"""Episodes in functions drawn from a dynamics model, and what they are worth."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import checked_number
from gpadjust.control.task import Task, per_row

Policy = Callable[[Tensor], Tensor]
"""Actions ``N x action_dim`` at states ``N x state_dim``."""

_MOST_MEDIANS = 30.0
_NEVER = 1e6  # largest rewards of a step: it never pays
_BACK = 10.0  # largest rewards of a step: few episodes of a policy must outweigh those that stay


class Rollout(NamedTuple):
    """``n`` episodes of ``T`` steps in each of ``k`` functions.

    Args:
        states: The states at which actions were taken, ``k x n x T x state_dim``.
        actions: ``k x n x T x action_dim``.
        next_states: ``k x n x T x state_dim``.
        rewards: ``k x n x T``.
        made: The steps before the end of an episode, ``k x n x T`` booleans. What the others hold
            means nothing.
        left_bounds: Whether the step after the last one that was made would have left the bounds,
            or the physics failed there, ``k x n`` booleans.
        overshoot: How far that step would have left them, ``k x n``; 0 where none would have. See
            :class:`~gpadjust.control.task.Step`.
        violation: How far the constraints with their margins are violated, summed over these,
            ``k x n x T``; 0 where they hold.
        before: The action before the first step, ``action_dim``; None where an episode begins.
    """

    states: Tensor
    actions: Tensor
    next_states: Tensor
    rewards: Tensor
    made: Tensor
    left_bounds: Tensor
    overshoot: Tensor
    violation: Tensor
    before: Tensor | None = None


class Rollouts:
    """Runs episodes of a task, each in every one of some functions of its dynamics.

    An episode ends where a state says so, or where it would leave the bounds or the finite numbers
    or meet a failure of the physics; that last step is not made. Gradients flow from the rewards to
    the actions, as far as dynamics and reward have them; where an episode has none that is finite
    (as where it ran away), it counts as zero.

    Args:
        task: The task; its dynamics must be fitted.
        num_functions: Number ``k`` of functions, drawn from PyTorch's generator; None for the mean
            of the dynamics, as a single one.
        margins: By how much constraints must hold in each step, ``T x c``; the last ones beyond.
            Default: not at all.
        before: The action before the first step, ``action_dim``; None where an episode begins.
        deadline: The time of ``time.perf_counter`` by which episodes are over: there are no steps
            beyond the first that would take longer, by the slowest so far. Default: none.
    """

    def __init__(
        self,
        task: Task,
        num_functions: int | None,
        *,
        margins: Tensor | None = None,
        before: Tensor | None = None,
        deadline: float = math.inf,
    ) -> None:
        self.task, self.margins, self.before = task, margins, before
        self.deadline, self._slowest = deadline, 0.0
        self.num_functions = 1 if num_functions is None else num_functions
        if num_functions is None:
            self.functions = task.dynamics.mean_function()
        else:
            self.functions = task.dynamics.sample_functions(num_functions)

    def follow(self, state: Tensor, sequences: Tensor, steps_done: int = 0) -> Rollout:
        """Take given actions, whatever happens, as fast as they may change.

        Args:
            state: Where the episodes start, ``state_dim``.
            sequences: ``n x T x action_dim``.
            steps_done: How many steps the episode has made by then.
        """
        if self.task.rate is not None:
            sequences = self.task.rate.limited(sequences, self.before)
        every = sequences.repeat(self.num_functions, 1, 1)
        starts = state.expand(len(sequences), -1)
        return self._run(starts, every.shape[1], lambda t, states: every[:, t], steps_done)

    def act(self, states: Tensor, policy: Policy, num_steps: int) -> Rollout:
        """Let a policy act.

        Args:
            states: Where the episodes start, ``n x state_dim``, or ``k x n x state_dim`` for starts
                of its own in each function.
            policy: Who acts.
            num_steps: How long, ``T``.
        """
        return self._run(states, num_steps, lambda t, states: policy(states), 0)

    def has_time(self, num_steps: int = 1) -> bool:
        """Return whether so many steps can be made before the deadline, by the slowest so far."""
        return time.perf_counter() + num_steps * self._slowest < self.deadline

    def _run(
        self,
        starts: Tensor,
        num_steps: int,
        choose: Callable[[int, Tensor], Tensor],
        steps_done: int,
    ) -> Rollout:
        """Run episodes of actions that are chosen by the number of the step and the states."""
        task = self.task.widened(starts.flatten(0, -2))
        shape = (self.num_functions, starts.shape[-2])  # of all episodes, which are rows below
        states = starts.expand(*shape, -1).flatten(0, 1)
        running = torch.ones(len(states), dtype=torch.bool)
        left, overshoot = ~running, torch.zeros(len(states), dtype=torch.float64)
        steps: list[tuple[Tensor, ...]] = []
        for t in range(num_steps):
            begun = time.perf_counter()
            if t and not self.has_time():
                break
            actions = choose(t, states)
            at, taken = (_tamed_gradient(part) for part in (states, actions))
            following, rewards, ended, lost, beyond, violation = task.step(
                at,
                taken,
                self._move,
                set_points=task.set_points(at, steps_done + t + 1),
                margins=None if self.margins is None else self.margins[: t + 1][-1],
                # Later, all may have come to where the physics does not work.
                some_must_succeed=t == 0,
            )
            made = running & ~lost
            left = left | (running & lost)
            overshoot = torch.where(running, beyond, overshoot)
            steps.append((states, actions, following, rewards, made, violation))
            running = made & ~ended
            states = torch.where(running.unsqueeze(-1), following, states)
            self._slowest = max(self._slowest, time.perf_counter() - begun)
        columns = [torch.stack(parts, dim=1) for parts in zip(*steps, strict=True)]
        columns += [left, overshoot, columns.pop().masked_fill(~columns[4], 0.0)]
        parts = [column.unflatten(0, shape) for column in columns]
        return Rollout._make([*parts, self.before])

    def _move(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the next states of rows, of which each function has as many."""
        blocks = (rows.unflatten(0, (self.num_functions, -1)) for rows in (states, actions))
        return self.functions(*blocks).flatten(0, 1)


def _tamed_gradient(rows: Tensor) -> Tensor:
    """Return the same rows; of those whose gradient is not finite, or far longer, less flows on.

    Rows are separate episodes; where one runs away, its gradient would outweigh all others.
    """
    if rows.requires_grad:
        rows = rows.view_as(rows)
        rows.register_hook(_tamed)
    return rows


def _tamed(gradient: Tensor) -> Tensor:
    """Return gradients of rows, none longer than so many times their median."""
    gradient = torch.where(gradient.isfinite().all(-1, keepdim=True), gradient, 0.0)
    lengths = gradient.norm(dim=-1, keepdim=True)
    flowing = lengths > 0
    if not flowing.any():
        return gradient
    most = _MOST_MEDIANS * lengths[flowing].median()
    return gradient * (most / lengths.clamp_min(most))


Score = Callable[[Rollout], Tensor]
"""The worth ``n`` of the ``n`` sequences of a rollout, higher is better."""


class Objective(ABC):
    """The goal of a planner."""

    @property
    def compares_functions(self) -> bool:
        """True if the functions have to be followed from the same starts."""
        return True

    def check_functions(self, num_functions: int | None) -> None:  # noqa: B027 - most need nothing
        """Raise a ValueError if it means nothing of so many functions; None for the mean."""

    @abstractmethod
    def of(self, task: Task) -> Score:
        """Return the worth of rollouts in a task, as its dynamics stand."""


@dataclass(frozen=True)
class Return(Objective):
    """The sum of rewards of the steps ahead, averaged over the functions, or a quantile of these.

    Leaving the bounds never pays: each step that an episode does not make for that costs a million
    times the largest that was at stake in the first rollouts (reward, effort or terminal value of
    an episode), so that sequences that leave come after all others, and those that leave later
    first. Beside it such an episode has the gradient of how far it left, for a policy to come back.
    A unit of a constraint's violation costs as much as such a step. Where none can hold, the least
    violation is the best, and still better than to leave the bounds.

    Args:
        discount: Factor of the rewards from a step to the next one.
        quantile: Of the returns in the functions the one that counts, such as 0.2 to be careful
            about what the model does not know. Default: their mean.
        effort: What a step costs for each unit of its sum of squared actions, beside the rewards.
        terminal_value: What a state at the end of the steps ahead is worth, ``N`` of states
            ``N x state_dim``, such as the return from there on. Default: nothing.

    Raises:
        TypeError: If a number is of another kind, or ``terminal_value`` is no function.
        ValueError: If a number is out of range.
    """

    discount: float = 1.0
    _: KW_ONLY
    quantile: float | None = None
    effort: float = 0.0
    terminal_value: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        """Check numbers and function."""
        checked_number("discount", self.discount, above=0, most=1)
        if self.quantile is not None:
            checked_number("quantile", self.quantile, least=0, below=1)
        checked_number("effort", self.effort, least=0)
        if self.terminal_value is not None and not callable(self.terminal_value):
            raise TypeError(
                "terminal_value must be a function of states, or None; found "
                f"{self.terminal_value!r}."
            )

    @property
    def compares_functions(self) -> bool:
        """True if the functions have to be followed from the same starts."""
        return self.quantile is not None

    def check_functions(self, num_functions: int | None) -> None:
        """Raise a ValueError for a quantile over a single function."""
        if self.quantile is not None and (num_functions or 1) < 2:
            raise ValueError(
                f"Return(quantile={self.quantile}) is one over functions, but num_functions is "
                f"{num_functions}, {'the mean alone' if num_functions is None else 'one of them'}; "
                "give num_functions of at least 2, such as 16."
            )

    def of(self, task: Task) -> Score:
        """Return the return of rollouts."""
        largest = torch.zeros((), dtype=torch.float64)
        rate = task.rate

        def score(rollout: Rollout) -> Tensor:
            nonlocal largest
            rewards = rollout.rewards.double()
            if self.effort:
                rewards = rewards - self.effort * rollout.actions.square().sum(-1)
            if rate is not None:
                rewards = rewards - rate.cost(rollout.actions, rollout.before)
            weights = self.discount ** torch.arange(rewards.shape[-1] + 1, dtype=torch.float64)
            ends = weights[-1] * self._at_the_end(rollout)
            if not largest:  # of the first rollouts, so that later ones compare
                largest = torch.maximum(*(part.detach().abs().max() for part in (rewards, ends)))
            returns = (weights[:-1] * rewards.masked_fill(~rollout.made, 0.0)).sum(-1) + ends
            price = torch.where(largest > 0, largest, 1.0)
            violation = (weights[:-1] * rollout.violation).sum(-1)
            if rollout.left_bounds.any():
                lost = rollout.left_bounds.unsqueeze(-1) & ~rollout.made
                missed = (weights[:-1] * lost).sum(-1) + violation.max() * rollout.left_bounds
                back = _BACK * len(weights) * rollout.overshoot
                returns = returns - price * (_NEVER * missed + back)
            if rollout.violation.any():
                returns = returns - price * _NEVER * violation
            if self.quantile is None:
                return returns.mean(0)
            return returns.quantile(self.quantile, dim=0)

        return score

    def _at_the_end(self, rollout: Rollout) -> Tensor:
        """Return the worth of the last states, ``k x n``; 0 where an episode has ended."""
        last, made = rollout.next_states[:, :, -1], rollout.made[:, :, -1]
        if self.terminal_value is None:
            return torch.zeros(made.shape, dtype=torch.float64)
        values = per_row(self.terminal_value(last.flatten(0, 1)), made.numel(), "terminal_value")
        return values.double().unflatten(0, made.shape).masked_fill(~made, 0.0)
