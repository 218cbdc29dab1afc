"""Kernels of processes that are zero at places that the user names, where the formula is right."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_finite
from gpadjust.core.data import Data, as_tensor, columns_of
from gpadjust.core.kernels import Features, Kernel, as_kernel
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import LogNormal, Row, Values

_ROUNDING = 1e-10  # of the variance at places, of which there are several


class Vanishing(Kernel):
    r"""The kernel of a process that is zero wherever some inputs have given values.

    As the kernel of delta the formula is right there; as that of rho, rho is its mean there. With a
    product :math:`k = k_S(x_S, x'_S) \, k_R(x_R, x'_R)` over the inputs S that the values V are of,
    and all others R, it is that of :math:`g \sim GP(0, k)` given that :math:`g(x) = 0` for each x
    with :math:`x_S \in V`, whatever :math:`x_R`:

    .. math:: k_R(x_R, x'_R) \, [k_S(x_S, x'_S) - k_S(x_S, V) \, k_S(V, V)^{-1} k_S(V, x'_S)]

    (conditioning, Rasmussen and Williams 2006, eq. 2.19). One input makes V hyperplanes, all inputs
    points. Unknown parameters of the physics are then those that agree with the observations there,
    and with a process that is smooth towards them.

    Args:
        where: Values of columns, by name or number: ``{"valve": 1.0}``, ``{"valve": [0.0, 1.0]}``
            for either, ``{"valve": 1.0, "flow": 0.0}`` for both at once. Or points, ``p x d``, or a
            frame with some of the columns. In the user's units; the numbers of categories' levels.
        kernel: k, of this library or GPyTorch. Default: RBF.

    Raises:
        ValueError: If it is empty, not finite or of another shape. When a model is built, if it
            names no column of the inputs, a transform of the inputs mixes columns, or k is not a
            product over S and R.

    Example:
        >>> import torch
        >>> from gpadjust.core import PhysicsMeanGP
        >>> from gpadjust.kinds.vanishing import Vanishing
        >>> X = torch.rand(9, 2, dtype=torch.float64)
        >>> Y = X[:, :1].sin() + X[:, :1] * X[:, 1:]
        >>> right = Vanishing({1: 0.0})  # the second column
        >>> model = PhysicsMeanGP(X, Y, physics=lambda X: X[:, 0].sin(), covar_module=right)
        >>> model.delta(torch.tensor([[0.3, 0.0]], dtype=torch.float64)).variance.item() < 1e-12
        True
    """

    has_constant = False

    def __init__(self, where: Any, kernel: Any = None) -> None:
        self.kernel: Any = kernel
        if hasattr(where, "columns"):
            where = {name: where[name].to_list() for name in where.columns}
        self.is_points = not isinstance(where, Mapping)
        if self.is_points:
            if isinstance(where, list | tuple):
                where = torch.tensor(where, dtype=torch.float64)
            points = as_tensor(where, "where")
            if points.dim() != 2:
                raise ValueError(
                    "Expected `where` as values of columns ({'valve': 1.0}) or as points p x d; "
                    f"found shape {tuple(points.shape)}."
                )
            where = dict(enumerate(points.mT))
        try:
            each = [torch.as_tensor(v, dtype=torch.float64).reshape(-1) for v in where.values()]
            self.values = torch.stack(torch.broadcast_tensors(*each), -1)
            self.values[0]  # an error if there is none
        except (TypeError, ValueError, RuntimeError, IndexError) as error:
            raise ValueError(
                "Expected `where` with a number for each column, or as many numbers for each (for "
                "a category the number of its level, from 0 in the order of the alphabet); found "
                f"{where!r}."
            ) from error
        self.columns: list[str | int] = [*where]
        check_finite("where", self.values)
        self.places = self.values  # in the columns that kernels read; NaN in those that are free

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments."""
        where = dict(zip(self.columns, self.values.mT.tolist(), strict=True))
        return {"where": self.values.tolist() if self.is_points else where, "kernel": self.kernel}

    def of_term(self, outputscale: LogNormal) -> Vanishing:
        """Return the kernel whose k has the prior variance of a term, if it has none."""
        new = copy(self)
        new.kernel = as_kernel(self.kernel, outputscale)
        return new

    def of_data(self, data: Data) -> Vanishing:
        """Return the kernel on the columns that kernels of a model read."""
        new, d, found = copy(self), data.X.shape[-1], len(self.columns)
        if self.is_points and found != d:
            raise ValueError(
                f"Expected `where` as points of {d} columns; found {found}. Give values of some "
                "columns as a dictionary."
            )
        places = data.X.new_full((len(self.values), d), torch.nan)
        places[:, columns_of(data.input_names, self.columns, "`where`")] = self.values.to(places)
        free = places.isnan()
        terms = getattr(data.transform, "terms", lambda terms: terms)
        new.kernel = terms([Term("k", self.kernel)])[0].kernel.of_data(data)
        ends = torch.stack([data.X.amin(-2), data.X.amax(-2)])
        moved = ends.where(free.unsqueeze(-2), places.unsqueeze(-2))  # p x 2 x d
        read = data.kernel_inputs(moved)
        if read.shape != moved.shape or not torch.equal(read[:, 0][~free], read[:, 1][~free]):
            raise ValueError(
                "Expected an input transform that treats each column by itself, as Normalize, with "
                "Vanishing; found one that mixes columns, or makes others."
            )
        check_finite("where, after the transform,", read[:, 0][~free])
        new.places = read[:, 0].masked_fill(free, torch.nan)
        x = data.kernel_inputs(data.X[:40])
        if free.any() and not new._is_product(torch.cat([x, x.where(free[0], read[0, 0])])):
            raise ValueError(
                "Expected a kernel that is a product over the inputs in `where` and all others, as "
                f"RBF; found {self.kernel}. With values of all inputs any kernel will do."
            )
        return new

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the unknown parameters of k."""
        rows: list[Row] = self.kernel.rows(x, num_outputs)
        return rows

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the covariances of inputs with others, or with themselves; NaN if impossible."""
        left = self._along(own, x)[0]
        right = left if other is None else self._along(own, other)[0]
        zero = self._of(own, x, other, True) - left @ right.mT
        if not self.places.isnan().any():
            return zero
        origin = torch.zeros_like(x[..., :1, :])
        return zero * self._of(own, x, other, False) / self.kernel.covariance(own, origin)

    def variance(self, own: Values, x: Tensor) -> Tensor:
        """Return the prior variances, ``... x S x m x n``."""
        k = self.kernel.variance
        zero = k(own, self._part(x, True)) - self._along(own, x)[0].square().sum(-1)
        return zero.clamp_min(0.0) * k(own, self._part(x, False)) / k(own, torch.zeros_like(x))

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        r"""Return features of k, less what is known of them:

        .. math:: \varphi(x) - \sum_{ij} k_S(x_S, V_i) [k_S(V, V)^{-1}]_{ij} \varphi(V_j, x_R).
        """
        free = self.kernel.features(own, number, generator)

        def features(x: Tensor) -> Tensor:
            places = self.places.to(x).reshape(-1, *[1] * (x.dim() - 1), x.shape[-1])
            there = free(x.where(places.isnan(), places))  # p x ... x n x D
            along, root = self._along(own, x)
            weights = torch.linalg.solve_triangular(root.mT, along.mT, upper=True)
            return free(x) - (weights.movedim(-2, 0).unsqueeze(-1) * there).sum(0)

        return features

    def _part(self, x: Tensor, is_given: bool) -> Tensor:
        """Return inputs with 0 in the columns R, or in S."""
        return x.where((self.places[0].isfinite() == is_given).to(x.device), 0.0)

    def _of(self, own: Values, x: Tensor, other: Tensor | None, is_given: bool) -> Tensor:
        """Return k_S, or k_R, times the variance."""
        other = None if other is None else self._part(other, is_given)
        K: Tensor = self.kernel.covariance(own, self._part(x, is_given), other)
        return K

    def _along(self, own: Values, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the covariances of x_S with what is zero, whitened: ``... x n x p``.

        And the root that whitens, the Cholesky factor of what is zero; NaN if it has none.
        """
        zeros = self.places.to(x).nan_to_num()[None, None]
        K = self._of(own, zeros, None, True)
        rounding = _ROUNDING if K.shape[-1] > 1 else 0.0
        K = K + rounding * torch.diag_embed(K.diagonal(dim1=-1, dim2=-2))
        root, failed = torch.linalg.cholesky_ex(K)
        root = root.masked_fill(failed[..., None, None] > 0, torch.nan)
        cross = self._of(own, x, zeros, True)
        return torch.linalg.solve_triangular(root, cross.mT, upper=False).mT, root

    def _is_product(self, x: Tensor) -> bool:
        """Return whether k(x, x') k(0, 0) is k_S k_R, at the middle of the prior."""
        own = {row.name: row.value(x.new_zeros(1)) for row in self.kernel.rows(x, 1)}
        own = {name: value.unsqueeze(0) for name, value in own.items()}
        x = x[None, None]
        whole = self.kernel.covariance(own, x) * self.kernel.covariance(own, 0 * x)
        parts = self._of(own, x, None, True) * self._of(own, x, None, False)
        return torch.allclose(whole, parts, rtol=1e-8, atol=1e-12)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.kernel})"
