"""Trials in functions drawn from a dynamics model."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.rl.model_vec_env import Termination, per_particle
from gpadjust.rl.sound_steps import sound_steps

Policy = Callable[[Tensor], Tensor]
"""Actions ``N x action_dim`` at states ``N x state_dim``."""


class Rollout(NamedTuple):
    """``n`` trials of ``T`` steps in each of ``k`` functions.

    Args:
        states: The states at which actions were taken, ``k x n x T x state_dim``.
        actions: ``k x n x T x action_dim``.
        made: The steps before the end of a trial, ``k x n x T`` booleans. At others state and
            action are those of some step that was made, if there is any.
    """

    states: Tensor
    actions: Tensor
    made: Tensor


class SampledRollouts:
    """Runs trials from one state, each in every one of some sampled transition functions.

    A trial ends where a state says so, or where it would leave the bounds or the finite numbers or
    meet a failure of the physics; that last step is not made.

    Args:
        dynamics: The model; it must be fitted.
        num_functions: Number ``k`` of functions, drawn from PyTorch's generator.
        state_bounds: Bounds of the states, ``2 x state_dim``. Default: none.
        terminated: Which states ``N x state_dim`` end a trial. Default: none.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        num_functions: int,
        state_bounds: Tensor | None = None,
        terminated: Termination | None = None,
    ) -> None:
        self.functions = dynamics.sample_functions(num_functions)
        self.num_functions = num_functions
        self.state_bounds = state_bounds
        self.terminated = terminated

    def follow(self, state: Tensor, sequences: Tensor) -> Rollout:
        """Take given actions, whatever happens.

        Args:
            state: Where the trials start, ``state_dim``.
            sequences: ``n x T x action_dim``.
        """
        n, num_steps = sequences.shape[:2]
        every = sequences.expand(self.num_functions, *sequences.shape)
        return self._run(state, n, num_steps, lambda t, states: every[:, :, t])

    def propose(self, state: Tensor, num_steps: int, policy: Policy, n: int) -> Tensor:
        """The actions that a policy takes in ``n`` trials, ``n x num_steps x action_dim``."""
        each = -(-n // self.num_functions)

        def act(t: int, states: Tensor) -> Tensor:
            return policy(states.flatten(0, 1)).reshape(*states.shape[:2], -1)

        taken: list[Tensor] = []
        self._run(state, each, num_steps, act, taken)
        return torch.stack(taken, dim=-2).flatten(0, 1)[:n]

    def _run(
        self,
        state: Tensor,
        n: int,
        num_steps: int,
        choose: Callable[[int, Tensor], Tensor],
        taken: list[Tensor] | None = None,
    ) -> Rollout:
        """Run trials; the actions that were chosen are appended to ``taken``, if given."""
        taken = [] if taken is None else taken
        states = state.expand(self.num_functions, n, -1).clone()
        running = torch.ones(states.shape[:2], dtype=torch.bool)
        visited, made = [], []
        for t in range(num_steps):
            actions = choose(t, states)
            # Where the trials start the physics has to work; later, all may have come to where it
            # does not.
            following, ended, left = self._step(states, actions, some_must_succeed=t == 0)
            visited.append(states)
            taken.append(actions)
            made.append(running & ~left)
            running = made[-1] & ~ended
            states = torch.where(running.unsqueeze(-1), following, states)
        steps = Rollout(
            torch.stack(visited, dim=-2), torch.stack(taken, dim=-2), torch.stack(made, dim=-1)
        )
        return _without_failures(steps)

    def _step(
        self, states: Tensor, actions: Tensor, *, some_must_succeed: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Next states, which of them end a trial, and who would have left the bounds."""
        blocks = states.shape[:2]

        def move(rows: Tensor, actions: Tensor) -> Tensor:
            return self.functions(rows.reshape(*blocks, -1), actions.reshape(*blocks, -1)).flatten(
                0, 1
            )

        rows = states.flatten(0, 1)
        following = sound_steps(
            move, rows, actions.flatten(0, 1), some_must_succeed=some_must_succeed
        )
        left = ~following.isfinite().all(-1)
        if self.state_bounds is not None:
            low, high = self.state_bounds
            left |= ((following < low) | (following > high)).any(-1)
        following = torch.where(left.unsqueeze(-1), rows, following)
        ended = torch.zeros_like(left)
        if self.terminated is not None:
            ended = per_particle(self.terminated(following), len(rows), "terminated").bool()
        return following.reshape(states.shape), ended.reshape(blocks), left.reshape(blocks)


def _without_failures(rollout: Rollout) -> Rollout:
    """Let steps that were not made be at a place where the physics does not fail."""
    states, actions, made = rollout
    if made.all() or not made.any():
        return rollout
    sound = tuple(made.nonzero()[0])
    lost = ~made.unsqueeze(-1)
    return Rollout(
        torch.where(lost, states[sound], states), torch.where(lost, actions[sound], actions), made
    )
