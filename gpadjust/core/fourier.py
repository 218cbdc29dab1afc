"""The kernel of finitely many random Fourier features: a Bayesian linear model."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gpadjust.core.kernels import DELTA, RBF, Features, PullBack, Stationary, fourier_features
from gpadjust.core.unknowns import LogNormal, Values


class Fourier(Stationary):
    r"""The kernel :math:`\varphi(x)^T \varphi(x')` of finitely many random Fourier features.

    With it the process is a Bayesian linear model, ridge regression (Rahimi and Recht 2007).
    """

    def __init__(
        self, num_inputs: int, num_features: int, seed: int = 0, outputscale: LogNormal = DELTA
    ) -> None:
        super().__init__(RBF, outputscale)
        self.seed = seed
        generator = torch.Generator().manual_seed(seed)
        shape = (num_inputs, num_features // 2)
        self.frequencies = torch.randn(shape, generator=generator, dtype=torch.float64)

    def of_data(self, data: Any) -> Fourier:
        """Return the kernel of as many inputs as an input transform makes."""
        d = data.kernel_inputs(data.X[:1]).shape[-1]
        if d == len(self.frequencies):
            return self
        number = 2 * self.frequencies.shape[-1]
        return type(self)(d, number, self.seed, self.outputscale or DELTA)

    def covariance(self, own: Values, x: Tensor, other: Tensor | None = None) -> Tensor:
        """Return the inner products of the features."""
        phi = phi_other = fourier_features(own, x, self.frequencies)
        if other is not None:
            phi_other = fourier_features(own, other, self.frequencies)
        return phi @ phi_other.mT

    def with_pull_back(self, own: Values, x: Tensor) -> tuple[Tensor, PullBack]:
        """Return K and its derivatives in closed form."""
        w = self.frequencies.to(x)
        half = w.shape[-1]
        z = x / own["lengthscale"].unsqueeze(-2)
        a = z @ w
        phi = torch.cat([a.sin(), a.cos()], -1) / math.sqrt(half)
        k = phi @ phi.mT
        scale = own["outputscale"].unsqueeze(-1)

        def pull_back(D: Tensor) -> Values:
            # df / da = cos(a) df / dsin - sin(a) df / dcos, and a = w x / l
            by_phi = 2 * scale * D @ phi
            by_angle = by_phi[..., :half] * phi[..., half:] - by_phi[..., half:] * phi[..., :half]
            # da / dl = -w x / l^2
            by_length = -((by_angle @ w.mT) * z).sum(-2) / own["lengthscale"]
            return {"lengthscale": by_length, "outputscale": (D * k).sum((-1, -2)).unsqueeze(-1)}

        return scale * k, pull_back

    def features(self, own: Values, number: int, generator: torch.Generator) -> Features:
        """Return the kernel's own features; ``number`` is not used."""
        return lambda x: fourier_features(own, x, self.frequencies)
