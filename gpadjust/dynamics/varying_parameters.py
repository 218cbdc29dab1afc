"""What a physics with other parameters changes in the next states."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.models import PhysicsParameters
from gpadjust.physics import Physics
from gpadjust.states import StateSpec

_BEYOND = 2.0  # times as much again, half a range of the actions beyond it
_MOST = 0.5  # standard deviations of a parameter's prior
_END = 8.0  # coordinate, beyond which there is nothing of a prior


class VaryingParameters(NamedTuple):
    """Parameters that differ from those that were learnt, in each draw by numbers of its own.

    Args:
        physics: Next values of the states that move; it has unknown parameters.
        spec: What the entries of states and actions are.
        centre: The coordinates of what was learnt, ``p``.
        sd: Standard deviations of the coordinates, ``p``.
        low: The least actions that were learnt from.
        high: The largest.
    """

    physics: Physics
    spec: StateSpec
    centre: Tensor
    sd: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(
        cls,
        physics: Physics,
        spec: StateSpec,
        learnt: PhysicsParameters,
        actions: Tensor,
        variation: Tensor | float,
    ) -> VaryingParameters:
        """From what was learnt of the parameters, and from the actions ``N x action_dim``.

        Raises:
            TypeError: If ``variation`` is no number or numbers.
            ValueError: If it is not one of 0 or more, or one for each parameter.
        """
        names = physics.unknowns.names
        try:
            sd = torch.as_tensor(variation, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(
                f"Expected variation as a number or a tensor of numbers, got {variation!r}."
            ) from error
        if sd.shape not in ((), (len(names),)) or not (sd.isfinite() & (sd >= 0)).all():
            raise ValueError(
                f"Expected variation as one number of 0 or more, or one for each of "
                f"{', '.join(names)}, got {sd.tolist()}."
            )
        coordinates = physics.unknowns.coordinates(learnt.draws).clamp(-_END, _END)
        ends = actions.amin(0), actions.amax(0)
        return cls(physics, spec, coordinates.mean(0), sd.expand(len(names)), *ends)

    def changes(self, number: int, seed: int | None) -> Callable[[Tensor, Tensor], Tensor]:
        """By how much next states ``number x N x state_dim`` are others than by what was learnt.

        NaN where the physics fails.
        """
        p, unknowns, moving = len(self.centre), self.physics.unknowns, self.spec.moving
        if seed is None:
            seed = int(torch.randint(2**31, ()))
        engine = torch.quasirandom.SobolEngine(p, scramble=True, seed=seed)
        shares = engine.draw(number, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
        drawn = torch.special.ndtri(shares).unsqueeze(1)  # number x 1 x p

        def change(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            X = torch.cat([states[..., moving], actions], dim=-1)
            sd = torch.minimum(self.sd * self._growth(actions), self.sd.clamp_min(_MOST))
            rows = X.flatten(0, -2).unsqueeze(1)  # each with parameters of its own
            ends = []
            for coordinates in (self.centre + sd * drawn, self.centre.expand(*sd.shape)):
                values = unknowns.at(coordinates.flatten(0, -2))
                end = states.clone()
                end[..., moving] = self.physics.or_nan(rows, values).view(*states.shape[:-1], -1)
                ends.append(end)
            return self.spec.change(ends[1], ends[0])

        return change

    def _growth(self, actions: Tensor) -> Tensor:
        """The factor of the standard deviations under actions, ``... x 1``."""
        half = (self.high - self.low) / 2
        # Of an action that never varied, its own size.
        size = self.high.abs().where(self.high != 0, torch.ones_like(self.high))
        half = half.where(half > 0, size)
        beyond = (self.low - actions).clamp_min(0) + (actions - self.high).clamp_min(0)
        return 1 + _BEYOND * (beyond / half).norm(dim=-1, keepdim=True)
