"""Inputs that were measured with noise, which the slope of the function carries to the targets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from gpadjust.core import Noise
from gpadjust.core.data import ArrayLike, as_given, as_tensor, names_of, variances_of
from gpadjust.kinds.heavy_tails import RowNoise
from gpadjust.physics import PhysicsError

Function = Callable[[Tensor], Tensor]

_SPREAD = (3.0**0.5, 1.0, 0.5, 0.1)  # differences, in standard deviations of a true input
_SETTLED = (0.05, 0.1)  # change of variances, relative, and of means, in standard deviations
_ROUNDS = 8


class NoisyInputs(RowNoise):
    r"""Inputs that were measured with independent Gaussian errors of known variances S.

    The true inputs of a column have the mean and variance of the measured ones, less S. Given a
    measured input x, the true one then has the mean :math:`\hat x = \bar x + \lambda (x - \bar x)`
    and the variance :math:`P = \lambda S`, with :math:`\lambda` the share of the variance that is
    not error (regression calibration: Fuller 1987; Carroll et al. 2006). A model is one of
    :math:`\hat x`, the attribute ``X``, and a target has, in addition to its noise,

    .. math::

        \mathrm{E} = f(\hat x) + \tfrac12 \sum_j P_j \partial_j^2 f, \quad
        \mathrm{Var} = \sum_j P_j (\partial_j f)^2 + \tfrac12 (P_j \partial_j^2 f)^2,

    of which the first part of the variance is that of McHutchon and Rasmussen (2011). The slopes
    are of f_p at first, and then of the posterior mean of rough fits, by differences over
    :math:`\pm \sqrt{3 P_j}`, which are exact up to the fifth order for both sums of each input.
    Observations that are added later have exact inputs.

    Args:
        train_X: The measured inputs, ``n x d``: a float64 tensor, an array or a frame.
        variances: S: one number, ``d``, or of the shape of the inputs; 0 of exact ones.
        base: The noise of the targets. Default: one learnt variance of each output, or a model's
            ``train_Yvar``.
        added: What a fit has learnt, variances ``m x n``, as ``moved``, means.

    Attributes:
        X: The means of the true inputs, as ``train_X`` came: what a model is built with.

    Example:
        >>> import torch
        >>> from gpadjust.core import CKA, fit
        >>> X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)
        >>> noisy = NoisyInputs(X, 0.03**2)
        >>> model = CKA(noisy.X, X.exp(), physics=lambda X: 1 + X, noise=noisy)
        >>> result = fit(model)
        >>> bool((model.noise.added > 0).all())
        True
    """

    def __init__(
        self, train_X: ArrayLike, variances: ArrayLike, base: Noise | None = None,
        added: Tensor | float = 0.0, moved: Tensor | float = 0.0,
    ) -> None:  # fmt: skip
        super().__init__(base, added, moved)
        X = as_tensor(train_X, "train_X").reshape(len(train_X), -1)
        S, names = variances_of(variances, X, "variances"), names_of(train_X, "x")
        is_bad = (S.mean(-2) >= X.var(-2)) & (X.var(-2) > 0)
        if is_bad.any():
            raise ValueError(
                f"Expected variances below that of the measured inputs themselves, {X.var(-2)}; "
                f"found as large ones of {', '.join(names[i] for i in is_bad.nonzero())}. They are "
                "in the square of the inputs' units, not standard deviations."
            )
        mean, true = X.mean(-2), X.var(-2) - S.mean(-2)
        share = (true / (true + S)).where(S > 0, 1.0)
        self.inputs = (X, S)
        self.points = (mean + share * (X - mean)).where(S > 0, X)
        self.spread = (share * S).sqrt()  # standard deviations of the true inputs
        self.X = as_given(self.points, train_X, names)

    @property
    def settings(self) -> dict[str, Any]:
        """What builds it again."""
        X, S = self.inputs
        return super().settings | {"train_X": X, "variances": S, "moved": self.moved}

    @torch.no_grad()
    def refined(self, model: Any, fitted: Callable[[Noise], Any]) -> NoisyInputs:
        """Return the noise with the moments of the function over the errors of its inputs."""
        n, X = len(self.points), model.data.X
        if not torch.equal(X[:n], self.points.to(X)):
            raise ValueError(
                f"Expected a model of the {n} inputs NoisyInputs.X; found others, such as the "
                "measured ones. Build it with CKA(noisy.X, Y, physics=f_p, noise=noisy)."
            )

        def posterior_mean(X: Tensor) -> Tensor:
            return rough.conditioning().mean(rough.at(X))[0][0]

        spread = pad(self.spread.to(X), (0, 0, 0, len(X) - n))
        rough = fitted(self)
        mean, variance = _moments(lambda X: rough.at(X).mean[0], X, spread)
        if not variance.any():  # a prior mean without slope
            mean, variance = _moments(posterior_mean, X, spread)
        for _ in range(_ROUNDS if variance.any() else 0):
            before = torch.stack([variance, mean])
            rough = fitted(self.having(self.base, variance, mean))
            mean, variance = _moments(posterior_mean, X, spread)
            noise = rough.conditioning().noise[0] - before[0]
            off = (variance - before[0]).abs() / (before[0] + noise)  # 0 / 0 of exact rows
            away = (mean - before[1]).abs() / (variance + noise).sqrt()
            if off.nanmean() <= _SETTLED[0] and away.nan_to_num().max() <= _SETTLED[1]:
                break
        return self.having(self.base, variance, mean)


def _moments(function: Function, X: Tensor, spread: Tensor) -> tuple[Tensor, Tensor]:
    """Return the means of a function, less its values at the points, and variances, ``m x n``."""
    here = function(X)
    mean, variance = torch.zeros_like(here), torch.zeros_like(here)
    for j in spread.any(0).nonzero().flatten().tolist():
        step = torch.zeros_like(X)
        step[:, j] = spread[:, j]
        for width in _SPREAD:  # smaller where f_p fails
            try:
                up, down = (function(X + sign * width * step) - here for sign in (1, -1))
                break
            except PhysicsError:
                if width == _SPREAD[-1]:
                    raise
        mean = mean + (up + down) / (2 * width**2)
        variance = variance + (up - down).square() / (4 * width**2)
        variance = variance + (up + down).square() / (2 * width**4)
    return mean, variance
