"""Whether a system follows its actions a step later than its spec says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.dynamics.particles import step_or_nan
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec

_LEAST = 16  # transitions before which the action has changed
_CLEAR = 3.0  # standard errors, by which a longer delay explains more
_SHARE = 0.4  # of the squared errors, at most, that are left by then


class Delay(NamedTuple):
    """A delay that the data show.

    Args:
        action: The name of the action.
        steps: The delay, in steps, one more than was told.
        state: The name of the state that shows it best.
        share: The mean square of the physics' errors there, as a share of that without it.
    """

    action: str
    steps: int
    state: str
    share: float

    def __str__(self) -> str:
        """Say it, with the way out."""
        wrapper = f"gpadjust.systems.RememberAction(env, steps={self.steps})"
        chain = [self.action, *(f"{self.action}_{i + 1}" for i in range(self.steps))]
        previous = dict(zip(chain[1:], chain, strict=False))
        return (
            f"The data follow {self.action!r} {self.steps} step(s) late: by the action of then the "
            f"squared errors of the physics in {self.state!r} are {self.share:.0%} of what they "
            f"are. Let the environment show it, by {wrapper}, and tell the StateSpec: "
            f"previous={previous}, and physics_reads with {chain[-1]!r} in the place of "
            f"{chain[-2]!r}."
        )


@torch.no_grad()
def find_delay(physics: Dynamics, data: Trajectories) -> Delay | None:
    """Find an action that the system follows one step later than the spec says.

    The errors of the physics in one step are compared with those by the action of one step more
    before than is told, and by those between. The longer delay is found if it explains a state
    better than the best shorter one: the relative differences of the squares are on average above
    three of their standard errors, and their mean is at most 40 % of that.

    Args:
        physics: The physics alone.
        data: All transitions so far.
    """
    for action in physics.spec.actions:
        depths = _depths(physics.spec, action)
        told = max(depths.values())
        read = [depths[name] for name in physics.spec.physics_reads if name in depths]
        most = told - min(read, default=0) + 1
        rows = torch.arange(len(data.states))[most:]
        rows = rows[data.episode[rows] == data.episode[rows - most]]
        try:
            lags = [_squared_errors(physics, data, rows, depths, lag) for lag in range(most + 1)]
        except PhysicsError:  # it does not say where it fails
            continue
        errors = torch.stack(lags)  # lags x N x m
        # Where an action was held, the delay is not seen.
        seen = errors.isfinite().all(-1).all(0) & (errors[-1] != errors[-2]).any(-1)
        errors = errors[:, seen]
        if errors.shape[1] < _LEAST:
            continue
        *before, found = errors.clamp_min(1e-300)
        shorter = before[int(torch.stack(before).mean(1).log().sum(1).argmin())]
        gain = (shorter - found) / (shorter + found)  # in [-1, 1]: no single row decides
        clear = gain.mean(0) > _CLEAR * gain.std(0) / len(gain) ** 0.5
        share = (found.mean(0) / shorter.mean(0)).where(clear, torch.inf)
        if share.amin() < _SHARE:
            state = physics.spec.states[physics.spec.predicted[int(share.argmin())]]
            return Delay(action, told + 1, state, float(share.amin()))
    return None


def _depths(spec: StateSpec, action: str) -> dict[str, int]:
    """How many steps ago an action was that each name holds: itself 0, states in ``previous``."""
    depths = {action: 0}
    for _ in spec.previous:  # as often as the longest chain of them needs
        depths |= {name: depths[held] + 1 for name, held in spec.previous.items() if held in depths}
    return depths


def _squared_errors(
    physics: Dynamics, data: Trajectories, rows: Tensor, held: Iterable[str], lag: int
) -> Tensor:
    """Squares ``N x m`` of errors of predicted states, by what was held some steps before."""
    spec = physics.spec
    at = [part[rows].clone() for part in (data.states, data.actions)]
    for part, names in ((0, spec.states), (1, spec.actions)):
        columns = [i for i, name in enumerate(names) if name in held]
        before = (data.states, data.actions)[part][rows - lag]
        at[part][:, columns] = before[:, columns]
    move = physics.mean_function()
    following = step_or_nan(lambda *parts: move(*(x[None] for x in parts))[0], *at)
    return spec.change(following, data.next_states[rows])[:, spec.predicted].square()
