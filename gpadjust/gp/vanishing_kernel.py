"""The covariance of a function that is zero on a set that the user knows."""

from __future__ import annotations

from typing import Any

import torch
from gpytorch.kernels import Kernel
from linear_operator import to_dense
from torch import Size, Tensor

from gpadjust.gp.kernels import RBF, CompositeKernel, stationary_parts

_ROUNDING = 1e-10  # of the variance at places, of which there are several


class VanishingKernel(CompositeKernel):
    r"""The covariance of a function that is zero wherever some inputs have given values.

    With a kernel that is a product :math:`k(x, x') = k_S(x_S, x'_S) \, k_R(x_R, x'_R)` over the
    inputs S that the values V are of, and all others R, it is that of :math:`g \sim GP(0, k)`
    given that :math:`g(x) = 0` for each x with :math:`x_S \in V`, whatever :math:`x_R`:

    .. math:: k_R(x_R, x'_R) \, [k_S(x_S, x'_S) - k_S(x_S, V) \, k_S(V, V)^{-1} k_S(V, x'_S)]

    (conditioning, Rasmussen and Williams 2006, eq. 2.19). One input makes V hyperplanes, all
    inputs points, of which any kernel will do.

    Args:
        base_kernel: k; an RBF kernel of all inputs, scaled or not, unless V is of all inputs.
        places: V, ``p x d``, with NaN in the columns R.

    Raises:
        ValueError: If V is none, of no column or not of the same in all rows, or k is no product.

    Example:
        >>> import torch
        >>> from gpytorch.kernels import RBFKernel
        >>> from gpadjust.gp import VanishingKernel
        >>> kernel = VanishingKernel(RBFKernel(), torch.tensor([[float("nan"), 1.0]]))
        >>> kernel(torch.tensor([[0.3, 1.0], [0.3, 2.0]]), diag=True).detach()
        tensor([0.0000, 0.8752])
    """

    places: Tensor

    def __init__(self, base_kernel: Kernel, places: Tensor) -> None:
        super().__init__()
        given = places.isfinite()
        if places.dim() != 2 or not given.any() or not (given == given[:1]).all():
            raise ValueError(
                "Expected places as p x d numbers, NaN in the same columns of each row and not in "
                f"all, got {places.tolist()}."
            )
        found = stationary_parts(base_kernel, places.shape[-1])
        if not given.all() and (found is None or found[2] is not RBF):
            raise ValueError(
                "A function that is zero wherever some of its inputs have given values needs an "
                f"RBF kernel, which is a product over inputs, got {type(base_kernel).__name__}; "
                "with values of all inputs any kernel will do."
            )
        self.base_kernel = base_kernel
        self.register_buffer("places", places.expand(*base_kernel.batch_shape, -1, -1).clone())

    @property
    def batch_shape(self) -> Size:
        """The batch shape of the base kernel."""
        return self.base_kernel.batch_shape

    @batch_shape.setter
    def batch_shape(self, batch_shape: Size) -> None:
        # BoTorch sets it for a subset of the outputs, after that of the base kernel.
        pass

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n``."""
        given, same = self._given, x2 is x1
        own = x1.where(given, 0.0)
        other = own if same else x2.where(given, 0.0)
        left = self._along(own)
        right = left if same else self._along(other)
        prior = to_dense(self.base_kernel(own, other, diag=diag))
        if diag:
            return (prior - (left * right).sum(-1)).clamp_min(0.0)
        zero = prior - left @ right.mT
        if bool(given.all()):
            return zero
        rest = to_dense(self.base_kernel(x1.where(~given, 0.0), x2.where(~given, 0.0)))
        origin = torch.zeros_like(x1[..., :1, :])
        return zero * rest / to_dense(self.base_kernel(origin, origin))

    def weights(self, x: Tensor) -> Tensor:
        """What the mean at ``x`` takes of the values at :meth:`moved` x: ``... x n x p``."""
        along = self._along(x.where(self._given, 0.0)).mT
        return torch.linalg.solve_triangular(self._factor().mT, along, upper=True).mT

    def moved(self, x: Tensor) -> Tensor:
        """The inputs ``... x n x d``, moved to each place: ``p x ... x n x d``."""
        places = self.places.movedim(-2, 0).unsqueeze(-2)
        return x.where(places.isnan(), places)

    @property
    def _given(self) -> Tensor:
        """Mask of the columns S, ``... x 1 x d``."""
        return self.places[..., :1, :].isfinite()

    def _along(self, own: Tensor) -> Tensor:
        """The covariance of x_S with what is zero, whitened: ``... x n x p``."""
        cross = to_dense(self.base_kernel(own, self.places.nan_to_num(nan=0.0)))
        return torch.linalg.solve_triangular(self._factor(), cross.mT, upper=False).mT

    def _factor(self) -> Tensor:
        """The Cholesky factor of the covariance of what is zero, ``... x p x p``; NaN if none."""
        places = self.places.nan_to_num(nan=0.0)
        square = to_dense(self.base_kernel(places, places))
        rounding = _ROUNDING if square.shape[-1] > 1 else 0.0
        square = square + rounding * torch.diag_embed(square.diagonal(dim1=-1, dim2=-2))
        factor, failed = torch.linalg.cholesky_ex(square)
        # Variances beyond what numbers hold have no covariance, and so no density.
        return factor.masked_fill(failed[..., None, None] > 0, torch.nan)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        """Refuse a state of other places."""
        own, theirs = self.places, state_dict.get(f"{prefix}places", self.places)
        if theirs.shape == own.shape and not torch.allclose(theirs, own, equal_nan=True):
            raise ValueError(
                "The state is of a function that is zero elsewhere than this one: at "
                f"{theirs.tolist()} and not at {own.tolist()}."
            )
        super()._load_from_state_dict(state_dict, prefix, *args)
