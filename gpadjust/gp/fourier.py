"""Random Fourier features and the kernel that they make."""

from __future__ import annotations

import math
from typing import Any

import torch
from gpytorch.constraints import Interval
from gpytorch.kernels import Kernel
from gpytorch.priors import Prior
from torch import Size, Tensor
from torch.nn import Module


class FourierFeatures(Module):
    r"""Random cosine features of an RBF kernel (Rahimi and Recht 2007),

    .. math:: \varphi_j(x) = \sqrt{2/D}\, \cos(\omega_j^T x + b_j), \quad
        \omega_j \sim N(0, I / \ell^2), \quad b_j \sim U(0, 2\pi),

    with the frequencies drawn once for :math:`\ell = 1`: the caller divides ``x`` by the
    lengthscale, which can then be learnt.

    Args:
        num_features: Number ``D`` of features.
        num_inputs: Number ``d`` of inputs.
        seed: Seed of the draw.
    """

    frequencies: Tensor
    phases: Tensor

    def __init__(self, num_features: int, num_inputs: int, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        draw: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
        self.register_buffer("frequencies", torch.randn(num_features, num_inputs, **draw))
        self.register_buffer("phases", 2 * math.pi * torch.rand(num_features, **draw))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``... x n x d`` (in lengthscales) to features ``... x n x D``."""
        angle = x @ self.frequencies.mT + self.phases
        return math.sqrt(2 / self.phases.numel()) * angle.cos()


class FourierKernel(Kernel):
    r"""The degenerate kernel :math:`k(x, x') = \varphi(x)^T \varphi(x')` of random features.

    A Gaussian process with it is Bayesian linear regression on :math:`\varphi` with weights
    :math:`N(0, I)`; it tends to the RBF kernel as the number of features grows.

    Args:
        features: The features; several batches (outputs) share the draw, not the lengthscale.
        ard_num_dims: Number of lengthscales, one per input, or one in all if left out.
        batch_shape: Batch shape of the lengthscales.
        lengthscale_prior: Prior of the lengthscales, or none.
        lengthscale_constraint: Constraint of the lengthscales; positive by default.
    """

    has_lengthscale = True

    def __init__(
        self,
        features: FourierFeatures,
        ard_num_dims: int | None = None,
        batch_shape: Size = Size(),  # noqa: B008
        lengthscale_prior: Prior | None = None,
        lengthscale_constraint: Interval | None = None,
        active_dims: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__(
            ard_num_dims=ard_num_dims,
            batch_shape=batch_shape,
            active_dims=active_dims,
            lengthscale_prior=lengthscale_prior,
            lengthscale_constraint=lengthscale_constraint,
        )
        self.features = features

    @property
    def is_stationary(self) -> bool:
        """False, as a finite sum of features is not stationary."""
        return False

    def feature_map(self, x: Tensor) -> Tensor:
        """Return the features ``... x n x D`` of ``x`` (``... x n x d``)."""
        values: Tensor = self.features(x / self.lengthscale)
        return values

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n``."""
        phi1 = self.feature_map(x1)
        phi2 = phi1 if torch.equal(x1, x2) else self.feature_map(x2)
        return (phi1 * phi2).sum(-1) if diag else phi1 @ phi2.mT
