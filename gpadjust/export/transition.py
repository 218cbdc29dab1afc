"""A step of dynamics in scalars of any kind: texts of C, or symbols of CasADi."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from gpadjust.dynamics import LearnedDynamics
from gpadjust.states import StateSpec

Scalars = Sequence[Any]


def target_columns(
    dynamics: LearnedDynamics, state: Scalars, f_p: Scalars, wrap: Callable[[Any], Any]
) -> list[Any]:
    """Return columns of f_p in the model, made of next values as by :class:`TargetPhysics`."""
    spec, targets = dynamics.spec, dynamics.targets
    columns = []
    for first in range(0, len(f_p), len(spec.moving)):  # of each physics
        for i, place in zip(spec.predicted, targets.predicted, strict=True):
            change = f_p[first + place] - state[i]
            if spec.states[i] in spec.angles:
                change = wrap(change)
            if targets.target != "difference":  # the next value, in the turn of the state
                change = state[i] + change
            columns.append(change)
    return columns


def next_state(
    dynamics: LearnedDynamics, state: Scalars, action: Scalars, outputs: Scalars
) -> list[Any]:
    """Return the next state by the model, as :meth:`StateSpec.complete` makes it."""
    spec = dynamics.spec
    following = [*state]  # exogenous entries stay
    for i, value in zip(spec.predicted, outputs, strict=True):
        following[i] = value
        if dynamics.targets.target == "difference":
            following[i] = state[i] + value
    following = _remembered(spec, state, action, following)
    for name, velocity in spec.integrated.items():
        i, v = spec.states.index(name), spec.states.index(velocity)
        # x' = x + h (v + v') / 2
        following[i] = state[i] + (spec.step or 0.0) / 2 * (state[v] + following[v])
    return following


def following_state(spec: StateSpec, state: Scalars, action: Scalars, f_p: Scalars) -> list[Any]:
    """Return the next state by a physics alone, as :func:`next_values` makes it."""
    following = [*state]
    for i, value in zip(spec.moving, f_p, strict=True):
        following[i] = value
    return _remembered(spec, state, action, following)


def _remembered(spec: StateSpec, state: Scalars, action: Scalars, following: Scalars) -> list[Any]:
    """Return a next state whose previous values are those of the state and action."""
    before = dict(zip((*spec.states, *spec.actions), (*state, *action), strict=True))
    after = dict(zip(spec.states, following, strict=True))
    return [*(after | {name: before[source] for name, source in spec.previous.items()}).values()]


def next_variance(dynamics: LearnedDynamics, outputs: Scalars, zero: Any) -> list[Any]:
    """Return the variance of the next state, as :meth:`StateSpec.complete_variance` makes it."""
    spec = dynamics.spec
    variances = [zero] * spec.state_dim  # of entries that the action or the state determine
    for i, variance in zip(spec.predicted, outputs, strict=True):
        variances[i] = variance
    for name, velocity in spec.integrated.items():
        # Var x' = (h / 2)^2 Var v'
        variance = ((spec.step or 0.0) / 2) ** 2 * variances[spec.states.index(velocity)]
        variances[spec.states.index(name)] = variance
    return variances
