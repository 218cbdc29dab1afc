"""Checks of what a collection is told."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.physics.row_calls import real_array


def as_numbers(values: Any, name: str) -> Tensor:
    """Return a copy of real numbers as a tensor, float64.

    Raises:
        TypeError: If they are anything else.
    """
    try:
        if not isinstance(values, Tensor):
            return torch.from_numpy(real_array(values))
        if not values.is_complex():
            return values.detach().to("cpu", torch.float64, copy=True)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise TypeError(f"Expected {name} to be real numbers, got {values!r}.") from error
    raise TypeError(f"Expected {name} to be real numbers, got {values.dtype}.")


def as_bounds(bounds: Any) -> Tensor:
    """Return bounds as ``2 x d``, float64.

    Raises:
        TypeError: If they are no numbers.
        ValueError: If they are not finite, lower below upper.
    """
    bounds = as_numbers(bounds, "bounds")
    if bounds.dim() != 2 or len(bounds) != 2 or not bounds.shape[1]:
        raise ValueError(
            "Expected bounds of shape 2 x d, the lower ones and then the upper ones, got "
            f"{tuple(bounds.shape)}."
        )
    if not bounds.isfinite().all() or (bounds[0] >= bounds[1]).any():
        raise ValueError(
            f"Expected finite bounds, each lower one below its upper one, got {bounds.tolist()}."
        )
    return bounds


def as_points(X: Any, num_inputs: int, name: str = "X") -> Tensor:
    """Return points as ``n x d``, float64.

    Raises:
        TypeError: If they are no numbers.
        ValueError: If they have another number of columns, or are not finite.
    """
    X = as_numbers(X, name)
    if X.dim() != 2 or X.shape[-1] != num_inputs:
        raise ValueError(
            f"Expected {name} of shape n x {num_inputs}, a row for each point, got "
            f"{tuple(X.shape)}."
        )
    if not X.isfinite().all():
        raise ValueError(f"Expected {name} to be finite, got {X.tolist()}.")
    return X


def as_points_within(X: Any, bounds: Tensor, name: str) -> Tensor:
    """Return points within bounds ``2 x d`` as ``n x d``, float64.

    Raises:
        TypeError: As :func:`as_points`.
        ValueError: As :func:`as_points`, or if one is out of bounds.
    """
    X = as_points(X, bounds.shape[-1], name)
    outside = (X.clamp(bounds[0], bounds[1]) != X).any(-1)
    if outside.any():
        raise ValueError(
            f"Expected {name} within the bounds {bounds.tolist()}, got {X[outside][0].tolist()}."
        )
    return X


def as_outcomes(Y: Any, num_points: int, num_outputs: int | None) -> Tensor:
    """Return measured values as ``n x m``, float64; they may be NaN or infinite.

    Args:
        Y: The values, ``n x m`` or ``n``; one number for one point will do.
        num_points: Number ``n`` of points.
        num_outputs: Number ``m`` of outputs, if it is known.

    Raises:
        TypeError: If they are no numbers.
        ValueError: If they have another shape.
    """
    Y = as_numbers(Y, "measured values")
    columns = Y.reshape(-1, 1) if Y.dim() < 2 else Y
    right = columns.dim() == 2 and len(columns) == num_points and columns.shape[-1] > 0
    if not right or num_outputs not in (None, columns.shape[-1]):
        m = "m" if num_outputs is None else num_outputs
        raise ValueError(
            f"Expected measured values of shape {num_points} x {m}, a row for each point, got "
            f"{tuple(Y.shape)}."
        )
    return columns


def as_options(options: Any) -> dict[str, Any]:
    """Return options of ``optimize_acqf``; none for None.

    Raises:
        TypeError: If they are no dictionary.
        ValueError: If one of them is not for a user to give.
    """
    options = {} if options is None else options
    if not isinstance(options, dict):
        raise TypeError(f"Expected optimizer_options to be a dictionary, got {options!r}.")
    own = {"acq_function", "bounds", "q", "return_best_only", "return_full_tree"} & set(options)
    if own:
        raise ValueError(f"Expected optimizer_options without {sorted(own)}: these are set here.")
    return options
