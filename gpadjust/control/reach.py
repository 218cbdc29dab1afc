"""How far the physics comes within an episode."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.checks import seeded
from gpadjust.control.rollouts import random_sequences
from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.particles import step_or_nan
from gpadjust.physics import PhysicsError

_EPISODES = 64


@torch.no_grad()
def reach(physics: Dynamics, starts: Tensor, action_bounds: Tensor, num_steps: int) -> Tensor:
    """Least and greatest states of episodes in a physics, ``2 x state_dim``.

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
