"""A Physics of a function of NumPy arrays or of tensors."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.physics.base import Physics
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.error import PhysicsError
from gpadjust.physics.function import FunctionPhysics, as_physics


def array_physics(physics: Any, X: NDArray[np.float64]) -> Physics:
    """Makes a Physics of a NumPy function, a torch function or module, or several of them.

    A function is asked for the first row of ``X``, as an array. If it returns a tensor, or fails
    with the array and returns a tensor for one, it is a torch function; otherwise a NumPy function.

    Args:
        physics: A function of rows ``N x d``; a torch module, of which a copy is taken, so that
            fitting leaves the user's as it is; a Physics; or a list or dictionary of these.
        X: Inputs, ``N x d``.

    Raises:
        TypeError: If it is none of these.
        PhysicsError: If a function fails both with an array and with a tensor.

    Example:
        >>> row = np.zeros((1, 2))
        >>> array_physics(np.sin, row), array_physics(torch.sin, row)
        (BlackBoxPhysics(name='sin', ...), FunctionPhysics(name='sin', ...))
    """
    if isinstance(physics, dict):
        return as_physics({name: array_physics(part, X) for name, part in physics.items()})
    if isinstance(physics, list | tuple):
        return as_physics([array_physics(part, X) for part in physics])
    if isinstance(physics, torch.nn.Module):
        return as_physics(deepcopy(physics))
    if not callable(physics) or isinstance(physics, type):
        return as_physics(physics)  # which says what is expected
    is_torch = torch.is_tensor(_first_value(physics, X[:1]))
    return FunctionPhysics(physics) if is_torch else BlackBoxPhysics(physics)


def _first_value(function: Any, row: NDArray[np.float64]) -> Any:
    try:
        return function(row.copy())
    except Exception as of_array:
        try:
            return function(torch.from_numpy(row.copy()))
        except Exception as of_tensor:
            name = getattr(function, "__name__", type(function).__name__)
            raise PhysicsError(
                f"Physics {name!r} failed at the first row of X, as a NumPy array "
                f"({type(of_array).__name__}: {of_array}) and as a torch tensor "
                f"({type(of_tensor).__name__}: {of_tensor}). Expected a function of rows N x d "
                "that takes one of them; of a single row, BlackBoxPhysics(function, batched=False)."
            ) from of_array
