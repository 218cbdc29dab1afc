"""Categories among the inputs, such as a material, and batches, each with an offset."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from typing import Any
from zlib import crc32

import numpy as np
import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import checked_columns
from gpadjust.core.data import ArrayLike, Data, names_of
from gpadjust.core.fourier import Fourier
from gpadjust.core.kernels import DELTA, Features, Kernel, PullBack, Stationary
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Row, Values

Levels = dict[int, tuple[str | float, ...]]

_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")
_IDS = 0.5  # levels per row, above which texts are names of rows, not categories


class Categories(InputTransform):
    r"""Columns of categories, whose levels are exchangeable, and of batches, which have offsets.

    A :class:`~gpadjust.core.Stationary` kernel of a model has one lengthscale for each category c,
    whose levels are all at the same distance,
    :math:`r^2 = \sum_k (x_k - x'_k)^2 / \ell_k^2 + \sum_c 1\{c \neq c'\} / \ell_c^2`. It does not
    depend on batches, such as rigs or days. Each column of batches adds a term of its name:
    independent offsets with one unknown variance, also for a new batch. Other kernels use the
    numbers of the levels; ``active_dims`` of GPyTorch excludes columns.

    Texts of a frame become the numbers 0, 1, ... of their sorted levels, as tensors and the physics
    have them. BoTorch's optimisation needs ``fixed_features`` for the columns.

    Args:
        columns: Names or numbers of columns of categories. Default: all columns of texts or of
            pandas' categories, except numbers in text and texts that differ in most rows.
        batches: Names or numbers of columns of batches.
        levels: Levels by column, in the order of their numbers. Default: the levels in the data.

    Raises:
        ValueError: If a column does not exist, all are batches, or later a level is unknown.

    Example:
        >>> import torch
        >>> from gpadjust.core import CKA
        >>> from gpadjust.kinds.categories import Categories, levels_of
        >>> X = torch.cat([torch.rand(9, 1), torch.arange(9).reshape(9, 1) % 3], -1).double()
        >>> kinds = Categories([1])
        >>> model = CKA(X, X.sum(-1, True), physics=lambda X: X[:, 0], input_transform=kinds)
        >>> levels_of(model)
        {1: (0.0, 1.0, 2.0)}
    """

    transform_on_train = transform_on_eval = transform_on_fantasize = True

    def __init__(
        self, columns: Any = None, batches: Any = (), levels: Mapping[Any, Any] | None = None
    ) -> None:
        super().__init__()
        self.asked = {"columns": columns, "batches": batches, "levels": levels or {}}
        self.names: tuple[str, ...] = ()
        self.levels: Levels = {}  # by the numbers of the columns
        self.batches: list[int] = []

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments; after a model is built, with its columns and levels."""
        if not self.names:
            return self.asked
        names = {i: self.names[i] for i in self.levels}
        return {
            "columns": [name for i, name in names.items() if i not in self.batches],
            "batches": [names[i] for i in self.batches],
            "levels": {name: [*self.levels[i]] for i, name in names.items()},
        }

    def coded(self, X: ArrayLike) -> ArrayLike:
        """Return inputs with the numbers of levels in place of texts."""
        if self.training:
            self._read_levels(X)
        texts = [i for i, levels in self.levels.items() if levels and isinstance(levels[0], str)]
        if not texts or not hasattr(X, "columns") or X.shape[-1] != len(self.names):
            return X
        array = np.array(X.to_numpy(), dtype=object)
        for i in texts:
            levels = self.levels[i]
            column = array[:, i].tolist()
            new = [v for v in dict.fromkeys(column) if isinstance(v, str) and v not in levels]
            if new and i not in self.batches:
                raise self._unknown(i, new[0])
            numbers: dict[Any, float] = dict(zip(levels, numbers_of(levels), strict=True))
            # A hash gives a new batch the same number in each call.
            numbers |= {text: -1.0 - crc32(text.encode()) for text in new}
            array[:, i] = [numbers.get(v, v) for v in column]
        return array

    def transform(self, X: Tensor) -> Tensor:
        """Return the inputs; check their levels or, when a model is built, read them."""
        for i, levels in self.levels.items():
            if not levels:
                self.levels[i] = tuple(X[..., i].unique().tolist())
            elif i not in self.batches:
                unknown = (X[..., i].unsqueeze(-1) != X.new_tensor(numbers_of(levels))).all(-1)
                if unknown.any():
                    raise self._unknown(i, X[..., i][unknown][0].item())
        return X

    def terms(self, terms: Sequence[Term]) -> list[Term]:
        """Return terms with kernels of exchangeable levels, and a term for each batch column."""
        names = {i: name for i, name in enumerate(self.names) if i not in self.batches}
        if not names:
            raise ValueError(f"Expected an input in addition to batches; found {self.names}.")
        levels = {i: numbers_of(self.levels[i]) for i in names if i in self.levels}
        new = []
        for term in terms:
            kernel = term.kernel
            if isinstance(kernel, Stationary) and self.levels:
                kernel = Exchangeable(kernel, names, levels)
            new.append(term._replace(kernel=kernel))
        return new + [Term(self.names[i], Offset(i)) for i in self.batches]

    def _read_levels(self, X: ArrayLike) -> None:
        """Set columns and levels of texts; `transform` reads levels that are numbers."""
        self.names = names_of(X, "x")
        columns, self.batches, listed = (
            checked_columns(name, () if value is None else value, self.names)
            for name, value in self.asked.items()
        )
        levels = levels_of_texts(X, [*columns, *self.batches])
        if self.asked["columns"] is None:
            columns = [*levels]
        levels |= zip(listed, map(tuple, self.asked["levels"].values()), strict=True)
        self.levels = {i: levels.get(i, ()) for i in sorted({*columns, *self.batches, *listed})}
        for i, column in self.levels.items():
            if len({*column}) < len(column) or len({isinstance(v, str) for v in column}) > 1:
                raise ValueError(f"Expected different levels of {self.names[i]}; found {column}.")

    def _unknown(self, i: int, value: str | float) -> ValueError:
        """Return the error of an unknown level."""
        levels: Sequence[str | float] = self.levels[i]
        if not isinstance(value, str):
            levels = numbers_of(levels)
        return ValueError(
            f"Expected {self.names[i]} to be one of {', '.join(map(str, levels))}; found {value}. "
            "List a new level when the model is built, levels={column: levels}, or take the column "
            "as batches=[...]; BoTorch's optimisation needs fixed_features for the column."
        )


class Exchangeable(Kernel):
    r"""A stationary kernel of some columns, in which two levels of a category have the distance 1.

    The kernel reads :math:`1 / \sqrt 2` or 0 for each level; these columns share a lengthscale.
    """

    def __init__(
        self, kernel: Stationary, columns: Mapping[int, str], levels: Mapping[int, list[float]]
    ) -> None:
        self.kernel = kernel
        self.columns = [*columns]
        self.levels = levels
        self.input_names = [*columns.values()]
        sizes = torch.tensor([len(levels.get(i, [0.0])) for i in columns])
        self.groups = torch.arange(len(columns)).repeat_interleave(sizes)
        if isinstance(kernel, Fourier):  # each level needs its own frequencies
            self.kernel = copy(kernel)
            w = kernel.frequencies[self.columns][self.groups]
            fresh = torch.randn(w.shape, generator=torch.Generator().manual_seed(len(w))).to(w)
            self.kernel.frequencies = fresh.where((sizes > 1)[self.groups].unsqueeze(-1), w)

    def inputs(self, x: Tensor) -> Tensor:
        """Return the numeric columns, and a column for each level."""
        parts = [x[..., [i]] for i in self.columns]
        for k, i in enumerate(self.columns):
            if i in self.levels:  # two different levels differ in two columns, by 1 / sqrt(2) each
                parts[k] = (parts[k] == x.new_tensor(self.levels[i])).to(x) / math.sqrt(2)
        return torch.cat(parts, -1)

    def numbers(self, own: Values) -> Values:
        """Return the parameters with a lengthscale for each column and level."""
        return own | {"lengthscale": own["lengthscale"][..., self.groups]}

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return rows with a lengthscale for each column; a category has the range 1."""
        unit = torch.linspace(0, 1, len(x)).to(x)
        columns = [unit if i in self.levels else x[:, i] for i in self.columns]
        return self.kernel.rows(torch.stack(columns, -1), num_outputs)

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the covariances of inputs with others, or with themselves."""
        other = None if other is None else self.inputs(other)
        return self.kernel.covariance(self.numbers(own), self.inputs(x), other)

    def variance(self, own: Values, x: Tensor) -> Tensor:
        """Return the prior variances."""
        return self.kernel.variance(self.numbers(own), self.inputs(x))

    def with_pull_back(self, own: Values, x: Tensor) -> tuple[Tensor, PullBack]:
        """Return K and its derivatives in closed form, sums over the levels of a category."""
        K, back = self.kernel.with_pull_back(self.numbers(own), self.inputs(x))

        def pull_back(D: Tensor) -> Values:
            by = back(D)
            zeros = torch.zeros_like(own["lengthscale"])
            summed = zeros.index_add(-1, self.groups.to(D.device), by["lengthscale"])
            return by | {"lengthscale": summed}

        return K, pull_back

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return the random features of the kernel."""
        features = self.kernel.features(self.numbers(own), number, generator)
        return lambda x: features(self.inputs(x))


class Offset(Kernel):
    r"""Independent offsets of variance s, one for each value: :math:`s \, 1\{x_c = x'_c\}`."""

    def __init__(self, column: int) -> None:
        self.column = column
        self.values: list[float] = []

    def of_data(self, data: Data) -> Offset:
        """Return the kernel with the values of the column in a model's data."""
        new = copy(self)
        new.values = data.kernel_inputs(data.X)[..., self.column].unique().tolist()
        return new

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the row of s."""
        median = x.new_full((num_outputs, 1), DELTA.median)
        return [Row.positive("outputscale", median, DELTA.factor)]

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return s where values are the same."""
        if other is None:
            other = x
        same = x[..., self.column].unsqueeze(-1) == other[..., self.column].unsqueeze(-2)
        return own["outputscale"].unsqueeze(-1) * same

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return a feature for each training value, and ``number`` slots for new values."""
        size = own["outputscale"].sqrt().unsqueeze(-1)

        def features(x: Tensor) -> Tensor:
            c = x[..., [self.column]]
            is_training = c == c.new_tensor(self.values)
            # Multiples of the golden ratio spread new values over the slots (Knuth's hashing).
            slot = torch.floor(number * torch.remainder(c * (math.sqrt(5) - 1) / 2, 1.0))
            is_slot = slot == torch.arange(number).to(x)
            is_new = ~is_training.any(-1, keepdim=True)
            return size * torch.cat([is_training, is_slot & is_new], -1)

        return features


def levels_of_texts(frame: Any, asked: Sequence[int]) -> Levels:
    """Return the sorted levels of the columns of a frame that are texts or categories."""
    levels: Levels = {}
    if not hasattr(frame, "columns"):
        return levels
    dtypes = [*getattr(frame, "dtypes", ())] or [None] * len(frame.columns)
    for i, column in enumerate(frame.to_numpy().T):
        categories = getattr(dtypes[i], "categories", None)
        texts = {value for value in column if isinstance(value, str)}
        has_number = any(map(_NUMBER.fullmatch, texts))
        is_plain = len(texts) <= max(4, _IDS * len(column)) and not has_number
        if isinstance(categories, Iterable):
            levels[i] = tuple(v if isinstance(v, str) else float(v) for v in categories)
        elif texts and (is_plain or i in asked):
            levels[i] = tuple(sorted(texts))
    return levels


def numbers_of(levels: Sequence[str | float]) -> list[float]:
    """Return the numbers of levels in tensors: the level itself, or 0, 1, ... for texts."""
    return [float(k if isinstance(level, str) else level) for k, level in enumerate(levels)]


def levels_of(model: Any) -> Levels:
    """Return the levels of each column of categories or batches of a model, by its number."""
    transform = model.data.transform
    return dict(transform.levels) if isinstance(transform, Categories) else {}


def on_levels(model: Any, X: Tensor) -> Tensor:
    """Return inputs with the nearest level in columns of categories and batches."""
    X = X.clone()
    for i, levels in levels_of(model).items():
        numbers = X.new_tensor(numbers_of(levels))
        X[..., i] = numbers[(X[..., i : i + 1] - numbers).abs().argmin(-1)]
    return X
