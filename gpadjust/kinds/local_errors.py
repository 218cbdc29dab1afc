"""Larger variances near left-out observations with larger errors than predicted."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

import torch
from torch import Tensor
from torch.nn import Buffer

from gpadjust.checks import check_kind
from gpadjust.core.data import ArrayLike
from gpadjust.core.gaussian import DRAWS, Marginals
from gpadjust.core.model import GP
from gpadjust.core.posterior import MixturePosterior
from gpadjust.core.stacked import Wrapper

_EXPECTED = 1.0  # a in the equation: observations with errors as predicted, added at each point
_ROUNDING = 1e-6  # of the targets' spread


class Widened(Wrapper):
    """A model whose variances, except known ones of noise, are multiplied by ``factors``."""

    numbers: tuple[str, ...]  # names of buffers with a row per output

    def __init__(self, model: GP) -> None:
        check_kind("model", model, GP, "a model of gpadjust.core, fitted")
        super().__init__([model.eval()])

    @abstractmethod
    def factors(self, X: Tensor) -> Tensor:
        """Return the factors at inputs ``... x q x d``, ``... x q x m``."""

    @property
    def model(self) -> GP:
        """The model."""
        model: GP = self.models[0]
        return model

    def components(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of each draw, ``... x S x q x m``."""
        mean, variance = self.model.components(X, observation_noise)
        scaled = variance
        if not self._scales_noise(observation_noise):
            scaled = self.model.components(X)[1]
        # known noise + factor * variance of the function
        factors = self.factors(self.data.new_inputs(X))
        return mean, variance + (factors - 1).unsqueeze(DRAWS) * scaled

    def mixture(
        self, X: ArrayLike, outputs: list[int] | slice, observation_noise: bool | Tensor
    ) -> MixturePosterior:
        """Return the joint posterior of some outputs."""
        mean, K = self.model.mixture(X, outputs, observation_noise).gaussians
        scaled = K
        if not self._scales_noise(observation_noise):
            scaled = self.model.mixture(X, outputs, False).gaussians[1]
        # K_ij + (sqrt(c_i c_j) - 1) K_ij, with factors c
        root = self.factors(self.data.new_inputs(X))[..., outputs].sqrt().mT.unsqueeze(-3)
        return MixturePosterior(mean, K + scaled * (root.unsqueeze(-1) * root.unsqueeze(-2) - 1))

    def _scales_noise(self, observation_noise: bool | Tensor) -> bool:
        """Return whether the factors apply to all of a variance, as it has no known noise."""
        is_unknown = observation_noise is True and self.model.noise.known is None
        return observation_noise is False or is_unknown

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; raise a ValueError for an unknown number."""
        new = super().subset_output(idcs)
        for name in self.numbers:
            setattr(new, name, getattr(self, name)[idcs])
        return new

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.model!r})"


class LocalErrors(Widened):
    r"""A fitted model with larger variances near left-out observations with large errors.

    Near a kink or a jump, as by dry friction or an impact, the variances of a process with a
    stationary kernel are too small. With :math:`z_i^2` the squared error of a left-out
    observation over its predicted variance, variances at x are multiplied by

    .. math:: \max\Big(1, \frac{a + \sum_i k(x, x_i) z_i^2}{a + \sum_i k(x, x_i)}\Big),

    with an RBF kernel k of the shortest lengthscale of all terms for each input, and a = 1.
    Locally weighted conformal prediction (Lei et al. 2018) has such a scale, too. Here there is no
    guarantee: left-out observations took part in the fit of hyper-parameters.

    Args:
        model: The fitted model; each of its kernels has a lengthscale for each input.

    Example:
        >>> from gpadjust.core import ZeroMeanGP
        >>> X = torch.linspace(0, 1, 9, dtype=torch.float64).unsqueeze(-1)
        >>> wider = LocalErrors(ZeroMeanGP(X, (X - 0.5).abs()))
        >>> bool((wider.predict(X).variance >= wider.model.predict(X).variance).all())
        True
    """

    numbers = ("squares", "lengthscale")

    @torch.no_grad()
    def __init__(self, model: GP) -> None:
        super().__init__(model)
        Y = model.on_gaussian_scale(self.data.Y)
        d = self.data.X.shape[-1]
        self.points = Buffer(model.kernel_inputs(self.data.X))  # n x d
        scales = [v for name, v in model.values.items() if name.endswith(".kernel.lengthscale")]
        has_kernels = sum(term.kernel is not None for term in model.terms)
        if len(scales) < has_kernels or any(v.shape[-1] != d for v in scales):
            raise ValueError(
                f"Expected kernels with a lengthscale for each of {d} inputs, such as "
                f"Stationary(MATERN52); found {[term.kernel for term in model.terms]}."
            )
        shortest = torch.stack(scales).amin(0).log().mean(0).exp()  # m x d
        self.lengthscale = Buffer(shortest.unsqueeze(-2))
        mean, variance = Marginals(*model.left_out()).prediction
        # z_i^2 = (y_i - m_i)^2 / v_i, with a floor of v_i for data without noise
        spread = _ROUNDING * (Y - Y.nanmean(-2, keepdim=True)).square().nanmean(-2).sqrt()
        squares = (Y - mean).square() / variance.maximum(spread.square())
        self.squares = Buffer(squares.nan_to_num(nan=1.0, posinf=1.0).mT)  # m x n

    def factors(self, X: Tensor) -> Tensor:
        """Return the factors at inputs ``... x q x d``, ``... x q x m``."""
        x = self.model.kernel_inputs(X).unsqueeze(-3) / self.lengthscale  # ... x m x q x d
        away = x.unsqueeze(-2) - (self.points / self.lengthscale).unsqueeze(-3)
        near = (-0.5 * away.square().sum(-1)).exp()  # ... x m x q x n
        total = (near @ self.squares.unsqueeze(-1)).squeeze(-1)
        # max(1, (a + sum_i k_i z_i^2) / (a + sum_i k_i))
        return ((_EXPECTED + total) / (_EXPECTED + near.sum(-1))).clamp_min(1.0).mT
