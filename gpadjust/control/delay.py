"""Whether a system follows its actions a step later than its spec says."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.dynamics.particles import step_or_nan
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec

_LEAST = 12  # transitions
_CLEAR = 3.0  # standard errors, by which a longer delay explains more
_SHARE = 0.8  # of the squared errors, at most, that are left by then


class Delay(NamedTuple):
    """A delay that the data show.

    Args:
        action: The name of the action.
        steps: The delay, in steps, one more than was told.
        share: The mean square of the physics' errors by it, as a share of that without it.
    """

    action: str
    steps: int
    share: float

    def __str__(self) -> str:
        """Say it, with the way out."""
        chain = [self.action, *(f"{self.action}_{i + 1}" for i in range(self.steps))]
        previous = dict(zip(chain[1:], chain, strict=False))
        return (
            f"The data follow {self.action!r} {self.steps} step(s) late: with the action of then "
            f"the squared errors of the physics are {self.share:.0%} of what they are. Let the "
            f"environment show it, by gpadjust.systems.RememberAction(env, steps={self.steps}), "
            f"and say it in the StateSpec: previous={previous}, and {chain[-1]!r} in the place of "
            f"{self.action!r} in physics_reads."
        )


@torch.no_grad()
def find_delay(physics: Dynamics, data: Trajectories) -> Delay | None:
    """Find an action that the system follows one step later than the spec says.

    The errors of the physics in one step are compared with those by the action of one step more
    before than is told, and by those between. The longer delay is found if it explains the data
    better than any shorter one: the mean difference of the squares is above three of its standard
    errors, and a fifth of them.

    Args:
        physics: The physics alone.
        data: All transitions so far.
    """
    spec = physics.spec
    for action in spec.actions:
        told, read = _depths(spec, action)
        most = told - read + 1
        rows = torch.arange(most, len(data.states))
        rows = rows[data.episode[rows] == data.episode[rows - most]]
        if len(rows) < _LEAST:
            continue
        try:
            errors = torch.stack(
                [_squared_errors(physics, data, rows, action, lag) for lag in range(most + 1)]
            )
        except PhysicsError:  # it does not say where it fails
            continue
        errors = errors[:, errors.isfinite().all(-1).all(0)]  # lags x N x m
        scale = errors.mean((0, 1))
        sums = (errors[..., scale > 0] / scale[scale > 0]).sum(-1)
        *before, found = sums
        shorter = before[int(sums[:-1].mean(1).argmin())]
        gain = shorter - found
        clear = gain.mean() > _CLEAR * gain.std() / len(gain) ** 0.5
        share = float(found.mean() / shorter.mean())
        if len(gain) >= _LEAST and clear and share < _SHARE:
            return Delay(action, told + 1, share)
    return None


def _depths(spec: StateSpec, action: str) -> tuple[int, int]:
    """How many steps back the state holds an action, and how many the physics reads it at."""
    depths = {action: 0}
    for _ in spec.previous:
        depths |= {name: depths[held] + 1 for name, held in spec.previous.items() if held in depths}
    reads = [depths[name] for name in spec.physics_reads if name in depths]
    return max(depths.values()), min(reads, default=0)


def _squared_errors(
    physics: Dynamics, data: Trajectories, rows: Tensor, action: str, lag: int
) -> Tensor:
    """Squares ``N x m`` of errors of predicted states, by an action of some steps before."""
    spec = physics.spec
    states, actions = data.states[rows].clone(), data.actions[rows].clone()
    column = spec.actions.index(action)
    actions[:, column] = data.actions[rows - lag, column]
    held = {action}
    for _ in spec.previous:
        held |= {name for name, other in spec.previous.items() if other in held}
    columns = [i for i, name in enumerate(spec.states) if name in held]
    states[:, columns] = data.states[rows - lag][:, columns]
    move = physics.mean_function()
    following = step_or_nan(lambda *at: move(*(x[None] for x in at))[0], states, actions)
    return spec.change(following, data.next_states[rows])[:, spec.predicted].square()
