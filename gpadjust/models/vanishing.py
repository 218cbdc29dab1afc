"""Kernels of what is zero somewhere: places that the user names, in the columns of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Size, Tensor

from gpadjust.checks import check_finite
from gpadjust.gp import PhysicsInput, VanishingKernel
from gpadjust.models.parameters import scaled_rbf
from gpadjust.models.training_data import ArrayLike, column_names, to_tensor

if TYPE_CHECKING:
    from gpadjust.models.term_builder import TermBuilder

Where = Mapping[str | int, float | Sequence[float]] | ArrayLike


class VanishingRBF:
    """What :func:`vanishing_rbf` returns: it makes the kernel of a model."""

    def __init__(self, where: Where) -> None:
        names = column_names(where)
        if isinstance(where, Mapping):
            self.columns: list[str | int] | None = [*where]
            each = [_numbers(values) for values in where.values()]
            sizes = {len(values) for values in each} - {1}
            if not each or len(sizes) > 1 or 0 in sizes:
                raise ValueError(
                    "Expected `where` to give each column a number, or all the same count of "
                    f"numbers, got {where!r}."
                )
            self.values = torch.stack([v.expand(max([1, *sizes])) for v in each], -1)
        else:
            self.columns = None if names is None else [*names]
            if isinstance(where, list | tuple):
                where = torch.tensor(where, dtype=torch.float64)
            self.values = to_tensor(where, "where")
            if self.values.dim() != 2 or not self.values.numel():
                raise ValueError(
                    "Expected `where` as values of columns ({'valve': 1.0}) or as points p x d, "
                    f"got shape {tuple(self.values.shape)}."
                )
        check_finite("where", self.values)

    def __call__(self, num_inputs: int, batch_shape: Size) -> VanishingKernel:
        """Return the kernel of inputs that have no names and no transform."""
        return self._kernel(self._raw(tuple(map(str, range(num_inputs)))), batch_shape)

    def made_for(self, make: TermBuilder) -> VanishingKernel:
        """Return the kernel on the columns that the terms of a model read."""
        raw, transform = self._raw(make.data.input_names), cast("Any", make.input_transform)
        if getattr(transform, "base", transform) is None:
            return self._kernel(raw, make.batch_shape)
        X = make.data.X.reshape(-1, raw.shape[-1])[:2]
        moved = X.where(raw.isnan().unsqueeze(-2), raw.unsqueeze(-2))  # p x 2 x d
        learns = transform.training
        with torch.no_grad():  # a transform that learns has learnt from all rows
            read = transform.without_physics if isinstance(transform, PhysicsInput) else transform
            transform.eval()
            rows = read(moved)[..., : make.num_inputs]
            transform.train(learns)
        # The raw column that each of those is made of.
        of = [*getattr(make.categories, "groups", range(raw.shape[-1]))]
        given = raw[..., of].isfinite() if len(of) == rows.shape[-1] else rows[:, 0] == torch.inf
        if not given.any() or not torch.equal(rows[:, 0][given], rows[:, 1][given]):
            raise ValueError(
                "Expected an input transform that treats each column by itself, as Normalize, "
                "beside vanishing_rbf: this one mixes columns, or has others."
            )
        return self._kernel(rows[:, 0].masked_fill(~given, torch.nan), make.batch_shape)

    def _raw(self, names: tuple[str, ...]) -> Tensor:
        """The places in the user's units, ``p x d``, NaN in the columns that are free."""
        d, columns = len(names), self.columns
        columns = [*range(self.values.shape[-1])] if columns is None else columns
        if self.columns is None and len(columns) != d:
            raise ValueError(
                f"Expected `where` as points with {d} columns, got shape "
                f"{tuple(self.values.shape)}; give values of some columns as a dictionary."
            )
        numbers = []
        for each in columns:
            if isinstance(each, str) and names.count(each) == 1:
                numbers.append(names.index(each))
            elif isinstance(each, int) and -d <= each < d:
                numbers.append(each % d)
            else:
                raise ValueError(
                    f"Expected `where` to name columns of {', '.join(names)}, or numbers from 0 to "
                    f"{d - 1}, got {each!r}."
                )
        raw = self.values.new_full((len(self.values), d), torch.nan)
        raw[:, numbers] = self.values
        return raw

    @staticmethod
    def _kernel(places: Tensor, batch_shape: Size) -> VanishingKernel:
        kernel = scaled_rbf(places.shape[-1], batch_shape).to(places)
        return VanishingKernel(kernel, places)


def _numbers(values: float | Sequence[float]) -> Tensor:
    try:
        return torch.as_tensor(values, dtype=torch.float64).reshape(-1)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"Expected `where` to give each column a number, or several, got {values!r}; of a "
            "category give the number of the level, from 0 in the order of the alphabet."
        ) from error


def vanishing_rbf(where: Where) -> VanishingRBF:
    """The default kernel, of a function that is zero where the user knows the formula to be right.

    As the kernel of delta the formula is right there; as that of rho, rho has its mean there.
    Where CKA has it for delta alone, it needs ``center=0.0``. Unknown parameters of the physics are
    then those that speak for the observations there, and for a delta that is smooth towards them.

    Args:
        where: Values of columns, by name or number: ``{"valve": 1.0}``, ``{"valve": [0.0, 1.0]}``
            for either, ``{"valve": 1.0, "flow": 0.0}`` for both at once. Or points, ``p x d``, or
            a frame with some of the columns. In the user's units; of categories the numbers of
            levels.

    Raises:
        ValueError: If it is empty, not finite, or of another shape; when a model is built, if it
            names no column of the inputs, or these go through a transform that mixes columns.

    Example:
        >>> import torch
        >>> from gpadjust import PhysicsMeanGP
        >>> from gpadjust.models import vanishing_rbf
        >>> X = torch.rand(9, 2, dtype=torch.float64)
        >>> Y = X[:, :1].sin() + X[:, :1] * X[:, 1:]
        >>> known = vanishing_rbf({1: 0.0})  # the second column
        >>> model = PhysicsMeanGP(X, Y, physics=lambda X: X[:, 0].sin(), covar_module=known)
        >>> model.delta(torch.tensor([[0.3, 0.0]], dtype=torch.float64)).variance.item() < 1e-12
        True
    """
    return VanishingRBF(where)
