"""Steps of many states, at some of which the physics may fail."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gpadjust.physics import PhysicsError


def step_or_nan(
    move: Callable[[Tensor, Tensor], Tensor],
    states: Tensor,
    actions: Tensor,
    *,
    some_must_succeed: bool = False,
) -> Tensor:
    """The next states ``N x state_dim``; not finite where the physics fails.

    Args:
        move: A model, from states and actions to next states.
        states: ``N x state_dim``.
        actions: ``N x action_dim``.
        some_must_succeed: Whether it is an error that the physics fails for all of them.

    Raises:
        PhysicsError: If the physics does not say where it fails; or fails everywhere, though it
            must not.
    """
    states, actions = states.clone(), actions.clone()
    failed = torch.zeros(len(states), dtype=torch.bool)
    while True:
        try:
            following = move(states, actions)
        except PhysicsError as error:
            known = failed.clone()
            failed[list(error.rows)] = True
            if (failed == known).all() or (failed.all() and some_must_succeed):
                raise  # it does not say where, or blames what has another place now
            if failed.all():
                return torch.full_like(states, torch.nan)
            # They are evaluated with the others, at a place where the physics does not fail.
            working = int((~failed).nonzero()[0])
            place = states[working].clone(), actions[working].clone()  # not of what is written
            states[failed], actions[failed] = place
        else:
            return following.masked_fill(failed.unsqueeze(-1), torch.nan)
