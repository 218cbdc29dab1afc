"""A discrepancy that leaves to the parameters of the physics what they can explain."""

from __future__ import annotations

from typing import Any

import torch
from gpytorch.kernels import Kernel
from linear_operator import to_dense
from torch import Size, Tensor

from gpadjust.gp.kernels import CompositeKernel

_ROUNDING = 1e-10  # of the variances along the directions


class OrthogonalKernel(CompositeKernel):
    r"""The covariance of a function that is orthogonal to given directions at given points.

    With :math:`z_1, \dots, z_n` and directions :math:`G`, ``n x p``, it is that of
    :math:`\delta \sim GP(0, k)` given that :math:`\sum_i G_{ij} \delta(z_i) = 0` for all j:

    .. math:: k(x, x') - k(x, Z) G \, (G^T k(Z, Z) G)^{-1} G^T k(Z, x')

    (Plumlee 2017). As the kernel of a model's delta, :func:`gpadjust.fit` takes the observed
    inputs for the points, and for the directions what the unknown parameters of the physics change
    there. The parameters are then those of the physics that is *best* at these inputs, by least
    squares; with a free delta (Kennedy and O'Hagan 2001) the *true* ones as far as its prior is
    right. Until there are directions it is ``base_kernel`` k itself.

    Example:
        >>> import torch
        >>> from gpadjust import PhysicsMeanGP
        >>> from gpadjust.models import orthogonal_rbf
        >>> from gpadjust.physics import FunctionPhysics, Unknown
        >>> line = FunctionPhysics(lambda X, p: p.a * X[:, 0], unknowns={"a": Unknown(1.0, sd=5.0)})
        >>> X = torch.linspace(0, 1, 17, dtype=torch.float64).unsqueeze(-1)
        >>> model = PhysicsMeanGP(X, X + X * X, physics=line, covar_module=orthogonal_rbf)
    """

    points: Tensor
    directions: Tensor

    def __init__(self, base_kernel: Kernel) -> None:
        super().__init__()
        self.base_kernel = base_kernel
        nothing = torch.zeros(*base_kernel.batch_shape, 0, 0, dtype=torch.float64)
        self.register_buffer("points", nothing)
        self.register_buffer("directions", nothing.clone())

    @property
    def batch_shape(self) -> Size:
        """The batch shape of the base kernel."""
        return self.base_kernel.batch_shape

    @batch_shape.setter
    def batch_shape(self, batch_shape: Size) -> None:
        # BoTorch sets it for a subset of the outputs, after that of the base kernel.
        pass

    def set_directions(self, points: Tensor, directions: Tensor) -> None:
        """Set the points, ``batch_shape x n x d``, and directions, ``batch_shape x n x p``."""
        size = directions.norm(dim=-2, keepdim=True)
        points = points.detach().expand(*directions.shape[:-1], points.shape[-1])
        self.points = points.clone()
        self.directions = directions.detach() / size.where(size > 0, torch.ones_like(size))

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n``."""
        prior = to_dense(self.base_kernel(x1, x2, diag=diag))
        if not self.directions.shape[-1]:
            return prior
        left = self.along(x1)
        right = left if x2 is x1 else self.along(x2)
        if diag:
            return (prior - (left * right).sum(-1)).clamp_min(0.0)
        return prior - left @ right.mT

    def along(self, x: Tensor) -> Tensor:
        """The covariance with what is zero, whitened: ``... x n x p``."""
        cross = to_dense(self.base_kernel(x, self.points)) @ self.directions
        return torch.linalg.solve_triangular(self.factor(), cross.mT, upper=False).mT

    def factor(self) -> Tensor:
        """The Cholesky factor of the covariance of what is zero, ``... x p x p``; NaN if none."""
        own = to_dense(self.base_kernel(self.points, self.points))
        square = self.directions.mT @ own @ self.directions
        size = square.diagonal(dim1=-1, dim2=-2).mean(-1)[..., None, None]
        identity = torch.eye(square.shape[-1]).to(square)
        factor, failed = torch.linalg.cholesky_ex(square + _ROUNDING * size.detach() * identity)
        # Variances beyond what numbers hold have no covariance, and so no density.
        return factor.masked_fill(failed[..., None, None] > 0, torch.nan)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        """Take points and directions, however many there are."""
        for name in ("points", "directions"):
            if f"{prefix}{name}" in state_dict:
                setattr(self, name, torch.empty_like(state_dict[f"{prefix}{name}"]))
        super()._load_from_state_dict(state_dict, prefix, *args)
