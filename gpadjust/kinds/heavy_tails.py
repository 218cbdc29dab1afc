"""Noise with heavy tails: each observation may be an outlier."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from gpadjust.checks import checked_number
from gpadjust.core import KnownNoise, Noise
from gpadjust.core.data import Data
from gpadjust.core.terms import Places, TermSum
from gpadjust.core.unknowns import Values

_SIZES = math.log(1e3)  # range of the logarithm of an outlier's standard deviation
_NEAR = 3.0  # standard deviations; the density of outliers is constant below
_SUSPECT = 0.9  # threshold, as a share of the expected maximum of n standard normal numbers
_PATIENCE = 3  # sets of outliers to try after the best one
_MOST = 1 / 3  # largest share of outliers


class RowNoise(Noise):
    """A noise with corrections of variances and means of training rows, by rough fits.

    The base is the noise of new observations; corrections are ``m x n``, in units.
    """

    of_targets = ("added", "moved")

    def __init__(
        self, base: Noise | None = None, added: Tensor | float = 0.0, moved: Tensor | float = 0.0
    ) -> None:
        if base is None:
            base = Noise()
        if not isinstance(base, Noise):
            raise TypeError(
                f"Expected base as a noise, such as RelativeNoise(); found {base!r}. Known "
                "variances are a model's train_Yvar."
            )
        super().__init__(base.names, base.priors)
        self.base = base
        self.known = base.known
        self.shift = base.shift + moved
        self.added, self.moved = added, moved

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments; known variances are a model's train_Yvar, not a base."""
        is_default = type(self.base) is Noise and self.base.priors == Noise().priors
        base = None if is_default or isinstance(self.base, KnownNoise) else self.base
        return {"base": base, "added": self.added}

    def having(self, base: Noise, added: Tensor | float = 0.0, moved: Tensor | float = 0.0) -> Self:
        """Return the noise with another base and other corrections."""
        new = copy(self)
        RowNoise.__init__(new, base, added, moved)
        return new

    def learnt(self, model: Any, fitted: Callable[[Noise], Any]) -> Self:
        """Return the noise with corrections by rough fits; estimate the base first."""
        zeros = torch.zeros_like(model.data.Y.mT)
        base = self.base.learnt(model, fitted)
        noise = self.having(base, zeros, zeros).refined(model, fitted)
        if base is self.base:
            return noise
        # Outliers have distorted the base: estimate it again with the corrections, and then these.
        base = base.learnt(model, lambda b: fitted(noise.having(b, noise.added, noise.moved)))
        return self.having(base, zeros, zeros).refined(model, fitted)

    @abstractmethod
    def refined(self, model: Any, fitted: Callable[[Noise], Any]) -> Self:
        """Return the noise with corrections by rough fits, the first without corrections."""

    @property
    def has_shares(self) -> bool:
        """True if the variances of the base depend on x."""
        return self.base.has_shares

    @property
    def is_outlier(self) -> Tensor | None:
        """Mask ``n x m`` of the outliers of the base."""
        return self.base.is_outlier

    def shares(self, places: Places) -> Tensor | None:
        """Return the shares of the base."""
        return self.base.shares(places)

    def variance(self, values: Values, places: Places, is_training: bool = False) -> Tensor:
        """Return the variances of the base, corrected at training rows."""
        variance = self.base.variance(values, places, is_training)
        return variance + self.added if is_training else variance

    def of_data(self, data: Data, terms: TermSum) -> Self:
        """Return the noise for a model's data and terms."""
        return self.mapped(lambda v: v, "of_data", data, terms)

    def with_known(self, known: KnownNoise) -> Self:
        """Return the noise with known variances in place of an unknown one."""
        is_plain = type(self.base) in (Noise, KnownNoise)
        base = known if is_plain else self.base.with_known(known)
        return self.having(base, self.added, self.moved)

    def appended(self, variances: Tensor | None, num_points: int) -> Self:
        """Return the noise with further rows, which have no corrections."""
        return self.mapped(lambda v: pad(v, (0, num_points)), "appended", variances, num_points)

    def mapped(self, change: Callable[[Tensor], Tensor], method: str, *arguments: Any) -> Any:
        """Return the noise with changed corrections and base; None if the base becomes None."""
        new = super().mapped(change, method, *arguments)
        return None if new.base is None else self.having(new.base, new.added, new.moved)


class HeavyTails(RowNoise):
    r"""Noise with outliers, whose errors are larger by any factor.

    An observation is an outlier with the probability :math:`\pi`. The logarithm of the standard
    deviation of its error is then uniform over three decades, so that a residual r from the
    left-out prediction has the density :math:`1 / (2 |r| \log 10^3)`; in a fit, the variance of an
    outlier gives it :math:`\pi` times this density. A greedy search by rough fits finds the
    outliers, as in relevance pursuit (Ament et al. 2024).

    Args:
        share: :math:`\pi`.
        base: The noise of other observations, such as :class:`RelativeNoise`. Default: one unknown
            variance for each output, or a model's ``train_Yvar``.
        added: Variances ``m x n`` of the outliers, set by a fit.

    Example:
        >>> import torch
        >>> from gpadjust.core import CKA, fit
        >>> X = torch.linspace(0, 6, 12, dtype=torch.float64).unsqueeze(-1)
        >>> Y = 2 * X.sin() + 0.01 * torch.cos(16 * X)
        >>> Y[5] += 3
        >>> model = CKA(X, Y, physics=torch.sin, noise=HeavyTails())
        >>> result = fit(model)
        >>> (model.noise.outliers(model) > 0.5).nonzero()[:, 0].tolist()
        [5]
    """

    def __init__(
        self, share: float = 0.02, base: Noise | None = None, added: Tensor | float = 0.0
    ) -> None:
        super().__init__(base, added)
        self.share = checked_number("share", share, above=0.0, below=0.5)

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments."""
        return super().settings | {"share": self.share}

    @property
    def is_outlier(self) -> Tensor | None:
        """Mask ``n x m`` of the outliers among the training targets; None before a fit."""
        return (self.added > 0).mT if isinstance(self.added, Tensor) else None

    @torch.no_grad()
    def outliers(self, model: Any) -> Tensor:
        """Return the probability of each training target to be an outlier, ``n x m``."""
        left_out = self._left_out(model)
        odds = left_out.tails.logsumexp(0) - left_out.normal.logsumexp(0)
        return odds.sigmoid().mT.masked_fill(model.data.Y.isnan(), 0.0)

    @torch.no_grad()
    def refined(self, model: Any, fitted: Callable[[Noise], Any]) -> Self:
        """Return the noise with the likeliest set of outliers of a greedy search."""
        noise = self
        densities: list[Tensor] = []
        variances: list[Tensor] = []  # of the outliers of each set, 0 for other rows
        while True:
            # Fit the other numbers, and score the set by its posterior density.
            model = fitted(noise)
            left_out = noise._left_out(model)
            outlying = torch.as_tensor(noise.added > 0)
            density = model.log_likelihood(model.u, False)[0][0]
            density = density - 0.5 * model.u[0].square().sum(-1)
            # Outliers have the density of the tails, not that of the variance in the fit.
            exchanged = ((left_out.tails - left_out.in_fit)[0] * outlying).sum(-1)
            if len(density) != len(outlying):  # outputs share unknown numbers
                exchanged = exchanged.sum()
            densities.append((density + exchanged).expand(len(outlying)))
            variances.append(outlying * left_out.spread[0])
            best = torch.stack(densities).argmax(0)
            sets = torch.stack(variances) > 0
            # The next set has the outliers that are still likely, and the rows with the largest
            # residuals: one, or a quarter of the likely ones, as neighbours of an outlier may have
            # large residuals, too.
            is_likely = (left_out.tails > left_out.normal)[0]
            z = left_out.z[0].masked_fill(outlying, 0.0)
            # sqrt(2 log n) is the expected maximum of n standard normal numbers.
            is_suspect = z > _SUSPECT * math.sqrt(2 * math.log(z.shape[-1]))
            number = 1 + (is_likely & is_suspect).sum(-1, keepdim=True) // 4
            is_first = z.argsort(-1, descending=True).argsort(-1) < number
            following = (outlying & is_likely) | (is_suspect & is_first)
            # An output is done if its set repeats, has not improved for a while, or is too large.
            is_done = (sets == following).all(-1).any(0)
            is_done |= len(variances) - best > _PATIENCE
            is_done |= following.sum(-1) > _MOST * following.shape[-1]
            if is_done.all():
                likeliest = torch.stack([variances[i][j] for j, i in enumerate(best.tolist())])
                return self.having(self.base, likeliest)
            following = torch.where(is_done.unsqueeze(-1), outlying, following)
            noise = self.having(self.base, following * left_out.spread[0])

    def _left_out(self, model: Any) -> _LeftOut:
        """Return the left-out predictions of a model, with and without an outlier at each row."""
        values = model.values
        conditioning = model.conditioning()
        noise = self.base.variance(values, model.places(model.data.X, values), True)
        mean, in_fit = conditioning.left_out()
        residual = (conditioning.targets - mean).nan_to_num()
        # The variance of the row if it is not an outlier; rounding may take off too much.
        variance = (in_fit - self.added).maximum(noise).nan_to_num(nan=1.0)
        # Density of an outlier: pi / (2 |r| log 10^3).
        size = residual.abs().maximum(_NEAR * variance.sqrt())
        inverse = 2 * _SIZES / self.share * size
        return _LeftOut(
            tails=-inverse.log(),
            normal=_log_normal(residual, variance) + math.log1p(-self.share),
            in_fit=_log_normal(residual, in_fit.nan_to_num(nan=1.0)),
            z=residual.abs() / variance.sqrt(),
            # N(0, v) has at 0 the density 1 / sqrt(2 pi v), which is to be 1 / inverse.
            spread=inverse.square() / (2 * math.pi),
        )


class _LeftOut(NamedTuple):
    """Left-out predictions of the training targets, ``S x m x n``."""

    tails: Tensor  # log density of an outlier
    normal: Tensor  # log density of any other row
    in_fit: Tensor  # log density with the variance in the fit
    z: Tensor  # residual in standard deviations
    spread: Tensor  # variance of a normal distribution with the density of the tails


def _log_normal(residual: Tensor, variance: Tensor) -> Tensor:
    # log N(r; 0, v) = -(r^2 / v + log(2 pi v)) / 2
    return -0.5 * (residual.square() / variance + (2 * math.pi * variance).log())
