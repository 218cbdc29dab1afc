"""The kernel of a delta that leaves to the parameters of the physics what these can explain."""

from __future__ import annotations

from copy import copy
from typing import Any

import torch
from torch import Tensor

from gpadjust.core.data import Data
from gpadjust.core.fitting import fit
from gpadjust.core.kernels import Features, Kernel, as_kernel
from gpadjust.core.structures import CalibratedPhysics
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import LogNormal, Row, Values
from gpadjust.physics import as_physics

_ROUNDING = 1e-10  # of the variances along the directions
_STEP = 1e-4  # of differences by parameters of the physics, in coordinates


class Orthogonal(Kernel):
    r"""The kernel of a function that is orthogonal to what parameters of a physics change.

    With the observed inputs Z and :math:`G = \partial f_p(Z) / \partial \theta`, ``n x p``, it is
    that of :math:`\delta \sim GP(0, k)` given :math:`G^T \delta(Z) = 0`:

    .. math:: k(x, x') - k(x, Z) G \, (G^T k(Z, Z) G)^{-1} G^T k(Z, x')

    (Plumlee 2017). The parameters are then those of the physics that is *best* at these inputs, by
    least squares, at which G is taken; with a free delta (Kennedy and O'Hagan 2001) the *true* ones
    as far as its prior is right.

    Args:
        physics: The physics of the model, with unknown parameters.
        kernel: k, of this library or GPyTorch. Default: RBF.

    Raises:
        ValueError: When a model is built, if it has several outputs, or the physics has no unknown
            parameters.

    Example:
        >>> import torch
        >>> from gpadjust.core import PhysicsMeanGP
        >>> from paper.common.orthogonal import Orthogonal
        >>> from gpadjust.physics import FunctionPhysics, Unknown
        >>> line = FunctionPhysics(lambda X, p: p.a * X[:, 0], unknowns={"a": Unknown(1.0, sd=5.0)})
        >>> X = torch.linspace(0, 1, 17, dtype=torch.float64).unsqueeze(-1)
        >>> model = PhysicsMeanGP(X, X + X * X, physics=line, covar_module=Orthogonal(line))
        >>> values = {name[13:]: v for name, v in model.values.items() if "kernel" in name}
        >>> delta = model.terms[1].kernel.covariance(values, X[None, None])
        >>> (delta @ X).abs().max().item() < 1e-8
        True
    """

    has_constant = False

    def __init__(self, physics: Any, kernel: Any = None) -> None:
        self.physics, self.kernel = as_physics(physics), kernel
        self.points = self.directions = torch.zeros(0, 0, dtype=torch.float64)

    def of_term(self, outputscale: LogNormal) -> Orthogonal:
        """Return the kernel whose k has the prior variance of a term, if it has none."""
        new = copy(self)
        new.kernel = as_kernel(self.kernel, outputscale)
        return new

    def of_data(self, data: Data) -> Orthogonal:
        """Return the kernel with the directions at the best parameters for a model's data."""
        if data.Y.shape[-1] > 1:
            raise ValueError(
                f"Expected one output with Orthogonal; found {data.Y.shape[-1]}. Take a model for "
                "each of them."
            )
        best = CalibratedPhysics(data.X, data.Y, data.Yvar, physics=self.physics)
        fit(best, "map")
        unknowns = self.physics.unknowns
        z = torch.cat([best.values[f"physics.{name}"].detach() for name in unknowns], -1)
        steps = _STEP * torch.eye(len(unknowns)).to(z)
        f = self.physics(data.X.unsqueeze(0), unknowns.at(torch.cat([z + steps, z - steps])))
        high, low = f.squeeze(-1).chunk(2)  # p x n
        G = (high - low).mT / (2 * _STEP)
        size = G.norm(dim=-2, keepdim=True)
        new = copy(self)
        new.points = data.kernel_inputs(data.X)
        new.directions = G / size.where(size > 0, torch.ones_like(size))
        terms = getattr(data.transform, "terms", lambda terms: terms)
        new.kernel = terms([Term("k", self.kernel)])[0].kernel.of_data(data)
        return new

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the unknown parameters of k."""
        rows: list[Row] = self.kernel.rows(x, num_outputs)
        return rows

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the covariances of inputs with others, or with themselves; NaN if impossible."""
        left = self._along(own, x)
        right = left if other is None else self._along(own, other)
        K: Tensor = self.kernel.covariance(own, x, other) - left @ right.mT
        return K

    def variance(self, own: Values, x: Tensor) -> Tensor:
        """Return the prior variances, ``... x S x m x n``."""
        variance = self.kernel.variance(own, x) - self._along(own, x).square().sum(-1)
        return variance.clamp_min(0.0)

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return features of k, less what is known of them."""
        free, points, G = self.kernel.features(own, number, generator), self.points, self.directions
        along = G.mT @ free(points[None, None])
        taken = torch.linalg.solve_triangular(self._factor(own), along, upper=False)
        return lambda x: free(x) - self._along(own, x) @ taken

    def _along(self, own: Values, x: Tensor) -> Tensor:
        """Return the covariances with what is zero, whitened: ``... x n x p``."""
        cross = self.kernel.covariance(own, x, self.points[None, None]) @ self.directions
        return torch.linalg.solve_triangular(self._factor(own), cross.mT, upper=False).mT

    def _factor(self, own: Values) -> Tensor:
        """Return the Cholesky factor of the covariance of what is zero; NaN if it has none."""
        square = self.kernel.covariance(own, self.points[None, None])
        square = self.directions.mT @ square @ self.directions
        size = square.diagonal(dim1=-1, dim2=-2).mean(-1)[..., None, None].detach()
        identity = torch.eye(square.shape[-1]).to(square)
        factor, failed = torch.linalg.cholesky_ex(square + _ROUNDING * size * identity)
        return factor.masked_fill(failed[..., None, None] > 0, torch.nan)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.kernel})"
