"""A step of dynamics in scalars of any kind: texts of C, or symbols of CasADi."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from gpadjust.dynamics import LearnedDynamics
from gpadjust.states import StateSpec

Scalars = Sequence[Any]


def target_columns(
    dynamics: LearnedDynamics, state: Scalars, f_p: Scalars, wrapped: Callable[[Any], Any]
) -> list[Any]:
    """Return columns of f_p in the model, made of next values as by :class:`TargetPhysics`."""
    spec, targets = dynamics.spec, dynamics.targets
    found = []
    for first in range(0, len(f_p), len(spec.moving)):
        for i, place in zip(spec.predicted, targets.predicted, strict=True):
            change = f_p[first + place] - state[i]
            change = wrapped(change) if spec.states[i] in spec.angles else change
            found.append(change if targets.target == "difference" else state[i] + change)
    return found


def next_state(
    dynamics: LearnedDynamics, state: Scalars, action: Scalars, learnt: Scalars
) -> list[Any]:
    """Return the next state by the model, as :meth:`StateSpec.complete` makes it."""
    spec, found = dynamics.spec, [*state]
    for i, value in zip(spec.predicted, learnt, strict=True):
        found[i] = state[i] + value if dynamics.targets.target == "difference" else value
    found = _remembered(spec, state, action, found)
    for name, velocity in spec.integrated.items():
        i, v = spec.states.index(name), spec.states.index(velocity)
        found[i] = state[i] + (spec.step or 0.0) / 2 * (state[v] + found[v])
    return found


def following(spec: StateSpec, state: Scalars, action: Scalars, f_p: Scalars) -> list[Any]:
    """Return the next state by a physics alone, as :func:`next_values` makes it."""
    found = [*state]
    for i, value in zip(spec.moving, f_p, strict=True):
        found[i] = value
    return _remembered(spec, state, action, found)


def _remembered(spec: StateSpec, state: Scalars, action: Scalars, found: list[Any]) -> list[Any]:
    """Return a next state in which previous values are those of the state and action."""
    before = dict(zip((*spec.states, *spec.actions), (*state, *action), strict=True))
    return [
        before[spec.previous[n]] if n in spec.previous else found[i]
        for i, n in enumerate(spec.states)
    ]


def next_variance(dynamics: LearnedDynamics, learnt: Scalars, zero: Any) -> list[Any]:
    """Return the variance of the next state, as :meth:`StateSpec.complete_variance` makes it."""
    spec = dynamics.spec
    known = dict(zip(spec.predicted, learnt, strict=True))
    found = [known.get(i, zero) for i in range(spec.state_dim)]
    for name, velocity in spec.integrated.items():
        variance = ((spec.step or 0.0) / 2) ** 2 * found[spec.states.index(velocity)]
        found[spec.states.index(name)] = variance
    return found
