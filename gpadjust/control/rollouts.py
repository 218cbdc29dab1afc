"""Episodes in functions drawn from a dynamics model."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.control.task import Task

Policy = Callable[[Tensor], Tensor]
"""Actions ``N x action_dim`` at states ``N x state_dim``."""


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
    """

    states: Tensor
    actions: Tensor
    next_states: Tensor
    rewards: Tensor
    made: Tensor
    left_bounds: Tensor


class Rollouts:
    """Runs episodes of a task from one state, each in every one of some sampled functions.

    An episode ends where a state says so, or where it would leave the bounds or the finite numbers
    or meet a failure of the physics; that last step is not made.

    Args:
        task: The task; its dynamics must be fitted.
        num_functions: Number ``k`` of functions, drawn from PyTorch's generator.
    """

    def __init__(self, task: Task, num_functions: int) -> None:
        self.task = task
        self.num_functions = num_functions
        self.functions = task.dynamics.sample_functions(num_functions)

    def follow(self, state: Tensor, sequences: Tensor) -> Rollout:
        """Take given actions, whatever happens.

        Args:
            state: Where the episodes start, ``state_dim``.
            sequences: ``n x T x action_dim``.
        """
        n, num_steps = sequences.shape[:2]
        every = sequences.expand(self.num_functions, *sequences.shape)
        return self._run(state, n, num_steps, lambda t, states: every[:, :, t])

    def propose(self, state: Tensor, num_steps: int, policy: Policy, n: int) -> Tensor:
        """The actions that a policy takes in ``n`` episodes, ``n x num_steps x action_dim``."""
        each = -(-n // self.num_functions)

        def act(t: int, states: Tensor) -> Tensor:
            return policy(states.flatten(0, 1)).reshape(*states.shape[:2], -1)

        return self._run(state, each, num_steps, act).actions.flatten(0, 1)[:n]

    def _run(
        self, state: Tensor, n: int, num_steps: int, choose: Callable[[int, Tensor], Tensor]
    ) -> Rollout:
        """Run episodes of actions that are chosen by the number of the step and the states."""
        task = self.task.widened(state.unsqueeze(0))
        states = state.expand(self.num_functions, n, -1).clone()
        running = torch.ones(states.shape[:2], dtype=torch.bool)
        left = torch.zeros_like(running)
        steps: list[tuple[Tensor, ...]] = []
        for t in range(num_steps):
            actions = choose(t, states)
            # Where the episodes start the physics has to work; later, all may have come to where
            # it does not.
            rows = states.flatten(0, 1), actions.flatten(0, 1)
            step = task.step(*rows, self._move, some_must_succeed=t == 0)
            following, rewards, ended, lost = (part.unflatten(0, running.shape) for part in step)
            made = running & ~lost
            left |= running & lost
            steps.append((states, actions, following, rewards, made))
            running = made & ~ended
            states = torch.where(running.unsqueeze(-1), following, states)
        columns = [torch.stack(parts, dim=2) for parts in zip(*steps, strict=True)]
        return Rollout._make([*columns, left])

    def _move(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states of rows, of which each function has as many."""
        blocks = (rows.unflatten(0, (self.num_functions, -1)) for rows in (states, actions))
        return self.functions(*blocks).flatten(0, 1)
