"""Physics of a torch function, and of other callables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.physics.base import Physics, name_of
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown


class FunctionPhysics(Physics):
    """Physics given as a torch function, differentiable by autograd.

    Args:
        function: Maps rows ``N x d`` to outputs ``N x m``, or ``N`` if ``m`` is 1. With unknown
            parameters their values, ``N`` each, are its second argument: ``lambda X, p: p.mass *
            X[:, 0]``. Parameters of a ``torch.nn.Module`` stay as they are: train it before.
        unknowns, inputs, name: As of :class:`Physics`.

    Example:
        >>> physics = FunctionPhysics(lambda X: X[:, 0] * X[:, 1], name="power")
        >>> physics(torch.tensor([[230.0, 2.0]], dtype=torch.float64))
        tensor([[460.]], dtype=torch.float64)
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__(unknowns=unknowns, inputs=inputs, name=name_of(function, name))
        self.function = function

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the function's outputs."""
        return self.function(X, *parameters)


def as_physics(physics: Physics | Callable[[Tensor], Tensor]) -> Physics:
    """Return a physics as it is, or a torch function of rows ``N x d`` as a ``FunctionPhysics``."""
    if isinstance(physics, Physics):
        return physics
    if callable(physics) and not isinstance(physics, type):
        return FunctionPhysics(physics)
    raise TypeError(
        f"physics must be a Physics or a callable, not a class; found a {type(physics).__name__}, "
        f"{physics!r}. Pass a torch function of rows N x d, an ODEPhysics, or a BlackBoxPhysics."
    )


def array_physics(physics: Any, X: NDArray[np.float64]) -> Physics:
    """Return a physics of a NumPy function, a torch function or module, or a Physics.

    A function is called with the first row of the inputs ``X``, ``N x d``, as an array. If it
    returns a tensor, or fails with the array and returns a tensor for one, it is a torch function;
    if it fails with both, there is a PhysicsError. A module is copied, so that fits leave it.
    """
    if isinstance(physics, torch.nn.Module):
        return as_physics(deepcopy(physics))
    of_torch = as_physics(physics)  # which checks it
    try:
        value = physics(X[:1].copy())
    except Exception as array_error:
        try:
            value = physics(torch.from_numpy(X[:1].copy()))
        except Exception as tensor_error:
            raise PhysicsError(
                f"Physics {of_torch.name!r} failed at the first row of X, as a NumPy array "
                f"({described(array_error)}) and as a torch tensor ({described(tensor_error)}). "
                "Expected a function of rows N x d; of a single row, take "
                "BlackBoxPhysics(batched=False)."
            ) from array_error
    return of_torch if torch.is_tensor(value) else BlackBoxPhysics(physics)
