"""Checks of the numbers, shapes and options that a user gives, and seeds, for all rooms.

``check_...`` returns nothing, ``checked_...`` the value in its final form. The name of the argument
comes first. A wrong kind is a TypeError, a wrong value or shape a ValueError; both
name the value and the expected one.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from numbers import Real
from operator import index
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor


def checked_whole(name: str, value: Any, least: int | None = None) -> int:
    """Return a whole number, of at least ``least``, as an int; not True or False."""
    try:
        number = None if isinstance(value, bool) else index(value)
    except TypeError:
        number = None
    if number is None:
        raise TypeError(f"{name} must be a whole number; found {value!r}.")
    if least is not None and number < least:
        raise ValueError(f"{name} must be at least {least}; found {number}.")
    return number


def checked_number(
    name: str, value: Any, *, least: float | None = None, above: float | None = None,
    most: float | None = None, below: float | None = None,
) -> float:  # fmt: skip
    """Return a finite real number as a float.

    Args:
        name: The argument's name.
        value: Its value.
        least: The least value that is allowed.
        above: A value that it must exceed.
        most: The largest value that is allowed.
        below: A value that it must not reach.

    Example:
        >>> checked_number("discount", 1.5, above=0, most=1)
        Traceback (most recent call last):
        ...
        ValueError: discount must be above 0 and at most 1; found 1.5.
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number; found {value!r}.")
    number = float(value)
    is_right = (
        math.isfinite(number)
        and (least is None or number >= least)
        and (above is None or number > above)
        and (most is None or number <= most)
        and (below is None or number < below)
    )
    if not is_right:
        limits = {"at least": least, "above": above, "at most": most, "below": below}
        words = [f"{word} {limit:g}" for word, limit in limits.items() if limit is not None]
        if most is None and below is None:
            words.insert(0, "finite")
        raise ValueError(f"{name} must be {' and '.join(words)}; found {value}.")
    return number


def check_level(level: float) -> None:
    """Raise an error unless a level, such as 0.95, is a number between 0 and 1."""
    if isinstance(level, bool) or not isinstance(level, int | float | Real):
        raise TypeError(f"level must be a number such as 0.95; found {level!r}.")
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1; found {level}; 95 % is 0.95.")


def checked_half_width(level: float) -> float:
    """Return half the width of a central interval of a level, in standard deviations."""
    check_level(level)
    return NormalDist().inv_cdf((1 + level) / 2)


def check_switch(name: str, value: Any) -> None:
    """Raise a TypeError unless an option is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False; found {value!r}.")


def check_kind(name: str, value: Any, kind: Any, expected: str) -> None:
    """Raise a TypeError unless an option is an object of a class, ``expected`` in words."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {expected}; found {value!r}.")


def check_choice(name: str, value: Any, known: Sequence[Any]) -> None:
    """Raise a ValueError unless an option is one of these words."""
    if value not in known:
        raise ValueError(f"Unknown {name} {value!r}; use {' or '.join(map(repr, known))}.")


def checked_options(name: str, options: Any, known: Sequence[str]) -> dict[str, Any]:
    """Return options by name, a dictionary of known ones, empty for None."""
    options = {} if options is None else options
    names = ", ".join(map(repr, known))
    if not isinstance(options, dict):
        raise TypeError(f"{name} must be a dictionary, which may hold {names}; found {options!r}.")
    for option in options:
        if option not in known:
            raise ValueError(
                f"Unknown {name.removesuffix('s')} {option!r}; the known ones: {names}."
            )
    return options


def real_array(values: ArrayLike) -> NDArray[np.float64]:
    """Return a copy of real numbers as a float64 array; raise a TypeError for anything else."""
    # NumPy would drop imaginary parts, and convert None to NaN and text to numbers.
    if np.ma.is_masked(values):
        raise TypeError("expected real numbers, found masked values")
    array = np.array(values)
    kind = array.dtype.kind
    if kind == "O" and None in array.ravel().tolist():  # others may be numbers, such as fractions
        raise TypeError("expected real numbers, found None")
    if kind not in "biufO":
        raise TypeError(f"expected real numbers, found {array.dtype}")
    return array.astype(np.float64, copy=False)


def finite_array(values: Any, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Return a copy of finite real numbers of a shape; None for anything else."""
    try:
        numbers = real_array(values)
    except (TypeError, ValueError):
        return None
    return numbers if numbers.shape == shape and np.isfinite(numbers).all() else None


def checked_tensor(name: str, values: Any) -> Tensor:
    """Return a copy of real numbers as a float64 tensor."""
    try:
        if not isinstance(values, Tensor):
            return torch.from_numpy(real_array(values))
        if not values.is_complex():
            return values.detach().to("cpu", torch.float64, copy=True)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise TypeError(f"Expected {name} to be real numbers, got {values!r}.") from error
    raise TypeError(f"Expected {name} to be real numbers, got {values.dtype}.")


def checked_bounds(
    name: str, bounds: Any, columns: int | None = None, *, finite: bool = True
) -> Tensor:
    """Return bounds ``2 x d``, lower ones and then upper ones, in float64.

    ``d`` is ``columns``, or at least 1; each lower one is below its upper one.
    """
    bounds = checked_tensor(name, bounds)
    is_right = bounds.dim() == 2 and len(bounds) == 2 and bounds.shape[1] > 0
    if not is_right or columns not in (None, bounds.shape[1]):
        raise ValueError(
            f"Expected {name} of shape 2 x {'d' if columns is None else columns}, the lower ones "
            f"and then the upper ones, got {tuple(bounds.shape)}."
        )
    if (finite and not bounds.isfinite().all()) or not (bounds[0] < bounds[1]).all():
        expected = f"finite {name}" if finite else name
        raise ValueError(
            f"Expected {expected}, each lower one below its upper one, got {bounds.tolist()}."
        )
    return bounds


def checked_points(name: str, X: Any, columns: int, bounds: Tensor | None = None) -> Tensor:
    """Return finite points ``n x columns`` in float64, within bounds ``2 x columns`` if any."""
    X = checked_tensor(name, X)
    if X.dim() != 2 or X.shape[-1] != columns:
        raise ValueError(
            f"Expected {name} of shape n x {columns}, a row for each point, got {tuple(X.shape)}."
        )
    if not X.isfinite().all():
        raise ValueError(f"Expected {name} to be finite, got {X.tolist()}.")
    outside = X[:0] if bounds is None else X[(X.clamp(bounds[0], bounds[1]) != X).any(-1)]
    if bounds is not None and len(outside):
        raise ValueError(
            f"Expected {name} within the bounds {bounds.tolist()}, got {outside[0].tolist()}."
        )
    return X


def checked_columns(name: str, asked: Any, names: Sequence[str]) -> list[int]:
    """Return the numbers of columns that are asked for, one or several, by name or number."""
    numbers: dict[Any, int] = {column: i for i, column in enumerate(names)}
    numbers |= {i: i % len(names) for i in range(-len(names), len(names))}
    several = [asked] if isinstance(asked, str | int) else [*asked]
    unknown = [column for column in several if column not in numbers]
    if unknown:
        expected = f"{name} by names or numbers of the inputs {', '.join(names)}"
        raise ValueError(f"Expected {expected}; found {unknown[0]!r}.")
    return [numbers[column] for column in several]


def check_columns(name: str, tensor: Tensor, columns: int, more: bool = False) -> None:
    """Raise an error unless a tensor is floating-point and ``... x columns`` (or ``more``)."""
    if not torch.is_tensor(tensor) or not tensor.is_floating_point():
        kind = tensor.dtype if torch.is_tensor(tensor) else type(tensor).__name__
        raise TypeError(
            f"Expected {name} as a floating-point tensor, got {kind}; convert with "
            f"`torch.as_tensor({name}, dtype=torch.float64)`."
        )
    width = tensor.shape[-1] if tensor.dim() else 0
    if width < columns or (width > columns and not more):
        least = " or more" if more else ""
        raise ValueError(
            f"Expected {name} of shape ... x {columns}{least}, got {tuple(tensor.shape)}."
        )


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise a ValueError that names the rows of ``tensor`` (``... x n x k``) with NaN or inf."""
    _check_rows(name, ~tensor.isfinite().all(-1), "to be finite, found NaN or infinity")


def check_observed(name: str, Y: Tensor) -> None:
    """Check that values are finite or missing (NaN); a row of NaN alone is an error."""
    _check_rows(name, Y.isinf().any(-1), "to be finite, found infinity")
    expected = "to hold an observation in each row, found nothing but NaN"
    _check_rows(name, Y.isnan().all(-1), expected)


def check_transform(transform: Any, X: Tensor) -> None:
    """Raise a ValueError if a transform of inputs ``n x d`` learns, or has other rows than they."""
    name = type(transform).__name__
    if any(parameter.requires_grad for parameter in transform.parameters()):
        raise ValueError(
            f"The parameters of a transform are not learnt; {name} has some. Set their values, and "
            "fix them by `transform.requires_grad_(False)`."
        )
    found = tuple(transform(X).shape)
    if found[:-1] != X.shape[:-1]:
        raise ValueError(
            f"Expected an input_transform that makes one row of each row; {name} makes shape "
            f"{found} of {tuple(X.shape)}."
        )


def _check_rows(name: str, is_wrong: Tensor, expected: str) -> None:
    if is_wrong.any():
        rows = marked_rows(is_wrong)
        first = ", ".join(map(str, rows[:5]))
        if len(rows) > 5:
            first += ", ..."
        rows_of = f"{len(rows)} of {is_wrong.shape[-1]} rows (row {first})"
        raise ValueError(f"Expected {name} {expected} in {rows_of}; remove these points.")


def marked_rows(marked: Tensor) -> list[int]:
    """Return the positions in the last dimension at which any entry is marked."""
    return marked.nonzero()[:, -1].unique().tolist()


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw from PyTorch's generator of the CPU, from a copy of it if there is a seed."""
    with nullcontext() if seed is None else torch.random.fork_rng(devices=[]):
        if seed is not None:
            torch.default_generator.manual_seed(seed)  # the generators of GPUs are not copied
        yield


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line of the user: that of the first frame outside of the package."""
    folder = str(Path(__file__).parent)
    level = 1  # this function
    frame = inspect.currentframe()
    while frame is not None and frame.f_code.co_filename.startswith(folder):
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)
