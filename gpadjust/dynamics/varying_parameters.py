"""Changes of the next states by other parameters of a physics."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gpadjust.checks import checked_tensor
from gpadjust.dynamics.particles import even_normal
from gpadjust.models import PhysicsParameters
from gpadjust.physics import Physics
from gpadjust.states import StateSpec

_BEYOND = 2.0  # times as much again, half a range of the actions beyond it
_MOST = 0.5  # standard deviations of a parameter's prior
_END = 8.0  # coordinate, beyond which there is nothing of a prior


def varying_parameters(
    physics: Physics,
    spec: StateSpec,
    learnt: PhysicsParameters,
    actions: Tensor,
    variation: Tensor | float,
) -> Callable[[int, int | None], Callable[[Tensor, Tensor], Tensor]]:
    """Changes of next states by parameters that differ, in each draw by numbers of its own.

    They vary by standard deviations of their coordinates about those that were learnt, by more
    beyond the actions that were learnt from, ``N x action_dim``.

    Returns:
        A function of a number ``k`` of draws and a seed to a function of states and actions, which
        returns by how much next states ``k x N x state_dim`` are others than by what was learnt,
        NaN where the physics fails.

    Raises:
        TypeError: If ``variation`` is no number or numbers.
        ValueError: If it is not one of 0 or more, or one for each parameter.
    """
    unknowns, moving, p = physics.unknowns, spec.moving, len(physics.unknowns.names)
    sd = checked_tensor("variation", variation)
    if sd.shape not in ((), (p,)) or not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected variation as one number of 0 or more, or one for each of "
            f"{', '.join(unknowns.names)}, got {sd.tolist()}."
        )
    sd = sd.expand(p)
    center = unknowns.coordinates(learnt.draws).clamp(-_END, _END).mean(0)
    low, high = actions.amin(0), actions.amax(0)
    # Of an action that never varied, its own size.
    half = ((high - low) / 2).where(high > low, high.abs().where(high != 0, torch.ones_like(high)))

    def growth(actions: Tensor) -> Tensor:
        """The factor of the standard deviations under actions, ``... x 1``."""
        beyond = (low - actions).clamp_min(0) + (actions - high).clamp_min(0)
        return 1 + _BEYOND * (beyond / half).norm(dim=-1, keepdim=True)

    def changes(number: int, seed: int | None) -> Callable[[Tensor, Tensor], Tensor]:
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        drawn = even_normal(number, p, seed).unsqueeze(1)  # number x 1 x p

        def change(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            X = torch.cat([states[..., moving], actions], dim=-1)
            own = torch.minimum(sd * growth(actions), sd.clamp_min(_MOST))
            rows = X.flatten(0, -2).unsqueeze(1)  # each with parameters of its own
            ends = []
            for coordinates in (center + own * drawn, center.expand(*own.shape)):
                values = unknowns.at(coordinates.flatten(0, -2))
                end = states.clone()
                end[..., moving] = physics.or_nan(rows, values).view(*states.shape[:-1], -1)
                ends.append(end)
            return spec.change(ends[1], ends[0])

        return change

    return changes
