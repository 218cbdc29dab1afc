"""Whether a system follows its actions a step later than its spec says."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.dynamics.base import step_or_nan
from gpadjust.physics import PhysicsError

_LEAST = 8  # transitions before which the action has changed, beside as many as moving states
_CLEAR = 3.0  # standard errors, by which a longer delay explains more
_SHARE = 0.2  # of the squared errors, at most, that are left by then


@torch.no_grad()
def find_delay(physics: Dynamics, data: Trajectories) -> str | None:
    """Describe the first action that the system follows one step later than the spec says.

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
        depths = {action: 0}  # how many steps ago an action was that each name holds
        for _ in spec.previous:  # as often as the longest chain of them needs
            depths |= {name: depths[of] + 1 for name, of in spec.previous.items() if of in depths}
        told = max(depths.values())
        longest = told + 1 - min((depths[n] for n in spec.physics_reads if n in depths), default=0)
        rows = torch.arange(len(data))[longest:]
        rows = rows[data.episode[rows] == data.episode[rows - longest]]
        inputs = [_delayed(physics, data, rows, depths, lag) for lag in range(longest + 1)]
        try:
            errors = torch.stack([_squared_errors(physics, data, rows, at) for at in inputs])
        except PhysicsError:  # it does not say where it fails
            continue
        # Where an action was held, the delay is not seen.
        changed = torch.ne(torch.cat(inputs[-1], dim=-1), torch.cat(inputs[-2], dim=-1)).any(-1)
        errors = errors[:, errors.isfinite().all(-1).all(0) & changed]
        if errors.shape[1] < _LEAST + len(spec.moving):
            continue
        *before, late = errors.clamp_min(1e-300)
        shorter = before[int(torch.stack(before).mean(1).log().sum(1).argmin())]
        gain = (shorter - late) / (shorter + late)  # in [-1, 1]: no single row decides
        clear = gain.mean(0) > _CLEAR * gain.std(0) / len(gain) ** 0.5
        share = (late.mean(0) / shorter.mean(0)).where(clear, torch.inf)
        if share.amin() < _SHARE:
            steps, state = told + 1, spec.states[spec.predicted[int(share.argmin())]]
            chain = [action, *(f"{action}_{i + 1}" for i in range(steps))]
            return (
                f"The data follow {action!r} {steps} step(s) late: by the action of then the "
                f"squared errors of the physics in {state!r} are {float(share.amin()):.0%} of what "
                "they are. Let the environment show it, by "
                f"gpadjust.systems.RememberAction(env, steps={steps}), and tell the StateSpec: "
                f"previous={dict(zip(chain[1:], chain, strict=False))}, and physics_reads with "
                f"{chain[-1]!r} in the place of {chain[-2]!r}."
            )
    return None


def _delayed(
    physics: Dynamics, data: Trajectories, rows: Tensor, names: Iterable[str], lag: int
) -> list[Tensor]:
    """Return states and actions ``N x ...`` of rows, with some entries of steps before."""
    parts = []
    for part, own in ((data.states, physics.spec.states), (data.actions, physics.spec.actions)):
        columns = [i for i, name in enumerate(own) if name in names]
        now = part[rows].clone()
        now[:, columns] = part[rows - lag][:, columns]
        parts.append(now)
    return parts


def _squared_errors(
    physics: Dynamics, data: Trajectories, rows: Tensor, inputs: list[Tensor]
) -> Tensor:
    """Return squares ``N x m`` of errors in predicted states; NaN where the physics fails."""
    spec, states, move = physics.spec, data.states[rows], physics.mean_function()
    following = step_or_nan(lambda *parts: move(*(x[None] for x in parts))[0], *inputs)
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
