"""Windows of recorded episodes, and particles that follow their actions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gpadjust.dynamics.step_or_nan import step_or_nan
from gpadjust.dynamics.transitions import Transitions
from gpadjust.states import StateSpec

_AT_ONCE = 8  # windows whose particles move together: more leave the cache, at half the speed

Move = Callable[[Tensor, Tensor], Tensor]


def of_states(values: Tensor, name: str, shape: tuple[int, ...]) -> Tensor:
    """The user's numbers, one or more for each state, in float64.

    Raises:
        TypeError: If they are no numbers.
        ValueError: If they are not of that shape.
    """
    try:
        values = torch.as_tensor(values, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"Expected {name} as a tensor of numbers, got {values!r}.") from error
    if values.shape != shape:
        raise ValueError(
            f"Expected {name} of shape {' x '.join(map(str, shape))}, an entry for each state, got "
            f"shape {tuple(values.shape)}."
        )
    return values


def steps_ahead(spec: StateSpec, data: Transitions) -> Tensor:
    """How many recorded steps lead on from each row, its own included: ``N`` whole numbers.

    A row leads to the next one if its next state is the state there, but for the rounding of single
    precision; an entry that was not measured is not compared.
    """
    found, expected = data.states[1:], data.next_states[:-1]
    size = torch.maximum(found.abs(), expected.abs())
    size[:, spec.angle_columns] = size[:, spec.angle_columns].clamp_min(1)
    same = spec.change(expected, found).abs() <= 4 * torch.finfo(torch.float32).eps * size
    leads = (same | expected.isnan()).all(-1).tolist()
    ahead = [1]
    for goes_on in reversed(leads):
        ahead.append(ahead[-1] + 1 if goes_on else 1)
    return torch.tensor(ahead[::-1])


def chosen_starts(
    ahead: Tensor, horizons: tuple[int, ...], max_windows: int | None
) -> list[Tensor]:
    """The rows at which the windows of each horizon start: all, or so many, evenly spread."""
    chosen = []
    for horizon in horizons:
        rows = (ahead >= horizon).nonzero().flatten()
        if max_windows is not None and len(rows) > max_windows:
            rows = rows[torch.linspace(0, len(rows) - 1, max_windows).round().long()]
        chosen.append(rows)
    return chosen


def move_on(
    functions: Move, particles: Tensor, lost: Tensor, actions: Tensor, bounds: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Particles a step later, and which are lost by then; a lost one stays where it was.

    Args:
        functions: Functions of states ``K x n x ...`` and actions to next states.
        particles: ``K x w x state_dim``.
        lost: Which of them are lost already, ``K x w`` booleans.
        actions: ``w x action_dim``.
        bounds: Lower and upper ones of the states, ``2 x state_dim``.
    """

    def move(states: Tensor, actions: Tensor) -> Tensor:
        blocks = (rows.unflatten(0, (len(particles), -1)) for rows in (states, actions))
        parts = zip(*(block.split(_AT_ONCE, dim=1) for block in blocks), strict=True)
        return torch.cat([functions(*part) for part in parts], dim=1).flatten(0, 1)

    actions = actions.expand(len(particles), -1, -1)
    after = step_or_nan(move, particles.flatten(0, 1), actions.flatten(0, 1)).view_as(particles)
    fails = ~after.isfinite().all(-1)
    if bounds is not None:
        fails |= ((after < bounds[0]) | (after > bounds[1])).any(-1)
    lost = lost | fails
    return torch.where(lost.unsqueeze(-1), particles, after), lost


def follow(
    functions: Move,
    num_functions: int,
    data: Transitions,
    horizons: tuple[int, ...],
    chosen: list[Tensor],
    bounds: Tensor | None,
) -> dict[int, tuple[Tensor, Tensor]]:
    """Particles ``K x w x state_dim`` after the steps of each horizon, and which are lost.

    Args:
        functions: Functions of states ``K x n x ...`` and actions to next states.
        num_functions: Their number ``K``.
        data: What was recorded.
        horizons: Numbers of steps, the largest last.
        chosen: The rows at which the windows of each horizon start.
        bounds: Lower and upper ones of the states, ``2 x state_dim``.
    """
    # A window is the beginning of a longer one from the same row.
    starts = torch.cat(chosen).unique()
    longest = torch.zeros_like(starts)
    for horizon, rows in zip(horizons, chosen, strict=True):
        longest[torch.searchsorted(starts, rows)] = horizon
    particles = data.states[starts].expand(num_functions, -1, -1).clone()
    lost = torch.zeros(particles.shape[:2], dtype=torch.bool)
    found = {
        horizon: (particles[:, :0], lost[:, :0])
        for horizon, rows in zip(horizons, chosen, strict=True)
        if not len(rows)
    }
    for t in range(int(longest.max()) if len(starts) else 0):
        going = (longest > t).nonzero().flatten()
        actions = data.actions[starts[going] + t]
        particles[:, going], lost[:, going] = move_on(
            functions, particles[:, going], lost[:, going], actions, bounds
        )
        if t + 1 in horizons:
            those = torch.searchsorted(starts, chosen[horizons.index(t + 1)])
            found[t + 1] = particles[:, those], lost[:, those]
    return found
