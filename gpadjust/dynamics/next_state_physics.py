"""What dynamics expect of a physics: the next states."""

from __future__ import annotations

import math
import warnings
from typing import cast

import torch
from torch import Tensor

from gpadjust.dynamics.transitions import Transitions
from gpadjust.models.term_builder import PhysicsLike
from gpadjust.physics import JoinedPhysics, ODEPhysics, Physics, as_physics
from gpadjust.states import StateSpec


def check_physics(physics: PhysicsLike, spec: StateSpec) -> Physics:
    """A physics of next states, or several of them joined, from what the user gave."""
    whole = as_physics(physics)
    for part in parts_of(whole).values():
        if isinstance(part, ODEPhysics) and part.difference:
            raise ValueError(
                f"Physics {part.name!r} returns the change of the state (difference=True), but "
                "dynamics take the next state from it; build it with difference=False."
            )
        step = part.step if isinstance(part, ODEPhysics) else spec.step
        if spec.step is not None and not math.isclose(step or 0.0, spec.step, rel_tol=1e-6):
            raise ValueError(
                f"Physics {part.name!r} makes steps of {step:g}, but the spec says {spec.step:g}; "
                f"build it with step={spec.step:g}, or correct the spec."
            )
    return whole


def parts_of(physics: Physics) -> dict[str, Physics]:
    """The physics that a joined one holds, by their names; of any other, that one itself."""
    if isinstance(physics, JoinedPhysics):
        return {n: cast(Physics, p) for n, p in zip(physics.names, physics.parts, strict=True)}
    return {physics.name: physics}


def next_values(physics: Physics, inputs: Tensor, num_states: int) -> Tensor:
    """What the physics says, ``... x num_states``, from ``... x (num_states + a)``."""
    Y = physics(inputs if inputs.dim() > 1 else inputs.unsqueeze(0))
    check_next_values(physics, Y, num_states)
    return Y


def check_next_values(physics: Physics, Y: Tensor, num_states: int) -> None:
    """Raise a ValueError unless the physics has returned as many columns as there are states."""
    if Y.shape[-1] != num_states:
        raise ValueError(
            f"Expected physics {physics.name!r} to return the next values of the {num_states} "
            f"states that are neither exogenous nor previous values, got {Y.shape[-1]} columns."
        )


def warn_of_differences(
    name: str, spec: StateSpec, data: Transitions, columns: list[int], change: Tensor
) -> None:
    """Warn if the physics seems to return the change of the state instead of the next state.

    It does if the state plus what it returned errs by less than a third, in units of the root mean
    square of each state's true change.

    Args:
        name: The name of the physics.
        spec: What the entries of the state are.
        data: Transitions of the system.
        columns: The states that were compared.
        change: Their change in the transitions, if the physics returns next states: ``N x m``.
    """
    truth = spec.change(data.states, data.next_states)
    scale = truth.square().nanmean(0).sqrt()[columns]
    errors = []
    for added in (torch.zeros_like(data.states), data.states):
        predicted = data.states.clone()
        predicted[:, columns] += change + added[:, columns]
        error = spec.change(data.next_states, predicted)[:, columns]
        errors.append(float((error[:, scale > 0] / scale[scale > 0]).square().nansum().sqrt()))
    if errors[1] < errors[0] / 3:
        warnings.warn(
            f"Physics {name!r} seems to return the change of the state, but dynamics take the next "
            f"state from it. As a change, its error is {errors[1] / errors[0]:.2g} times that of "
            "the next state. Let it return `next state = state + change`.",
            UserWarning,
            stacklevel=4,
        )
