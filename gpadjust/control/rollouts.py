"""Episodes in functions drawn from a dynamics model, and their value."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_kind, checked_number, checked_whole
from gpadjust.control.task import Moment, Steps, Task

_MOST_MEDIANS = 30.0  # longest gradient of an episode, in medians of all
_NEVER = 1e6  # price of a lost step, in largest rewards: leaving the bounds never improves a return
_BACK = 10.0  # price of the overshoot, in largest rewards: its gradient outweighs other episodes


class Rollouts:
    """Runs episodes of a task, each in ``k`` functions drawn from its dynamics, or in their mean.

    An episode ends in a terminal state, or before a step that would leave the bounds or the finite
    numbers or meet a failure of the physics; all end at the deadline, by ``time.perf_counter``.
    Gradients flow from the rewards to the actions; one that is not finite counts as zero.
    """

    def __init__(
        self,
        task: Task,
        num_functions: int | None,
        moment: Moment | None = None,
        *,
        deadline: float = math.inf,
    ) -> None:
        self.task = task
        self.moment = moment or Moment()
        self.deadline = deadline
        self._slowest = 0.0
        self.num_functions = num_functions or 1
        if num_functions is None:
            self.functions = task.dynamics.mean_function()
        else:
            self.functions = task.dynamics.sample_functions(num_functions)

    def follow(self, starts: Tensor, sequences: Tensor) -> Steps:
        """Take the actions ``n x T x action_dim``, from one start or ``n x state_dim``."""
        repeated = sequences.repeat(self.num_functions, 1, 1)
        starts = starts.expand(len(sequences), -1)
        return self._run(starts, repeated.shape[1], lambda t, states: repeated[:, t])

    def act(self, starts: Tensor, policy: Callable[[Tensor], Tensor], num_steps: int) -> Steps:
        """Let a policy act from starts ``n x state_dim``."""
        return self._run(starts, num_steps, lambda t, states: policy(states))

    def has_time(self, num_steps: int = 1) -> bool:
        """Return whether so many steps, each as the slowest so far, end before the deadline."""
        return time.perf_counter() + num_steps * self._slowest < self.deadline

    def _run(
        self, starts: Tensor, num_steps: int, choose: Callable[[int, Tensor], Tensor]
    ) -> Steps:
        """Run episodes whose actions depend on the number of the step and the states."""
        task = self.task.widened(starts)
        moment = self.moment
        shape = (self.num_functions, len(starts))  # of all episodes, which are rows below
        states = starts.expand(*shape, -1).flatten(0, 1)
        running = torch.ones(len(states), dtype=torch.bool)
        columns: list[tuple[Tensor, ...]] = []
        for t in range(num_steps):
            begun = time.perf_counter()
            if t and not self.has_time():
                break
            # Later, the physics may fail at the states of all episodes.
            step = task.step(
                _limit_gradient(states),
                _limit_gradient(choose(t, states)),
                moment,
                move=self._move,
                some_must_succeed=t == 0,
            )
            columns.append((running, states, *step[1:]))
            # An episode that has ended stays at its last state.
            running = running & step.made & ~step.terminated
            states = torch.where(running.unsqueeze(-1), step.next_states, states)
            moment = moment.after(step.actions)
            self._slowest = max(self._slowest, time.perf_counter() - begun)
        stacked = (torch.stack(parts, dim=1) for parts in zip(*columns, strict=True))
        running, *parts = (part.unflatten(0, shape) for part in stacked)
        steps = Steps(*parts)
        made = running & steps.made
        return steps._replace(
            made=made,
            left_bounds=running & steps.left_bounds,
            overshoot=steps.overshoot.masked_fill(~running, 0.0),
            violation=steps.violation.masked_fill(~made, 0.0),
        )

    def _move(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the next states of rows, of which each function has as many."""
        blocks = (rows.unflatten(0, (self.num_functions, -1)) for rows in (states, actions))
        return self.functions(*blocks).flatten(0, 1)


def _limit_gradient(rows: Tensor) -> Tensor:
    """Return the same rows, with a limit on the gradients of episodes that run away."""
    if not rows.requires_grad:
        return rows

    def limit(gradient: Tensor) -> Tensor:
        # No longer than 30 medians of the lengths
        gradient = torch.where(gradient.isfinite().all(-1, keepdim=True), gradient, 0.0)
        lengths = gradient.norm(dim=-1, keepdim=True)
        if not lengths.any():
            return gradient
        most = _MOST_MEDIANS * lengths[lengths > 0].median()
        return gradient * (most / lengths.clamp_min(most))

    rows = rows.view_as(rows)
    rows.register_hook(limit)
    return rows


class Objective(ABC):
    """The goal of a planner or a policy search."""

    @abstractmethod
    def make_score(self, task: Task) -> Callable[[Steps], Tensor]:
        """Return a function of the steps of a rollout: ``n`` numbers, higher is better."""


@dataclass(frozen=True)
class Return(Objective):
    """The sum of rewards of the steps ahead, averaged over the functions, or a quantile of these.

    Leaving the bounds never improves it: each step that an episode lacks costs a million times the
    largest reward of the first rollouts. Its overshoot has a price, too, whose gradient leads a
    policy back. A unit of a constraint's violation costs as much as a lost step; leaving the bounds
    is still worse than any violation.

    Args:
        quantile: The quantile of the returns over the functions, such as 0.2 to be careful about
            the uncertainty of the model. Default: their mean.

    Raises:
        TypeError: If it is not a number.
        ValueError: If it is out of range.
    """

    _: KW_ONLY
    quantile: float | None = None

    def __post_init__(self) -> None:
        """Check the number."""
        if self.quantile is not None:
            checked_number("quantile", self.quantile, least=0, below=1)

    def make_score(self, task: Task) -> Callable[[Steps], Tensor]:
        """Return a function from the steps of a rollout to ``n`` returns."""
        largest = 0.0

        def score(rollout: Steps) -> Tensor:
            nonlocal largest
            rewards = rollout.rewards.double() - rollout.price
            if not largest:  # of the first rollouts, so that later ones compare
                largest = float(rewards.detach().abs().max())
            price = largest or 1.0
            returns = rewards.masked_fill(~rollout.made, 0.0).sum(-1)
            violation = rollout.violation.sum(-1)
            left = rollout.left_bounds.any(-1)
            # R = sum r - price (1e6 missed + 10 (T + 1) overshoot + 1e6 violation)
            if left.any():
                missed = (left.unsqueeze(-1) & ~rollout.made).sum(-1) + violation.max() * left
                back = _BACK * (rewards.shape[-1] + 1) * rollout.overshoot.sum(-1)
                returns = returns - price * (_NEVER * missed + back)
            if rollout.violation.any():
                returns = returns - price * _NEVER * violation
            if self.quantile is None:
                return returns.mean(0)
            return returns.quantile(self.quantile, dim=0)

        return score


def check_objective(objective: Any, num_functions: Any) -> None:
    """Raise an error unless an objective is defined for so many functions, or for the mean."""
    check_kind("objective", objective, Objective, "an object of an Objective, such as Return()")
    if num_functions is not None:
        checked_whole("num_functions", num_functions, 1)
    if getattr(objective, "quantile", None) is not None and num_functions in (None, 1):
        raise ValueError(
            f"{objective} is a quantile over functions, but num_functions is {num_functions}; give "
            "num_functions of at least 2, such as 16."
        )


def random_sequences(n: int, num_steps: int, bounds: Tensor, max_hold: int) -> Tensor:
    """Draw piecewise constant sequences ``n x num_steps x action_dim``, from PyTorch's generator.

    A sequence holds actions, uniform within the bounds ``2 x action_dim``, for 1 to ``max_hold``
    steps.
    """
    low, high = bounds
    actions = low + (high - low) * torch.rand(n, num_steps, len(low), dtype=torch.float64)
    hold = torch.randint(1, max_hold + 1, (n, 1))
    rows = torch.arange(num_steps) // hold
    return actions.gather(1, rows.unsqueeze(-1).expand_as(actions))
