"""A test for actions that act a step later than in the spec."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.dynamics.base import step_or_nan
from gpadjust.physics import PhysicsError

_LEAST = 8  # transitions after a change of the action, in addition to one for each moving state
_CLEAR = 3.0  # standard errors by which a longer delay explains more
_SHARE = 0.2  # largest share of the squared errors that it leaves


@torch.no_grad()
def find_delay(physics: Dynamics, data: Trajectories) -> str | None:
    """Return a message on the first action that acts one step later than in the spec.

    The squared one-step errors of the physics, each after a fit of a scale of the change and terms
    linear in the states (a wrong gain is not a delay), are compared by the delay of the action. The
    longer delay explains a state better than the best shorter one if the relative differences are
    on average above three of their standard errors, and the mean error is at most a fifth.
    """
    spec = physics.spec
    for action in spec.actions:
        depths = {action: 0}  # age of the action that each name contains, in steps
        for _ in spec.previous:  # as often as the longest chain of them needs
            depths |= {name: depths[of] + 1 for name, of in spec.previous.items() if of in depths}
        delay = max(depths.values()) + 1  # one step more than the spec has
        longest = delay - min((depths[n] for n in spec.physics_reads if n in depths), default=0)
        rows = torch.arange(len(data))[longest:]
        rows = rows[data.episode[rows] == data.episode[rows - longest]]
        inputs = [_delayed(physics, data, rows, depths, lag) for lag in range(longest + 1)]
        try:
            errors = torch.stack([_squared_errors(physics, data, rows, at) for at in inputs])
        except PhysicsError:  # without the rows
            continue
        # A held action does not show the delay.
        changed = torch.ne(torch.cat(inputs[-1], dim=-1), torch.cat(inputs[-2], dim=-1)).any(-1)
        errors = errors[:, errors.isfinite().all(-1).all(0) & changed]
        if errors.shape[1] < _LEAST + len(spec.moving):
            continue
        *before, late = errors.clamp_min(1e-300)
        shorter = before[int(torch.stack(before).mean(1).log().sum(1).argmin())]
        # Clear if mean(g) > 3 sd(g) / sqrt(n), g = (e - e') / (e + e')
        gain = (shorter - late) / (shorter + late)  # in [-1, 1]: no single row decides
        clear = gain.mean(0) > _CLEAR * gain.std(0) / len(gain) ** 0.5
        share = (late.mean(0) / shorter.mean(0)).where(clear, torch.inf)
        if share.amin() < _SHARE:
            state = spec.states[spec.predicted[int(share.argmin())]]
            chain = [action, *(f"{action}_{i + 1}" for i in range(delay))]
            return (
                f"The data follow {action!r} {delay} step(s) late: with this delay the squared "
                f"errors of the physics in {state!r} are {float(share.amin()):.0%} of what they "
                f"are. Use gpadjust.systems.RememberAction(env, steps={delay}), and in the "
                f"StateSpec previous={dict(zip(chain[1:], chain, strict=False))}, and "
                f"physics_reads with {chain[-1]!r} in place of {chain[-2]!r}."
            )
    return None


def _delayed(
    physics: Dynamics, data: Trajectories, rows: Tensor, names: Iterable[str], lag: int
) -> list[Tensor]:
    """Return states and actions ``N x ...`` of rows, with entries ``names`` of earlier steps."""
    spec = physics.spec
    parts = []
    for part, entries in ((data.states, spec.states), (data.actions, spec.actions)):
        columns = [i for i, name in enumerate(entries) if name in names]
        now = part[rows].clone()
        now[:, columns] = part[rows - lag][:, columns]
        parts.append(now)
    return parts


def _squared_errors(
    physics: Dynamics, data: Trajectories, rows: Tensor, inputs: list[Tensor]
) -> Tensor:
    """Return squares ``N x m`` of errors in predicted states; NaN where the physics fails."""
    spec = physics.spec
    states = data.states[rows]
    move = physics.mean_function()
    following = step_or_nan(lambda *parts: move(*(x[None] for x in parts))[0], *inputs)
    predicted = spec.change(states, following)[:, spec.predicted]
    change = spec.change(states, data.next_states[rows])[:, spec.predicted]
    works = predicted.isfinite().all(-1)
    linear = torch.cat([torch.ones(len(rows), 1).to(states), states[:, spec.moving]], dim=-1)[works]
    errors = torch.full_like(change, torch.nan)
    for i in range(change.shape[1]):
        basis = torch.cat([predicted[works, i : i + 1], linear], dim=-1)
        basis = basis / basis.norm(dim=0).clamp_min(1e-300)
        fitted = torch.linalg.lstsq(basis, change[works, i : i + 1], driver="gelsd").solution
        errors[works, i] = change[works, i] - (basis @ fitted).squeeze(-1)
    return errors.square()
