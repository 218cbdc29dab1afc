"""Whether a system follows its actions a step later than its spec says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.dynamics.base import step_or_nan
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec

_LEAST = 8  # transitions before which the action has changed, beside as many as moving states
_CLEAR = 3.0  # standard errors, by which a longer delay explains more
_SHARE = 0.2  # of the squared errors, at most, that are left by then


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
    before than is told, and by those between; each are those that a scale of the change and terms
    linear in the states leave, as a wrong gain is no delay. The longer delay is found if it
    explains a state better than the best shorter one: the relative differences of the squares are
    on average above three of their standard errors, and their mean is at most a fifth of that.

    Args:
        physics: The physics alone.
        data: All transitions so far.
    """
    spec = physics.spec
    for action in spec.actions:
        depths = _depths(spec, action)
        told = max(depths.values())
        read = [depths[name] for name in spec.physics_reads if name in depths]
        most = told - min(read, default=0) + 1
        rows = torch.arange(len(data.states))[most:]
        rows = rows[data.episode[rows] == data.episode[rows - most]]
        try:
            lags = [_squared_errors(physics, data, rows, depths, lag) for lag in range(most + 1)]
        except PhysicsError:  # it does not say where it fails
            continue
        errors = torch.stack(lags)  # lags x N x m
        # Where an action was held, the delay is not seen.
        ends = (torch.cat(_held(spec, data, rows, depths, lag), dim=-1) for lag in (most, most - 1))
        seen = errors.isfinite().all(-1).all(0) & torch.ne(*ends).any(-1)
        errors = errors[:, seen]
        if errors.shape[1] < _LEAST + len(spec.moving):
            continue
        *before, found = errors.clamp_min(1e-300)
        shorter = before[int(torch.stack(before).mean(1).log().sum(1).argmin())]
        gain = (shorter - found) / (shorter + found)  # in [-1, 1]: no single row decides
        clear = gain.mean(0) > _CLEAR * gain.std(0) / len(gain) ** 0.5
        share = (found.mean(0) / shorter.mean(0)).where(clear, torch.inf)
        if share.amin() < _SHARE:
            state = spec.states[spec.predicted[int(share.argmin())]]
            return Delay(action, told + 1, state, float(share.amin()))
    return None


def _depths(spec: StateSpec, action: str) -> dict[str, int]:
    """How many steps ago an action was that each name holds: itself 0, states in ``previous``."""
    depths = {action: 0}
    for _ in spec.previous:  # as often as the longest chain of them needs
        depths |= {name: depths[held] + 1 for name, held in spec.previous.items() if held in depths}
    return depths


def _held(
    spec: StateSpec, data: Trajectories, rows: Tensor, held: Iterable[str], lag: int
) -> list[Tensor]:
    """States and actions ``N x ...`` of rows, in which some names have values of steps before."""
    at = []
    for part, names in ((data.states, spec.states), (data.actions, spec.actions)):
        columns = [i for i, name in enumerate(names) if name in held]
        now = part[rows].clone()
        now[:, columns] = part[rows - lag][:, columns]
        at.append(now)
    return at


def _squared_errors(
    physics: Dynamics, data: Trajectories, rows: Tensor, held: Iterable[str], lag: int
) -> Tensor:
    """Squares ``N x m`` of errors of predicted states, by what was held some steps before.

    They are NaN where the physics fails.
    """
    spec = physics.spec
    at = _held(spec, data, rows, held, lag)
    move = physics.mean_function()
    following = step_or_nan(lambda *parts: move(*(x[None] for x in parts))[0], *at)
    states = data.states[rows]
    foreseen = spec.change(states, following)[:, spec.predicted]
    change = spec.change(states, data.next_states[rows])[:, spec.predicted]
    works = foreseen.isfinite().all(-1)
    linear = torch.cat([torch.ones(len(rows), 1).to(states), states[:, spec.moving]], dim=-1)[works]
    errors = torch.full_like(change, torch.nan)
    for i in range(change.shape[1]):
        basis = torch.cat([foreseen[works, i : i + 1], linear], dim=-1)
        basis = basis / basis.norm(dim=0).clamp_min(1e-300)
        fitted = torch.linalg.lstsq(basis, change[works, i : i + 1], driver="gelsd").solution
        errors[works, i] = change[works, i] - (basis @ fitted).squeeze(-1)
    return errors.square()
