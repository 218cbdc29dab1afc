"""The data that a model is built on: what is taken and checked, and the units they are put in."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from datetime import date, time, timedelta
from typing import Any, NamedTuple

import numpy as np
import torch
from botorch.models.transforms.outcome import Standardize
from torch import Tensor

from gpadjust.checks import check_finite, check_observed, marked_rows
from gpadjust.models.levels import (
    Levels,
    coded,
    declared,
    levels_of,
    several,
    texts_of,
)

ArrayLike = Any
"""A float64 tensor, or a NumPy array or pandas DataFrame of numbers."""

# What NumPy would turn into numbers: its kinds of arrays, types of objects, and the way out.
_NO_NUMBERS: dict[str, tuple[str, tuple[type, ...], str]] = {
    "text": (
        "SU",
        (str, bytes),
        "convert numbers in text with `.astype(float)`, drop other text that is no category of "
        "inputs in a DataFrame (`categorical=` names one)",
    ),
    "complex numbers": ("c", (complex, np.complexfloating), "give both parts, or take `.real`"),
    "dates or times": (
        "mM",
        (date, time, timedelta, np.datetime64, np.timedelta64),
        "convert them to seconds since the first with `(t - t.min()) / np.timedelta64(1, 's')`",
    ),
}


class TrainingData(NamedTuple):
    """Inputs, targets and observation variances of a model.

    Attributes:
        X: ``batch_shape x n x d``.
        Y: ``batch_shape x n x m``; NaN where an output was not observed.
        Yvar: Known observation variances of the shape of ``Y``, or None.
        input_names: The names of the columns of ``X``.
        output_names: Those of ``Y``.
        levels: The levels of categorical columns of ``X``, by their numbers, and which of these
            are ``batches``.
    """

    X: Tensor
    Y: Tensor
    Yvar: Tensor | None
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    levels: Levels = {}  # noqa: RUF012
    batches: Sequence[int] = ()


def training_data(
    train_X: ArrayLike,
    train_Y: ArrayLike,
    train_Yvar: ArrayLike = None,
    prefix: str = "train",
    categorical: Any = None,
    batch: Any = None,
) -> TrainingData:
    """Bring the data of a model into the form of tensors, and check them.

    Args:
        train_X: Expected ``batch_shape x n x d``, ``n >= 2``, finite.
        train_Y: Expected ``batch_shape x n x m``; NaN where an output was not observed, but not in
            a whole row.
        train_Yvar: Expected of the shape of ``train_Y``, or one number, or one for each output;
            not negative; or None.
        prefix: What the names of the three begin with in errors.
        categorical: As in :class:`~gpadjust.CKA`.
        batch: Likewise.

    Raises:
        TypeError: If one of them is neither a float64 tensor nor an array or frame of numbers.
        ValueError: If shapes disagree, there are fewer than 2 points, or values are not finite.
    """
    name_X, name_Y = f"{prefix}_X", f"{prefix}_Y"
    levels: Levels = {}
    if hasattr(train_X, "iloc") or isinstance(categorical, Mapping):
        own = column_names(train_X) or default_names("x", train_X.shape[-1])
        named = [*several(categorical), *several(batch)]
        levels = {**texts_of(train_X, named), **declared(categorical, own)}
        train_X = coded(train_X, levels)
    X, Y = to_tensor(train_X, name_X), to_tensor(train_Y, name_Y)
    for name, tensor in ((name_X, X), (name_Y, Y)):
        if tensor.dim() < 2:
            raise ValueError(
                f"Expected {name} with at least 2 dimensions (points x columns), got shape "
                f"{tuple(tensor.shape)}; add a column with `{name}.reshape(-1, 1)`."
            )
    shapes = f"got {name_X} of shape {tuple(X.shape)} and {name_Y} of shape {tuple(Y.shape)}."
    if X.shape[:-1] != Y.shape[:-1]:
        raise ValueError(f"Expected inputs and targets to agree in all but the last size, {shapes}")
    if X.shape[-1] < 1 or Y.shape[-1] < 1:
        raise ValueError(f"Expected at least one input column and one output column, {shapes}")
    if X.shape[-2] < 2:
        raise ValueError(
            f"Expected at least 2 points in {name_X}, got {X.shape[-2]}: with fewer there is "
            "nothing to learn a scale from. Use the physics alone until there are two."
        )
    check_finite(name_X, X)
    check_observed(name_Y, Y)
    seldom = (~Y.isnan()).sum(-2) < 2
    if seldom.any():
        raise ValueError(
            f"Expected at least 2 observations of each output, but {name_Y} has fewer in "
            f"column(s) {marked_rows(seldom)}; leave these out."
        )
    Yvar = None if train_Yvar is None else _variances(train_Yvar, Y, f"{prefix}_Yvar")
    names = own if levels else column_names(train_X) or default_names("x", X.shape[-1])
    outputs = column_names(train_Y) or default_names("y", Y.shape[-1])
    batches: Sequence[int] = ()
    if levels or categorical is not None or batch is not None:
        levels, batches = levels_of(categorical, batch, X, names, levels)
    return TrainingData(X, Y, Yvar, names, outputs, levels, batches)


def new_observations(
    X: ArrayLike,
    Y: ArrayLike,
    input_names: tuple[str, ...],
    num_outputs: int,
    levels: Levels | None = None,
    batches: Sequence[int] = (),
) -> tuple[Tensor, Tensor]:
    """Further observations of a model as tensors ``... x k x d`` and ``... x k x m``, checked."""
    check_order(X, input_names)
    X = coded(X, levels, batches) if levels else X
    X, Y = to_tensor(X, "X"), to_tensor(Y, "Y")
    check_finite("X", X)
    rows = X.dim() > 1 and Y.dim() > 1 and X.shape[-2] == Y.shape[-2]
    if not rows or Y.shape[-1] != num_outputs:
        raise ValueError(
            f"Expected X of shape ... x k x {len(input_names)} and Y of shape ... x k x "
            f"{num_outputs}, with a row for each point, got {tuple(X.shape)} and {tuple(Y.shape)}."
        )
    check_observed("Y", Y)
    return X, Y


def to_tensor(values: ArrayLike, name: str) -> Tensor:
    """Take a float64 tensor as it is, and make one of a NumPy array or a DataFrame.

    A TypeError for anything else, also for what NumPy would turn into numbers: text, complex
    numbers, dates or times. A ValueError if values are masked.
    """
    if isinstance(values, Tensor):
        if values.is_complex():
            raise TypeError(_not_numbers(name, "complex numbers"))
        if values.dtype != torch.float64:
            raise TypeError(
                f"Expected {name} in float64, got {values.dtype}: Cholesky factors of these "
                f"kernels fail in lower precision. Convert it with `{name}.double()`."
            )
        return values
    array = values.to_numpy() if hasattr(values, "to_numpy") else values
    if not isinstance(array, np.ndarray):
        raise TypeError(
            f"Expected {name} to be a torch tensor, a NumPy array or a DataFrame, got "
            f"{type(values).__name__}; convert it with `torch.tensor({name}, dtype=torch.float64)`."
        )
    check_array(array, name)
    try:
        return torch.as_tensor(np.array(array, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"Expected {name} to hold numbers only, but {error}. Select the numeric columns, and "
            "encode or drop the others."
        ) from error


def check_array(array: Any, name: str, what: Sequence[str] = tuple(_NO_NUMBERS)) -> None:
    """Raise an error if an array has masked values, or what NumPy would turn into numbers."""
    if np.ma.is_masked(array):
        raise ValueError(
            f"Expected {name} without masked values, found {np.ma.count_masked(array)}. Leave "
            f"their rows out, or make them NaN by `{name}.filled(np.nan)`, if they are targets."
        )
    found = {type(value) for value in array.flat} if array.dtype.kind == "O" else set()
    for each in what:
        kinds, types, _ = _NO_NUMBERS[each]
        if array.dtype.kind in kinds or any(issubclass(kind, types) for kind in found):
            raise TypeError(_not_numbers(name, each))


def _not_numbers(name: str, found: str) -> str:
    return f"Expected {name} to hold numbers only, found {found}: {_NO_NUMBERS[found][2]}."


def column_names(values: ArrayLike) -> tuple[str, ...] | None:
    """The names of a DataFrame's (or Series') columns, or None."""
    columns = getattr(values, "columns", None)
    if columns is not None:
        return tuple(map(str, columns))
    name = getattr(values, "name", None)
    return None if name is None or isinstance(values, Tensor) else (str(name),)


def with_names(X: Tensor, names: Sequence[str]) -> Tensor:
    """A tensor with names of its columns, which :func:`column_names` finds as those of a frame."""
    named = X.view_as(X)
    named.columns = names  # type: ignore[attr-defined]
    return named


def as_given(values: Tensor, X: ArrayLike, names: Sequence[str]) -> Any:
    """Values ``... x q x m`` as X came: a tensor, an array, or a frame of pandas or polars.

    A frame has these names of columns, and pandas' the index of X.
    """
    if isinstance(X, Tensor):
        return values
    array, library = values.detach().cpu().numpy(), type(X).__module__.partition(".")[0]
    if library == "pandas":
        return type(X)(array, index=X.index, columns=list(names))
    return type(X)(array, schema=list(names)) if library == "polars" else array


def check_order(values: ArrayLike, names: tuple[str, ...]) -> None:
    """Raise a ValueError if a frame has columns of these names in another order."""
    found = column_names(values)
    if found is not None and found != names and sorted(found) == sorted(names):
        raise ValueError(f"Expected the columns {names}, in this order, got {found}.")


def default_names(letter: str, number: int) -> tuple[str, ...]:
    """``x``, or ``x1`` and so on."""
    return (letter,) if number == 1 else tuple(f"{letter}{i + 1}" for i in range(number))


def warn_of_copies(data: TrainingData, stacklevel: int) -> None:
    """Warn of rows that equal an earlier one in all inputs and outputs; not of a batch."""
    if data.X.dim() > 2:
        return
    is_missing = data.Y.isnan()
    rows = torch.cat([data.X, data.Y.masked_fill(is_missing, 0.0), is_missing.to(data.X)], dim=-1)
    n, distinct = len(rows), len(rows.unique(dim=0))
    if distinct < n:
        warnings.warn(
            f"{n - distinct} of {n} rows equal an earlier row in all inputs and outputs. If the "
            "same measurements stand in the data twice, as of files joined twice, the noise comes "
            "out too small: drop them, `frame.drop_duplicates()`. Repeats that are equal by "
            "rounding may stay.",
            stacklevel=stacklevel + 1,
        )


def check_noise(noise: object, Y: Tensor) -> None:
    """Raise an error unless ``noise`` holds variances of the new observations ``Y``."""
    expected = f"Expected noise as a float64 tensor of variances of Y's shape {tuple(Y.shape)}, got"
    way = "of one variance, `torch.full_like(Y, variance)`"
    if not isinstance(noise, Tensor) or noise.dtype != torch.float64:
        found = f"a tensor in {noise.dtype}" if isinstance(noise, Tensor) else repr(noise)
        raise TypeError(f"{expected} {found}; {way}.")
    if noise.shape[-2:] != Y.shape[-2:]:
        raise ValueError(f"{expected} shape {tuple(noise.shape)}; {way}.")
    if (~(noise.isfinite() & (noise >= 0)) & ~Y.isnan()).any():
        raise ValueError("Expected noise (variances) to be finite and not negative.")


def _variances(values: ArrayLike | Sequence[float], Y: Tensor, name: str) -> Tensor:
    """Known variances of the shape of ``Y``; their mean where there is no observation."""
    if isinstance(values, int | float | list | tuple):
        values = torch.tensor(values, dtype=torch.float64, device=Y.device)
    given = to_tensor(values, name)
    if given.shape != Y.shape and given.shape not in ((), (1,), Y.shape[-1:]):
        raise ValueError(
            f"Expected {name} (known variances) as one number, {Y.shape[-1]} numbers (one for each "
            f"output), or of the targets' shape {tuple(Y.shape)}, got {tuple(given.shape)}."
        )
    variances = given.expand(Y.shape).masked_fill(Y.isnan(), torch.nan)
    variances = variances.where(~Y.isnan(), variances.nanmean(-2, keepdim=True))
    check_finite(name, variances)
    if (variances < 0).any():
        raise ValueError(
            f"Expected {name} (variances) not to be negative, got {variances.min():.3g}."
        )
    return variances


def standardize(means: Tensor, stdvs: Tensor) -> Standardize:
    """BoTorch's transform with given ``batch_shape x 1 x m`` shifts and (positive) scales."""
    transform = Standardize(m=means.shape[-1], batch_shape=means.shape[:-2])
    transform.means, transform.stdvs, transform._stdvs_sq = means, stdvs, stdvs.square()
    transform._is_trained = torch.tensor(True)
    return transform.eval()


def residual_scale(Y: Tensor, mean: Tensor) -> Standardize:
    r"""The default outcome transform: divide by the root mean square of ``Y - mean``.

    A good physics then does not push the noise under the likelihood's floor, and without a shift
    :math:`\rho` keeps its meaning. Where the prior mean meets the targets but for rounding, the
    scale is a millionth of theirs (or 1 if they are zero).
    """

    def rms(values: Tensor) -> Tensor:
        return values.square().nanmean(-2, keepdim=True).sqrt()

    scale, size = rms(Y - mean), rms(Y)
    tiny = 1e-6 * size.where(size > 0, torch.full_like(size, 1e6))
    return standardize(torch.zeros_like(scale), scale.where(scale > 1e-13 * size, tiny))


def estimated(transform: Any, Y: Tensor, X: Tensor) -> Standardize | None:
    """The user's outcome transform with shift and scale estimated from the targets."""
    if transform is None:
        return None
    if type(transform) is not Standardize:
        is_plain = isinstance(transform, str | tuple | list)
        name = repr(transform) if is_plain else type(transform).__name__
        raise ValueError(
            f"The outcome transform {name} is not supported: it must be one shift and scale "
            "per output, Standardize, or None, or the default; or, but for AR1, a link, through "
            "which the physics goes: 'log' for positive outputs, 'logit' for shares, a pair of "
            "bounds."
        )
    transform.train()
    try:
        transform(Y, X=X)
    except RuntimeError as error:
        raise ValueError(
            f"The outcome transform does not fit train_Y of shape {tuple(Y.shape)}: {error}"
        ) from error
    return transform.eval()
