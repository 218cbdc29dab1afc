"""A step of dynamics in scalars of any kind: the text of C, or symbols of CasADi."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from gpadjust.dynamics import LearnedDynamics


def model_inputs(
    dynamics: LearnedDynamics, state: Sequence[Any], action: Sequence[Any]
) -> list[Any]:
    """The raw inputs of the model, as :meth:`Targets.inputs` has them."""
    spec = dynamics.spec
    previous = [state[i] for i in spec.previous_columns]
    return [*(state[i] for i in spec.moving), *action, *previous]


def physics_columns(
    dynamics: LearnedDynamics,
    state: Sequence[Any],
    f_p: Sequence[Any],
    wrapped: Callable[[Any], Any],
) -> list[Any]:
    """The columns of f_p in the model, by next states, as :class:`TargetPhysics` has them."""
    spec, targets = dynamics.spec, dynamics.targets
    found = []
    for first in range(0, len(f_p), len(spec.moving)):
        for i, place in zip(spec.predicted, targets.predicted, strict=True):
            change = f_p[first + place] - state[i]
            change = wrapped(change) if spec.states[i] in spec.angles else change
            found.append(change if targets.target == "difference" else state[i] + change)
    return found


def next_state(
    dynamics: LearnedDynamics, state: Sequence[Any], action: Sequence[Any], learnt: Sequence[Any]
) -> list[Any]:
    """The next state, by what the model says of it, as :meth:`StateSpec.complete` has it."""
    spec, found = dynamics.spec, [*state]
    for i, value in zip(spec.predicted, learnt, strict=True):
        found[i] = state[i] + value if dynamics.targets.target == "difference" else value
    before = dict(zip((*spec.states, *spec.actions), (*state, *action), strict=True))
    for name, other in spec.previous.items():
        found[spec.states.index(name)] = before[other]
    for name, velocity in spec.integrated.items():
        i, v = spec.states.index(name), spec.states.index(velocity)
        found[i] = state[i] + (spec.step or 0.0) / 2 * (state[v] + found[v])
    return found


def next_variance(dynamics: LearnedDynamics, learnt: Sequence[Any], zero: Any) -> list[Any]:
    """The variance of the next state, as :meth:`StateSpec.complete_variance` has it."""
    spec = dynamics.spec
    found = [zero] * spec.state_dim
    for i, value in zip(spec.predicted, learnt, strict=True):
        found[i] = value
    for name, velocity in spec.integrated.items():
        found[spec.states.index(name)] = ((spec.step or 0.0) / 2) ** 2 * found[
            spec.states.index(velocity)
        ]
    return found
