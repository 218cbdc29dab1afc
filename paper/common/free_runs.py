"""Free runs of a physics and of models that adjust it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from gpadjust.dynamics import FreeRun, PhysicsDynamics
from gpadjust.physics import FunctionPhysics, ParameterValues, Physics, Unknown
from gpadjust.states import StateSpec


def law_of(
    following: Callable[[Tensor, ParameterValues], Tensor],
    unknowns: Mapping[str, Unknown],
    values: Sequence[float] | None = None,
) -> FunctionPhysics:
    """Return a law of inputs and parameters, unknown or given."""
    if values is None:
        return FunctionPhysics(following, unknowns=unknowns)
    known = ParameterValues(tuple(unknowns), torch.tensor(values, dtype=torch.float64))
    return FunctionPhysics(lambda X: following(X, known))


def path_of(spec: StateSpec, physics: Physics, start: Tensor, actions: Tensor) -> Tensor:
    """Return states ``n x state_dim`` by f_p alone from ``1 x state_dim``, without noise."""
    step, path = PhysicsDynamics(spec, physics).mean_function(), [start]
    for action in actions:
        path.append(step(path[-1][None], action.view(1, 1, 1))[0])
    return torch.cat(path[1:])


def ends_of(free: FreeRun, column: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean and ends of intervals of a state along the first free run."""
    mean, low, high = (each[0, :, column] for each in (free.mean, free.lower, free.upper))
    return mean, low, high
