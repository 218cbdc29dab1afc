"""Categories among the inputs, such as a material, and batches, of which each has an offset."""

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

from gpadjust.core.data import ArrayLike, Data, columns_of, names_of
from gpadjust.core.kernels import DELTA, Features, Fourier, Kernel, PullBack, Stationary
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Row, Values

Levels = dict[int, tuple[str | float, ...]]

_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")
_IDS = 0.5  # levels for each row, from which on texts are not categories


class Categories(InputTransform):
    r"""Columns of categories, whose levels are exchangeable, and of batches, which have offsets.

    A :class:`~gpadjust.core.Stationary` kernel of a model has one lengthscale for each category c,
    whose levels are all at the same distance,
    :math:`r^2 = \sum_k (x_k - x'_k)^2 / \ell_k^2 + \sum_c 1\{c \neq c'\} / \ell_c^2`. It does not
    read batches, such as rigs or days. Each column of these is a term of its name: independent
    offsets of one learnt variance, which a new batch has, too. Other kernels, of GPyTorch or one's
    own, read the numbers of levels; ``active_dims`` keeps them from it.

    Texts of a frame have the numbers 0, 1, ... of their sorted levels, a new batch a negative one.
    Tensors and the physics have these numbers. BoTorch's optimisation needs ``fixed_features`` for
    the columns.

    Args:
        columns: Names or numbers of columns of categories. Default: all of text or pandas'
            categories, except numbers in text and texts that differ in most rows.
        batches: Names or numbers of columns of batches.
        levels: Levels by column, in the order of their numbers. Default: those of the data.

    Raises:
        ValueError: When a model is built, if there is no such column, or none but batches; later,
            if a level is unknown.

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
        """The arguments; of a model's transform the learnt ones."""
        names = {i: self.names[i] for i in self.levels}
        columns = [name for i, name in names.items() if i not in self.batches]
        levels = {name: [*self.levels[i]] for i, name in names.items()}
        learnt = {"columns": columns, "batches": [names[i] for i in self.batches], "levels": levels}
        return learnt if self.names else self.asked

    def coded(self, X: ArrayLike) -> ArrayLike:
        """Return inputs with the numbers of levels in place of texts."""
        if self.training:
            self._learn(X)
        texts = [i for i, own in self.levels.items() if own and isinstance(own[0], str)]
        if not texts or not hasattr(X, "columns") or X.shape[-1] != len(self.names):
            return X
        array = np.array(X.to_numpy(), dtype=object)
        for i in texts:
            known, column = self.levels[i], array[:, i].tolist()
            new = [v for v in dict.fromkeys(column) if isinstance(v, str) and v not in known]
            if new and i not in self.batches:
                raise self._unknown(i, new[0])
            numbers: dict[Any, float] = dict(zip(known, numbers_of(known), strict=True))
            numbers |= {text: -1.0 - crc32(text.encode()) for text in new}  # the same ever after
            array[:, i] = [numbers.get(v, v) for v in column]
        return array

    def transform(self, X: Tensor) -> Tensor:
        """Return the inputs, whose levels are checked or, when a model is built, learnt."""
        for i, own in self.levels.items():
            if not own:
                self.levels[i] = tuple(X[..., i].unique().tolist())
            elif i not in self.batches:
                unknown = (X[..., i].unsqueeze(-1) != X.new_tensor(numbers_of(own))).all(-1)
                if unknown.any():
                    raise self._unknown(i, X[..., i][unknown][0].item())
        return X

    def terms(self, terms: Sequence[Term]) -> list[Term]:
        """Return terms whose kernels know the levels, and a term for each column of batches."""
        read = [i for i in range(len(self.names)) if i not in self.batches]
        if not read:
            raise ValueError(f"Expected an input in addition to batches; found {self.names}.")
        levels = {i: numbers_of(self.levels[i]) for i in read if i in self.levels}
        new = []
        for term in terms:
            kernel = term.kernel
            if isinstance(kernel, Stationary) and self.levels:
                kernel = Exchangeable(kernel, {i: self.names[i] for i in read}, levels)
            new.append(term._replace(kernel=kernel))
        return new + [Term(self.names[i], Offset(i)) for i in self.batches]

    def _learn(self, X: ArrayLike) -> None:
        """Learn columns and levels of texts; levels that are numbers are empty until transform."""
        self.names, asked = names_of(X, "x"), self.asked
        each = (columns_of(self.names, () if v is None else v, name) for name, v in asked.items())
        columns, self.batches, declared = each
        texts = levels_of_texts(X, [*columns, *self.batches])
        columns = [*texts] if asked["columns"] is None else columns
        texts |= zip(declared, map(tuple, asked["levels"].values()), strict=True)
        self.levels = {i: texts.get(i, ()) for i in sorted({*columns, *self.batches, *declared})}
        for i, own in self.levels.items():
            if len({*own}) < len(own) or len({isinstance(level, str) for level in own}) > 1:
                raise ValueError(f"Expected different levels of {self.names[i]}; found {own}.")

    def _unknown(self, i: int, value: str | float) -> ValueError:
        levels = self.levels[i] if isinstance(value, str) else numbers_of(self.levels[i])
        return ValueError(
            f"Expected {self.names[i]} to be one of {', '.join(map(str, levels))}; found {value}. "
            "Nothing is known of a new level: list it beforehand, levels={column: levels}, or take "
            "the column as batches=[...], whose new levels have new offsets. BoTorch's "
            "optimisation needs fixed_features for the column."
        )


class Exchangeable(Kernel):
    r"""A stationary kernel of which the levels of a category are at distance 1 from each other.

    It reads :math:`1 / \sqrt 2` or 0 for each level; these columns have one lengthscale. The names
    of the columns that it reads, and the numbers of levels of categories, are by their numbers.
    """

    def __init__(
        self, kernel: Stationary, columns: Mapping[int, str], levels: Mapping[int, list[float]]
    ) -> None:
        self.kernel, self.columns, self.levels = kernel, [*columns], levels
        self.input_names = [*columns.values()]
        sizes = torch.tensor([len(levels.get(i, [0.0])) for i in columns])
        self.groups = torch.arange(len(columns)).repeat_interleave(sizes)
        if isinstance(kernel, Fourier):  # each level has frequencies of its own
            self.kernel = copy(kernel)
            w = kernel.frequencies[self.columns][self.groups]
            own = torch.randn(w.shape, generator=torch.Generator().manual_seed(len(w))).to(w)
            self.kernel.frequencies = own.where((sizes > 1)[self.groups].unsqueeze(-1), w)

    def inputs(self, x: Tensor) -> Tensor:
        """Return the columns of numbers, and one for each level."""
        parts = [x[..., [i]] for i in self.columns]
        for k, i in enumerate(self.columns):
            if i in self.levels:
                parts[k] = (parts[k] == x.new_tensor(self.levels[i])).to(x) / math.sqrt(2)
        return torch.cat(parts, -1)

    def numbers(self, own: Values) -> Values:
        """Return the parameters, with a lengthscale for each column and level."""
        return own | {"lengthscale": own["lengthscale"][..., self.groups]}

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return a lengthscale for each column, as of an input of range 1 for a category."""
        one = torch.linspace(0, 1, len(x)).to(x)
        read = [one if i in self.levels else x[:, i] for i in self.columns]
        return self.kernel.rows(torch.stack(read, -1), num_outputs)

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
            sums, groups = torch.zeros_like(own["lengthscale"]), self.groups.to(D.device)
            return by | {"lengthscale": sums.index_add(-1, groups, by["lengthscale"])}

        return K, pull_back

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return the random features of the kernel."""
        features = self.kernel.features(self.numbers(own), number, generator)
        return lambda x: features(self.inputs(x))


class Offset(Kernel):
    r"""Independent offsets of equal variance s, one for each value: :math:`s \, 1\{x_c = x'_c\}`.

    The column c has a number; s has the prior of a process in squared units of the targets.
    """

    def __init__(self, column: int) -> None:
        self.column = column
        self.values: list[float] = []

    def of_data(self, data: Data) -> Offset:
        """Return the kernel for a model's data, of which it knows the values."""
        new = copy(self)
        new.values = data.kernel_inputs(data.X)[..., self.column].unique().tolist()
        return new

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the row of s."""
        median = x.new_full((num_outputs, 1), DELTA.median)
        return [Row.positive("outputscale", median, DELTA.factor)]

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return s where values are the same."""
        column = (x if other is None else other)[..., self.column]
        same = x[..., self.column].unsqueeze(-1) == column.unsqueeze(-2)
        return own["outputscale"].unsqueeze(-1) * same

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return one feature for each training value, and others that new values share."""
        size = own["outputscale"].sqrt().unsqueeze(-1)

        def features(x: Tensor) -> Tensor:
            c, slots = x[..., [self.column]], torch.arange(number).to(x)
            known = c == c.new_tensor(self.values)
            slot = torch.floor(number * torch.remainder(c * (math.sqrt(5) - 1) / 2, 1.0))
            return size * torch.cat([known, (slot == slots) & ~known.any(-1, keepdim=True)], -1)

        return features


def levels_of_texts(frame: Any, asked: Sequence[int]) -> Levels:
    """Return the sorted levels of the columns of a frame that are texts or categories."""
    found: Levels = {}
    dtypes = [*getattr(frame, "dtypes", ())]
    for i, column in enumerate(frame.to_numpy().T if hasattr(frame, "columns") else ()):
        categories = getattr(dtypes[i], "categories", None) if dtypes else None
        texts = {value for value in column if isinstance(value, str)}
        has_number = any(map(_NUMBER.fullmatch, texts))
        is_plain = len(texts) <= max(4, _IDS * len(column)) and not has_number
        if isinstance(categories, Iterable):
            found[i] = tuple(v if isinstance(v, str) else float(v) for v in categories)
        elif texts and (is_plain or i in asked):
            found[i] = tuple(sorted(texts))
    return found


def numbers_of(levels: Sequence[str | float]) -> list[float]:
    """Return the numbers that tensors have for levels: their own, or 0, 1, ... for texts."""
    return [float(k if isinstance(level, str) else level) for k, level in enumerate(levels)]


def levels_of(model: Any) -> Levels:
    """Return the levels of each column of categories or batches of a model, by its number."""
    transform = model.data.transform
    return dict(transform.levels) if isinstance(transform, Categories) else {}


def on_levels(model: Any, X: Tensor) -> Tensor:
    """Return inputs with the nearest level in columns of categories and batches."""
    X = X.clone()
    for i, own in levels_of(model).items():
        levels = X.new_tensor(numbers_of(own))
        X[..., i] = levels[(X[..., i : i + 1] - levels).abs().argmin(-1)]
    return X
