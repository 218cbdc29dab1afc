"""Sequences of random actions, and how far the physics comes by them."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.checks import seeded
from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.base import step_or_nan
from gpadjust.physics import PhysicsError

_EPISODES = 64


def random_sequences(n: int, num_steps: int, bounds: Tensor, max_hold: int) -> Tensor:
    """Draw piecewise constant sequences, from PyTorch's generator.

    Each holds its actions, uniform within the bounds, for a number of steps of its own, from 1 to
    ``max_hold``.

    Args:
        n: Number of sequences.
        num_steps: Their length ``T``.
        bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        max_hold: The most steps that an action is held.

    Returns:
        ``n x T x action_dim``.
    """
    low, high = bounds
    actions = low + (high - low) * torch.rand(n, num_steps, len(low), dtype=torch.float64)
    hold = torch.randint(1, max_hold + 1, (n, 1))
    rows = torch.arange(num_steps) // hold
    return actions.gather(1, rows.unsqueeze(-1).expand_as(actions))


@torch.no_grad()
def reach(physics: Dynamics, starts: Tensor, action_bounds: Tensor, num_steps: int) -> Tensor:
    """Return least and greatest states of episodes in a physics, ``2 x state_dim``.

    Each of 64 episodes holds random actions, of which half are at the bounds, for a number of steps
    of its own, up to all of them; it stays where the physics fails. PyTorch's generator is left as
    it is.

    Args:
        physics: The physics alone.
        starts: Where real episodes started, ``n x state_dim``.
        action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        num_steps: How long an episode is.
    """
    low, high = action_bounds
    with seeded(0):
        sequences = random_sequences(_EPISODES, num_steps, action_bounds, num_steps)
    extreme = torch.where(sequences > (low + high) / 2, high, low)
    sequences[::2] = extreme[::2]
    states = starts[torch.linspace(0, len(starts) - 1, _EPISODES).round().long()]
    path, step = [states], physics.mean_function()
    for actions in sequences.unbind(1):
        try:
            following = step_or_nan(lambda *at: step(*(x[None] for x in at))[0], states, actions)
        except PhysicsError:  # it does not say where it fails
            break
        states = torch.where(following.isfinite().all(-1, keepdim=True), following, states)
        path.append(states)
    everywhere = torch.cat(path)
    return torch.stack([everywhere.amin(0), everywhere.amax(0)])
