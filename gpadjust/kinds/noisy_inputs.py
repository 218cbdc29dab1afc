"""Inputs measured with noise, which the slope of the function carries to the targets."""

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

_WIDTHS = (3.0**0.5, 1.0, 0.5, 0.1)  # of differences, in standard deviations of a true input
_VARIANCE_CHANGE = 0.05  # mean relative change at which the iteration ends
_MEAN_CHANGE = 0.1  # largest change at which it ends, in standard deviations
_ROUNDS = 8


class NoisyInputs(RowNoise):
    r"""Inputs measured with independent Gaussian errors of known variances S.

    The true inputs of a column have the mean of the measured inputs, and their variance less S.
    Given a measured input x, the true one then has the mean
    :math:`\hat x = \bar x + \lambda (x - \bar x)` and the variance :math:`P = \lambda S`, with
    :math:`\lambda` the share of the variance that is not error (regression calibration: Fuller
    1987; Carroll et al. 2006). Build a model of :math:`\hat x`, the attribute ``X``. A target then
    has, in addition to its noise,

    .. math::

        \mathrm{E} = f(\hat x) + \tfrac12 \sum_j P_j \partial_j^2 f, \quad
        \mathrm{Var} = \sum_j P_j (\partial_j f)^2 + \tfrac12 (P_j \partial_j^2 f)^2.

    The first part of the variance is that of McHutchon and Rasmussen (2011). f is f_p at first,
    and then the posterior mean of rough fits. Later observations have exact inputs.

    Args:
        train_X: The measured inputs, ``n x d``: a float64 tensor, an array or a frame.
        variances: S: one number, ``d``, or the shape of the inputs; 0 for exact inputs.
        base: The noise of the targets. Default: one unknown variance for each output, or a model's
            ``train_Yvar``.
        added: Variances ``m x n``, set by a fit.
        moved: Means ``m x n``, set by a fit.

    Attributes:
        X: The means of the true inputs, of the type of ``train_X``, for the model.

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
        S = variances_of(variances, X, "variances")
        names = names_of(train_X, "x")
        is_bad = (S.mean(-2) >= X.var(-2)) & (X.var(-2) > 0)
        if is_bad.any():
            raise ValueError(
                f"Expected variances below the variances of the measured inputs, {X.var(-2)}; "
                f"found larger ones of {', '.join(names[i] for i in is_bad.nonzero())}. They are "
                "in the square of the inputs' units, not standard deviations."
            )
        # lambda = Var / (Var + S), with the variance Var of the true inputs
        mean = X.mean(-2)
        true_variance = X.var(-2) - S.mean(-2)
        share = (true_variance / (true_variance + S)).where(S > 0, 1.0)
        self.inputs = (X, S)
        self.points = (mean + share * (X - mean)).where(S > 0, X)
        self.spread = (share * S).sqrt()  # sqrt(P)
        self.X = as_given(self.points, train_X, names)

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments."""
        X, S = self.inputs
        return super().settings | {"train_X": X, "variances": S, "moved": self.moved}

    @torch.no_grad()
    def refined(self, model: Any, fitted: Callable[[Noise], Any]) -> NoisyInputs:
        """Return the noise with the moments of the function over the errors of its inputs."""
        X = model.data.X
        n = len(self.points)
        if not torch.equal(X[:n], self.points.to(X)):
            raise ValueError(
                f"Expected a model of the {n} inputs NoisyInputs.X; found others, such as the "
                "measured inputs. Build it with CKA(noisy.X, Y, physics=f_p, noise=noisy)."
            )

        def posterior_mean(X: Tensor) -> Tensor:
            return rough.conditioning().mean(rough.evaluate(X))[0][0]

        spread = pad(self.spread.to(X), (0, 0, 0, len(X) - n))
        rough = fitted(self)
        mean, variance = _moments(lambda X: rough.evaluate(X).mean[0], X, spread)
        if not variance.any():  # a prior mean without slope
            mean, variance = _moments(posterior_mean, X, spread)
        if not variance.any():
            return self.having(self.base, variance, mean)
        # The slopes depend on the fit, and the fit on the variances by the slopes: iterate.
        for _ in range(_ROUNDS):
            old_mean, old_variance = mean, variance
            rough = fitted(self.having(self.base, variance, mean))
            mean, variance = _moments(posterior_mean, X, spread)
            noise = rough.conditioning().noise[0] - old_variance
            variance_change = (variance - old_variance).abs() / (old_variance + noise)
            mean_change = (mean - old_mean).abs() / (variance + noise).sqrt()
            # Rows with exact inputs and observations are 0 / 0.
            is_settled = variance_change.nanmean() <= _VARIANCE_CHANGE
            if is_settled and mean_change.nan_to_num().max() <= _MEAN_CHANGE:
                break
        return self.having(self.base, variance, mean)


def _moments(function: Function, X: Tensor, spread: Tensor) -> tuple[Tensor, Tensor]:
    """Return E f - f and Var f over the errors of the inputs, ``m x n``."""
    center = function(X)
    mean, variance = torch.zeros_like(center), torch.zeros_like(center)
    for j in spread.any(0).nonzero().flatten().tolist():
        step = torch.zeros_like(X)
        step[:, j] = spread[:, j]
        for width in _WIDTHS:  # a smaller one where f_p fails
            try:
                up, down = (function(X + sign * width * step) - center for sign in (1, -1))
                break
            except PhysicsError:
                if width == _WIDTHS[-1]:
                    raise
        # With h = w sqrt(P): up - down = 2 h f', up + down = h^2 f'', so that
        # P f'' / 2 = (up + down) / (2 w^2)
        mean = mean + (up + down) / (2 * width**2)
        # P f'^2 = (up - down)^2 / (4 w^2), and (P f'')^2 / 2 = (up + down)^2 / (2 w^4)
        variance = variance + (up - down).square() / (4 * width**2)
        variance = variance + (up + down).square() / (2 * width**4)
    return mean, variance
