"""The data of a model: checks, names of columns, and units of the targets."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from datetime import date, time, timedelta
from typing import Any, NamedTuple

import numpy as np
import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import check_finite, check_observed, check_transform, marked_rows

ArrayLike = Any
"""A float64 tensor, or a NumPy array, DataFrame or Series (pandas or polars) of numbers."""

_FAINT = 1e-6  # of the size of the targets: their unit where the prior mean meets them

# Types that NumPy would turn into numbers.
_DATES = (date, time, timedelta, np.datetime64, np.timedelta64)
_NO_NUMBERS: tuple[type, ...] = (str, bytes, complex, np.complexfloating, *_DATES)


class Data(NamedTuple):
    """Training data of a model, in the user's units."""

    X: Tensor  # ... x n x d
    Y: Tensor  # ... x n x m; NaN where one is missing
    Yvar: Tensor | None  # known variances of Y
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    transform: InputTransform | None = None  # of what kernels see of X; the physics sees X

    @classmethod
    def read(
        cls, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike, input_transform: Any
    ) -> Data:
        """Return checked data, detached from any graph."""
        if input_transform is not None:
            input_transform = deepcopy(input_transform).double().train()
        X = as_tensor(_coded(train_X, input_transform), "train_X")
        Y = as_tensor(train_Y, "train_Y")
        for name, tensor in (("train_X", X), ("train_Y", Y)):
            if tensor.dim() != 2:
                raise ValueError(
                    f"Expected {name} of two dimensions, points x columns; found shape "
                    f"{tuple(tensor.shape)}. One column is `{name}.reshape(-1, 1)`."
                )
        if len(X) != len(Y) or X.shape[-1] < 1 or Y.shape[-1] < 1:
            raise ValueError(
                "Expected as many rows of train_Y as of train_X, and columns of both; found shapes "
                f"{tuple(X.shape)} and {tuple(Y.shape)}."
            )
        if len(X) < 2:
            raise ValueError(f"Expected at least 2 points in train_X; found {len(X)}.")
        if not X.isfinite().all():
            check_finite("train_X", X)
        if not Y.isfinite().all():
            check_observed("train_Y", Y)
        is_seldom = (~Y.isnan()).sum(-2) < 2
        if is_seldom.any():
            columns = marked_rows(is_seldom)
            raise ValueError(f"Expected at least 2 targets of each output; leave out {columns}.")
        X, Y = (tensor.detach().clone() for tensor in (X, Y))
        Yvar = None if train_Yvar is None else variances_of(train_Yvar, Y)
        if input_transform is not None:
            input_transform(X)
            check_transform(input_transform.eval(), X)
        _warn_of_copies(X, Y)
        return cls(X, Y, Yvar, names_of(train_X, "x"), names_of(train_Y, "y"), input_transform)

    def new_inputs(self, X: ArrayLike) -> Tensor:
        """Return checked inputs ``... x q x d`` of a call."""
        names = None if isinstance(X, Tensor) else column_names(X)
        if names is not None and names != self.input_names and {*names} & {*self.input_names}:
            raise ValueError(f"Expected columns {self.input_names}, in this order; found {names}.")
        X = as_tensor(_coded(X, self.transform), "X")
        d = len(self.input_names)
        if X.dim() < 2 or X.shape[-1] != d:
            reshaped = "column is `X.reshape(-1, 1)`"
            if X.shape == (d,):
                reshaped = "point is `X.reshape(1, -1)`"
            raise ValueError(
                f"Expected X of shape ... x q x {d}, the columns {', '.join(self.input_names)}; "
                f"found {tuple(X.shape)}. One {reshaped}."
            )
        if not torch.isfinite(X.detach().sum()):  # one number is checked faster than all
            check_finite("X", X)
        return X

    def kernel_inputs(self, X: Tensor) -> Tensor:
        """Return what kernels see of inputs ``... x n x d``."""
        return X if self.transform is None else self.transform(X)

    def appended(self, X: Tensor, Y: Tensor) -> Data:
        """Return the data with further rows; Y may have more dimensions in front than X."""
        inputs = appended(self.X, X)
        lead = torch.broadcast_shapes(inputs.shape[:-2], Y.shape[:-2])
        return self._replace(X=inputs, Y=appended(self.Y, Y.expand(*lead, *Y.shape[-2:])))

    def of_outputs(self, outputs: Sequence[int]) -> Data:
        """Return the data of some outputs."""
        Yvar = None if self.Yvar is None else self.Yvar[..., outputs]
        names = tuple(self.output_names[i] for i in outputs)
        return self._replace(Y=self.Y[..., outputs], Yvar=Yvar, output_names=names)


def appended(old: Tensor, new: Tensor, dim: int = -2) -> Tensor:
    """Return two tensors one after the other; their dimensions in front broadcast."""
    lead = torch.broadcast_shapes(old.shape[:dim], new.shape[:dim])
    return torch.cat([v.expand(*lead, *v.shape[dim:]) for v in (old, new)], dim)


def unit_of(Y: Tensor, mean: Tensor) -> Tensor:
    """Return the unit of targets ``n x m`` with a prior mean: ``m x 1``.

    A good physics leaves a small unit, and a bad one does no harm. Where the prior mean meets the
    targets but for rounding the unit is a millionth of their size (or 1 if they are zero).
    """
    values = torch.stack([Y, Y - mean, Y - Y.nanmean(-2, keepdim=True)])
    largest = values.abs().nan_to_num().amax(-2, keepdim=True)
    largest = largest.where(largest > 0, torch.ones_like(largest))
    # Root mean squares of y, of y - mean, and the standard deviation of y.
    size, away, spread = largest * (values / largest).square().nanmean(-2, keepdim=True).sqrt()
    unit = torch.where(spread > 1e-12 * size, away.minimum(spread), away)
    tiny = _FAINT * size.where(size > 0, torch.full_like(size, 1 / _FAINT))
    return unit.where(unit > 1e-13 * size, tiny).mT


def as_tensor(values: ArrayLike, name: str) -> Tensor:
    """Return a float64 tensor as it is, or one of an array, frame or Series, which is a column."""
    if isinstance(values, Tensor):
        if values.is_complex():
            raise _no_numbers(name, [str(values.dtype)])
        if values.dtype != torch.float64:  # Cholesky factors of these kernels fail in float32
            kind = f"{values.dtype}; take `{name}.double()`"
            raise TypeError(f"Expected {name} in float64; found {kind}.")
        return values
    if hasattr(values, "to_frame"):  # a Series is a column
        values = values.to_frame()
    array = getattr(values, "to_numpy", lambda: values)()
    if not isinstance(array, np.ndarray):
        kind = type(values).__name__
        raise TypeError(f"Expected {name} as a tensor, an array or a frame; found {kind}.")
    if np.ma.is_masked(array):
        raise ValueError(f"Expected {name} unmasked; leave out rows or `{name}.filled(np.nan)`.")
    types = {array.dtype.type}
    if array.dtype.kind == "O":
        types = {type(value) for value in array.flat}
    wrong = [kind.__name__ for kind in types if issubclass(kind, _NO_NUMBERS)]
    if wrong:
        raise _no_numbers(name, wrong)
    try:
        return torch.as_tensor(np.array(array, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise _no_numbers(name, [str(error)]) from error


def _no_numbers(name: str, types: Sequence[str]) -> TypeError:
    return TypeError(
        f"Expected {name} to contain numbers only; found {', '.join(types)}. Convert numbers in "
        "text with `.astype(float)`, dates to seconds with `(t - t.min()) / np.timedelta64(1, "
        "'s')`; take the real part of complex numbers. Columns of text in a frame of inputs may be "
        "categories, input_transform=Categories() of gpadjust.kinds; drop other text."
    )


def variances_of(values: ArrayLike, Y: Tensor, name: str = "train_Yvar") -> Tensor:
    """Return known variances of the shape of ``Y``; their mean where there is no observation."""
    if isinstance(values, int | float | list | tuple):
        values = torch.tensor(values, dtype=torch.float64, device=Y.device)
    variances = as_tensor(values, name)
    m = Y.shape[-1]
    if variances.shape == (m, 1) != Y.shape:
        variances = variances.flatten()
    if variances.shape != Y.shape and variances.shape not in ((), (1,), (m,)):
        shapes = f"one number, {m}, or of the shape {tuple(Y.shape)} of the data"
        raise ValueError(f"Expected {name} as {shapes}; found {tuple(variances.shape)}.")
    variances = variances.expand(Y.shape).masked_fill(Y.isnan(), torch.nan)
    variances = variances.where(~Y.isnan(), variances.nanmean(-2, keepdim=True))
    check_finite(name, variances)
    if (variances < 0).any():
        raise ValueError(f"Expected variances in {name}; found {variances.min():.3g}.")
    return variances


def _coded(X: ArrayLike, transform: Any) -> ArrayLike:
    """Return inputs with numbers in place of what a transform makes numbers of."""
    if hasattr(transform, "coded"):
        return transform.coded(X)
    return X


def names_of(values: ArrayLike, letter: str) -> tuple[str, ...]:
    """Return the names of columns, ``x`` or ``x1`` and so on if they have none."""
    if not isinstance(values, Tensor) and (names := column_names(values)) is not None:
        return names
    shape = [*getattr(values, "shape", ())]
    if len(shape) < 2 or shape[-1] == 1:
        return (letter,)
    return tuple(f"{letter}{i + 1}" for i in range(int(shape[-1])))


def column_names(values: ArrayLike) -> tuple[str, ...] | None:
    """Return the names of a frame's columns or of a Series, or None."""
    if hasattr(values, "columns"):
        return tuple(map(str, values.columns))
    if isinstance(values, Tensor) or getattr(values, "name", None) is None:
        return None
    return (str(values.name),)


def as_given(values: Tensor, X: ArrayLike, names: Sequence[str]) -> Any:
    """Return values ``... x q x m`` as X came: a tensor, an array, or a frame with these names."""
    if isinstance(X, Tensor):
        return values
    if hasattr(X, "to_frame"):  # a Series
        X = X.to_frame()
    array = values.detach().cpu().numpy()
    library = type(X).__module__.partition(".")[0]
    if library == "pandas":
        return type(X)(array, index=X.index, columns=list(names))
    if library == "polars":
        return type(X)(array, schema=list(names))
    return array


def _warn_of_copies(X: Tensor, Y: Tensor) -> None:
    missing = Y.isnan()
    rows = torch.cat([X, Y.masked_fill(missing, 0.0), missing.to(X)], dim=-1)
    copies = len(rows) - len(rows.unique(dim=0))
    if copies:
        warnings.warn(
            f"{copies} of {len(rows)} rows equal an earlier row in all inputs and outputs. If they "
            "are the same measurements, drop them, `frame.drop_duplicates()`: the noise would be "
            "too small. Repeats that are equal by rounding may stay.",
            stacklevel=4,
        )
