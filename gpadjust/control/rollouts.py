"""Episodes in functions drawn from a dynamics model, and what they are worth."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_kind, checked_number, checked_whole, seeded
from gpadjust.control.task import Moment, Steps, Task
from gpadjust.dynamics import Dynamics
from gpadjust.physics import PhysicsError

_MOST_MEDIANS = 30.0
_NEVER = 1e6  # largest rewards of a step: it never pays
_BACK = 10.0  # largest rewards of a step: few episodes of a policy must outweigh those that stay
_EPISODES = 64  # of random actions, by which is known what a physics reaches


class Rollouts:
    """Runs episodes of a task, each in every one of some functions of its dynamics.

    An episode ends where a state says so, or where it would leave the bounds or the finite numbers
    or meet a failure of the physics; that last step is not made. Gradients flow from the rewards to
    the actions; where an episode has none that is finite, as where it ran away, it counts as zero.

    Args:
        task: The task; its dynamics must be fitted.
        num_functions: Number ``k`` of functions, drawn from PyTorch's generator; None for the mean
            of the dynamics, as a single one.
        moment: The point of an episode at which all begin. Default: its start.
        deadline: The time of ``time.perf_counter`` by which all but a first step are to end.
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
        self.moment = Moment() if moment is None else moment
        self.deadline = deadline
        self._slowest = 0.0
        self.num_functions = 1 if num_functions is None else num_functions
        if num_functions is None:
            self.functions = task.dynamics.mean_function()
        else:
            self.functions = task.dynamics.sample_functions(num_functions)

    def follow(self, starts: Tensor, sequences: Tensor) -> Steps:
        """Take the actions ``n x T x action_dim``, from one start or ``n x state_dim``."""
        every = sequences.repeat(self.num_functions, 1, 1)
        starts = starts.expand(len(sequences), -1)
        return self._run(starts, every.shape[1], lambda t, states: every[:, t])

    def act(self, starts: Tensor, policy: Callable[[Tensor], Tensor], num_steps: int) -> Steps:
        """Let a policy act from starts ``n x state_dim``."""
        return self._run(starts, num_steps, lambda t, states: policy(states))

    def has_time(self, num_steps: int = 1) -> bool:
        """Return whether so many steps can be made before the deadline, by the slowest so far."""
        return time.perf_counter() + num_steps * self._slowest < self.deadline

    def _run(
        self, starts: Tensor, num_steps: int, choose: Callable[[int, Tensor], Tensor]
    ) -> Steps:
        """Run episodes of actions that are chosen by the number of the step and the states."""
        task, moment = self.task.widened(starts), self.moment
        shape = (self.num_functions, len(starts))  # of all episodes, which are rows below
        states = starts.expand(*shape, -1).flatten(0, 1)
        running = torch.ones(len(states), dtype=torch.bool)
        columns: list[tuple[Tensor, ...]] = []
        for t in range(num_steps):
            begun = time.perf_counter()
            if t and not self.has_time():
                break
            at, chosen = _tamed(states), _tamed(choose(t, states))
            # Later, all may have come to where the physics does not work.
            step = task.step(at, chosen, moment, move=self._move, some_must_succeed=t == 0)
            columns.append((running, states, *step[1:]))
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


def _tamed(rows: Tensor) -> Tensor:
    """Return the same rows; of those whose gradient is not finite, or far longer, less flows on.

    Rows are separate episodes; where one runs away, its gradient would outweigh all others.
    """
    if not rows.requires_grad:
        return rows

    def limited(gradient: Tensor) -> Tensor:
        gradient = torch.where(gradient.isfinite().all(-1, keepdim=True), gradient, 0.0)
        lengths = gradient.norm(dim=-1, keepdim=True)
        if not lengths.any():
            return gradient
        most = _MOST_MEDIANS * lengths[lengths > 0].median()
        return gradient * (most / lengths.clamp_min(most))

    rows = rows.view_as(rows)
    rows.register_hook(limited)
    return rows


class Objective(ABC):
    """The goal of a planner or a policy search."""

    @abstractmethod
    def of(self, task: Task) -> Callable[[Steps], Tensor]:
        """Return a function of the steps of a rollout: ``n`` numbers, higher is better."""


@dataclass(frozen=True)
class Return(Objective):
    """The sum of rewards of the steps ahead, averaged over the functions, or a quantile of these.

    Leaving the bounds never pays: each step that an episode does not make for that costs a million
    times the largest reward of the first rollouts, so that sequences that leave come after all
    others, and those that leave later first. Beside it such an episode has the gradient of how far
    it left, for a policy to come back. A unit of a constraint's violation costs as much as such a
    step. Where none can hold, the least violation is the best, and still better than to leave the
    bounds.

    Args:
        quantile: Of the returns in the functions the one that counts, such as 0.2 to be careful
            about what the model does not know. Default: their mean.

    Raises:
        TypeError: If it is no number.
        ValueError: If it is out of range.
    """

    _: KW_ONLY
    quantile: float | None = None

    def __post_init__(self) -> None:
        """Check the number."""
        if self.quantile is not None:
            checked_number("quantile", self.quantile, least=0, below=1)

    def of(self, task: Task) -> Callable[[Steps], Tensor]:
        """Return the function of a rollout's steps that returns their ``n`` returns."""
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
    """Raise an error unless an objective means something of so many functions, or of the mean."""
    check_kind("objective", objective, Objective, "an object of an Objective, such as Return()")
    if num_functions is not None:
        checked_whole("num_functions", num_functions, 1)
    if getattr(objective, "quantile", None) is not None and num_functions in (None, 1):
        found = "None, the mean alone" if num_functions is None else "1, one of them"
        raise ValueError(
            f"{objective} is one over functions, but num_functions is {found}; give num_functions "
            "of at least 2, such as 16."
        )


def random_sequences(n: int, num_steps: int, bounds: Tensor, max_hold: int) -> Tensor:
    """Draw piecewise constant sequences ``n x num_steps x action_dim``, from PyTorch's generator.

    Each holds its actions, uniform within the bounds ``2 x action_dim``, for a number of steps of
    its own, from 1 to ``max_hold``.
    """
    low, high = bounds
    actions = low + (high - low) * torch.rand(n, num_steps, len(low), dtype=torch.float64)
    hold = torch.randint(1, max_hold + 1, (n, 1))
    rows = torch.arange(num_steps) // hold
    return actions.gather(1, rows.unsqueeze(-1).expand_as(actions))


@torch.no_grad()
def reach(physics: Dynamics, starts: Tensor, action_bounds: Tensor, num_steps: int) -> Tensor:
    """Return least and greatest states of 64 episodes in a physics, ``2 x state_dim``.

    Each holds random actions, of which half are at the bounds, for a number of steps of its own, up
    to all ``num_steps``, from one of the starts ``n x state_dim``. It ends where the physics fails;
    if that does not say where, the starts alone count. PyTorch's generator is left as it is.
    """
    low, high = action_bounds
    with seeded(0):
        sequences = random_sequences(_EPISODES, num_steps, action_bounds, num_steps)
    extreme = torch.where(sequences > (low + high) / 2, high, low)
    sequences[::2] = extreme[::2]
    states = starts[torch.linspace(0, len(starts) - 1, _EPISODES).round().long()]
    task = Task(physics, lambda states, actions, next_states: 0 * states[:, 0])
    with suppress(PhysicsError):
        run = Rollouts(task, None).follow(states, sequences)
        states = torch.cat([states, run.next_states[run.made]])
    return torch.stack([states.amin(0), states.amax(0)])
