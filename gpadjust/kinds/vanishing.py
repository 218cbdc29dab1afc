"""Kernels of processes that are zero at places of the user, where the formula is right."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_finite, checked_columns
from gpadjust.core.data import Data
from gpadjust.core.kernels import Features, Kernel
from gpadjust.core.terms import Term, as_kernel
from gpadjust.core.unknowns import LogNormal, Row, Values

_ROUNDING = 1e-10  # of the variance, added at several places, which may be close to each other


class Vanishing(Kernel):
    r"""The kernel of a process that is zero wherever some inputs have certain values.

    As the kernel of delta, it makes the formula right there; as the kernel of rho, it makes rho its
    mean there. The kernel is a product :math:`k = k_S(x_S, x'_S) \, k_R(x_R, x'_R)` over the
    inputs S with values V and all others R. Given :math:`g(x) = 0` for each x with
    :math:`x_S \in V`, whatever :math:`x_R`, the process :math:`g \sim GP(0, k)` has the kernel

    .. math:: k_R(x_R, x'_R) \, [k_S(x_S, x'_S) - k_S(x_S, V) \, k_S(V, V)^{-1} k_S(V, x'_S)]

    (conditioning, Rasmussen and Williams 2006, eq. 2.19).

    Args:
        where: Values of columns, by name or number, in the user's units: ``{"valve": 1.0}``,
            ``{"valve": [0.0, 1.0]}`` for either, ``{"valve": 1.0, "flow": 0.0}`` for both at once.
            Or a frame with some of the columns. For a category, the numbers of its levels.
        kernel: k, of this library or GPyTorch. Default: RBF.

    Raises:
        TypeError: If ``where`` is neither a dictionary nor a frame.
        ValueError: If ``where`` is empty, not finite or of another shape, a column does not exist,
            a transform of the inputs mixes columns, or k is not a product over S and R.

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
        if not isinstance(where, Mapping):
            raise TypeError(
                "Expected `where` as values of columns, {'valve': 1.0}, or a frame with some of "
                f"the columns; found {where!r}."
            )
        try:
            columns = [torch.as_tensor(v, dtype=torch.float64).reshape(-1) for v in where.values()]
            self.values = torch.stack(torch.broadcast_tensors(*columns), -1)
            self.values[0]  # an IndexError if there is no value
        except (TypeError, ValueError, RuntimeError, IndexError) as error:
            raise ValueError(
                "Expected `where` with a number for each column, or equally many numbers for each "
                "(for a category the number of its level, from 0 in alphabetical order); found "
                f"{where!r}."
            ) from error
        self.columns: list[str | int] = [*where]
        check_finite("where", self.values)
        self.places = self.values  # in `of_data` the inputs of kernels, NaN in the columns R

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments."""
        by_column = dict(zip(self.columns, self.values.mT.tolist(), strict=True))
        return {"where": by_column, "kernel": self.kernel}

    def of_term(self, outputscale: LogNormal) -> Vanishing:
        """Return the kernel for a term, whose prior variance is the default of k."""
        new = copy(self)
        new.kernel = as_kernel(self.kernel, outputscale)
        return new

    def of_data(self, data: Data) -> Vanishing:
        """Return the kernel for a model's data, on the inputs of its kernels."""
        new = copy(self)
        d = data.X.shape[-1]
        places = data.X.new_full((len(self.values), d), torch.nan)
        columns = checked_columns("`where`", self.columns, data.input_names)
        places[:, columns] = self.values.to(places)
        is_free = places.isnan()  # columns R
        terms = getattr(data.transform, "terms", lambda terms: terms)
        new.kernel = terms([Term("k", self.kernel)])[0].kernel.of_data(data)
        # A transform of single columns leaves S where it is, whatever R: compare both ends of R.
        ends = torch.stack([data.X.amin(-2), data.X.amax(-2)])
        moved = ends.where(is_free.unsqueeze(-2), places.unsqueeze(-2))  # p x 2 x d
        first, second = (data.kernel_inputs(moved[:, i]) for i in range(2))
        if first.shape != places.shape or not torch.equal(first[~is_free], second[~is_free]):
            raise ValueError(
                "Expected an input transform that treats each column by itself, as Normalize, with "
                "Vanishing; found one that mixes columns, or makes others."
            )
        check_finite("where, after the transform,", first[~is_free])
        new.places = first.masked_fill(is_free, torch.nan)
        x = data.kernel_inputs(data.X[:40])
        if is_free.any() and not new._is_product(torch.cat([x, x.where(is_free[0], first[0])])):
            raise ValueError(
                "Expected a kernel that is a product over the inputs in `where` and all others, as "
                f"RBF; found {self.kernel}. With values of all inputs any kernel will do."
            )
        return new

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the unknown parameters of k."""
        rows: list[Row] = self.kernel.rows(x, num_outputs)
        return rows

    def in_user_units(self, name: str, numbers: Tensor, unit: float) -> tuple[str, Tensor]:
        """Return the name and numbers of a parameter of k in summaries."""
        shown: tuple[str, Tensor] = self.kernel.in_user_units(name, numbers, unit)
        return shown

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the covariances of inputs with others, or with themselves; NaN if impossible."""
        # k_R (k_S - k_S(x, V) k_S(V, V)^-1 k_S(V, x')); the second factor has the variance twice.
        left = self._whitened(own, x)[0]
        right = left if other is None else self._whitened(own, other)[0]
        conditioned = self._factor(own, x, other, True) - left @ right.mT
        if not self.places.isnan().any():
            return conditioned
        origin = torch.zeros_like(x[..., :1, :])
        rest = self._factor(own, x, other, False)
        return conditioned * rest / self.kernel.covariance(own, origin)

    def variance(self, own: Values, x: Tensor) -> Tensor:
        """Return the prior variances, ``... x S x m x n``."""
        k = self.kernel.variance
        conditioned = k(own, self._part(x, True)) - self._whitened(own, x)[0].square().sum(-1)
        rest = k(own, self._part(x, False))
        return conditioned.clamp_min(0.0) * rest / k(own, torch.zeros_like(x))

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        r"""Return features of k, less their projection onto the features at the places:

        .. math:: \varphi(x) - \sum_{ij} k_S(x_S, V_i) [k_S(V, V)^{-1}]_{ij} \varphi(V_j, x_R).
        """
        base = self.kernel.features(own, number, generator)

        def features(x: Tensor) -> Tensor:
            places = self.places.to(x).reshape(-1, *[1] * (x.dim() - 1), x.shape[-1])
            at_places = base(x.where(places.isnan(), places))  # p x ... x n x D
            # k_S(x, V) k_S(V, V)^-1 = (k_S(x, V) L^-T) L^-1
            whitened, root = self._whitened(own, x)
            weights = torch.linalg.solve_triangular(root.mT, whitened.mT, upper=True)
            return base(x) - (weights.movedim(-2, 0).unsqueeze(-1) * at_places).sum(0)

        return features

    def _part(self, x: Tensor, is_S: bool) -> Tensor:
        """Return inputs with 0 in the columns R, or in S."""
        return x.where((self.places[0].isfinite() == is_S).to(x.device), 0.0)

    def _factor(self, own: Values, x: Tensor, other: Tensor | None, is_S: bool) -> Tensor:
        """Return k_S, or k_R, times the variance."""
        other = None if other is None else self._part(other, is_S)
        K: Tensor = self.kernel.covariance(own, self._part(x, is_S), other)
        return K

    def _whitened(self, own: Values, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return k_S(x, V) L^-T, ``... x n x p``, and L with k_S(V, V) = L L^T; NaN if none."""
        places = self.places.to(x).nan_to_num()[None, None]
        K = self._factor(own, places, None, True)
        if K.shape[-1] > 1:
            K = K + _ROUNDING * torch.diag_embed(K.diagonal(dim1=-1, dim2=-2))
        root, failed = torch.linalg.cholesky_ex(K)
        root = root.masked_fill(failed[..., None, None] > 0, torch.nan)
        cross = self._factor(own, x, places, True)
        return torch.linalg.solve_triangular(root, cross.mT, upper=False).mT, root

    def _is_product(self, x: Tensor) -> bool:
        """Return whether k(x, x') k(0, 0) = k_S k_R, at the middle of the prior."""
        rows = self.kernel.rows(x, 1)
        middle = {row.name: row.value(x.new_zeros(1)).unsqueeze(0) for row in rows}
        x = x[None, None]
        joint = self.kernel.covariance(middle, x) * self.kernel.covariance(middle, 0 * x)
        product = self._factor(middle, x, None, True) * self._factor(middle, x, None, False)
        return torch.allclose(joint, product, rtol=1e-8, atol=1e-12)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.kernel})"
