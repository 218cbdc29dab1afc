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
from gpadjust.core.terms import Places, TermSum
from gpadjust.core.unknowns import Values

_SIZES = math.log(1e3)  # range of the logarithm of an outlier's standard deviation
_NEAR = 3.0  # standard deviations, nearer than which outliers are no more likely than there
_SUSPECT = 0.9  # of the largest of n standard normal numbers, for a row to be tried
_PATIENCE = 3  # sets of outliers that are tried after the best one
_MOST = 1 / 3  # of the observations are outliers


class RowNoise(Noise):
    """Another noise, and what rough fits have learnt of training rows; later ones have its base.

    Args:
        base: The noise of new observations. Default: one learnt variance of each output.
        added: What is added to the variances of the training targets, ``m x n``, in their unit
            squared.
        moved: What is added to their means, ``m x n``, in their unit.
    """

    of_targets = ("added", "moved")

    def __init__(
        self, base: Noise | None = None, added: Tensor | float = 0.0, moved: Tensor | float = 0.0
    ) -> None:
        self.base = Noise() if base is None else base
        if not isinstance(self.base, Noise):
            raise TypeError(
                f"Expected base as a noise, such as RelativeNoise(); found {base!r}. Known "
                "variances are a model's train_Yvar."
            )
        super().__init__(self.base.names, self.base.priors)
        self.known, self.shift = self.base.known, self.base.shift + moved
        self.added, self.moved = added, moved

    @property
    def settings(self) -> dict[str, Any]:
        """What builds it again; known variances are a model's train_Yvar."""
        is_default = type(self.base) is Noise and self.base.priors == Noise().priors
        base = None if is_default or isinstance(self.base, KnownNoise) else self.base
        return {"base": base, "added": self.added}

    def having(self, base: Noise, added: Tensor | float = 0.0, moved: Tensor | float = 0.0) -> Self:
        """Return the noise with another base and other numbers of rows."""
        new = copy(self)
        RowNoise.__init__(new, base, added, moved)
        return new

    def learnt(self, model: Any, fitted: Callable[[Noise], Any]) -> Self:
        """Return the noise with what rough fits show of each row, of a base that does so first."""
        zeros = torch.zeros_like(model.data.Y.mT)
        base = self.base.learnt(model, fitted)
        noise = self.having(base, zeros, zeros).refined(model, fitted)
        if base is self.base:
            return noise
        # With what is now known of the rows, the base learns more of them, and so on.
        base = base.learnt(model, lambda b: fitted(noise.having(b, noise.added, noise.moved)))
        return self.having(base, zeros, zeros).refined(model, fitted)

    @abstractmethod
    def refined(self, model: Any, fitted: Callable[[Noise], Any]) -> Self:
        """Return the noise with numbers of rows, by rough fits that begin with none."""

    @property
    def has_shares(self) -> bool:
        """Whether the variances of the base depend on x."""
        return self.base.has_shares

    @property
    def is_outlier(self) -> Tensor | None:
        """Mask ``n x m`` of the outliers of the base."""
        return self.base.is_outlier

    def shares(self, places: Places) -> Tensor | None:
        """Return the shares of the base."""
        return self.base.shares(places)

    def variance(self, values: Values, places: Places, is_training: bool = False) -> Tensor:
        """Return the variances of the base; of training rows with what is added."""
        variance = self.base.variance(values, places, is_training)
        return variance + self.added if is_training else variance

    def pull_back(self, values: Values, places: Places, by: Tensor) -> Values:
        """Return the derivatives by the numbers of the base."""
        return self.base.pull_back(values, places, by)

    def of_terms(self, terms: TermSum) -> Self:
        """Return the noise for a model of these terms."""
        return self.mapped(lambda v: v, "of_terms", terms)

    def with_known(self, known: KnownNoise) -> Self:
        """Return the noise with known variances in place of a learnt one."""
        is_plain = type(self.base) in (Noise, KnownNoise)
        base = known if is_plain else self.base.with_known(known)
        return self.having(base, self.added, self.moved)

    def appended(self, variances: Tensor | None, num_points: int) -> Self:
        """Return the noise of further rows, too."""
        return self.mapped(lambda v: pad(v, (0, num_points)), "appended", variances, num_points)

    def mapped(self, change: Callable[[Tensor], Tensor], method: str, *arguments: Any) -> Any:
        """Return the noise with other numbers of rows and another base; None if that is None."""
        new = super().mapped(change, method, *arguments)
        return None if new.base is None else self.having(new.base, new.added, new.moved)


class HeavyTails(RowNoise):
    r"""Outliers among the observations: their noise is larger by any factor.

    An observation is an outlier with a probability :math:`\pi`; the logarithm of the standard
    deviation of its error is then uniform over three decades, so that the density of a residual r
    from what the others predict is :math:`1 / (2 |r| \log 10^3)`. Which ones are outliers is
    searched greedily by rough fits, as in relevance pursuit (Ament et al. 2024): the rows with the
    largest left-out residuals are taken out, the other numbers fitted again, and of all sets so
    found the likeliest is kept. In a fit outliers have variances by which their densities are
    :math:`\pi` times the one above.

    Args:
        share: :math:`\pi`.
        base: The noise of other observations. Default: one learnt variance of each output, or a
            model's ``train_Yvar``.
        added: What a fit has learnt, variances ``m x n`` of the outliers.

    Example:
        >>> import torch
        >>> from gpadjust.core import CKA, fit
        >>> X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)
        >>> Y = 2 * torch.sin(6 * X) + 0.01 * torch.cos(99 * X)
        >>> Y[5] += 3
        >>> model = CKA(X, Y, physics=lambda X: torch.sin(6 * X), noise=HeavyTails())
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
        """What builds it again."""
        return super().settings | {"share": self.share}

    @property
    def is_outlier(self) -> Tensor | None:
        """Mask ``n x m`` of the training targets that the fit takes for outliers."""
        return (self.added > 0).mT if isinstance(self.added, Tensor) else None

    @torch.no_grad()
    def outliers(self, model: Any) -> Tensor:
        """Return the probability that each training target is an outlier, ``n x m``.

        It is by what all others predict, over all draws of the fitted model; 0 of missing targets.
        """
        found = self._left_out(model)
        odds = found.tails.logsumexp(0) - found.normal.logsumexp(0)
        return odds.sigmoid().mT.masked_fill(model.data.Y.isnan(), 0.0)

    @torch.no_grad()
    def refined(self, model: Any, fitted: Callable[[Noise], Any]) -> Self:
        """Return the noise with the likeliest outliers that a greedy search finds."""
        noise, densities, tried = self, [], []
        while True:
            model = fitted(noise)
            found = noise._left_out(model)
            outlying = torch.as_tensor(noise.added > 0)
            density = model.log_likelihood(model.u, False)[0][0]
            density = density - 0.5 * model.u[0].square().sum(-1)
            # The densities by the tails in place of those in the fit.
            exchanged = ((found.tails - found.in_fit)[0] * outlying).sum(-1)
            is_own = len(density) == len(outlying)  # else outputs share unknown numbers
            density = density + (exchanged if is_own else exchanged.sum())
            densities.append(density.expand(len(outlying)))
            tried.append(outlying * found.spread[0])
            best, sets = torch.stack(densities).argmax(0), torch.stack(tried) > 0
            # Outliers that remain, and the rows that are farthest off: one, or a fourth of those
            # that are likely, as neighbours of an outlier may seem so, too.
            is_likely, z = (found.tails > found.normal)[0], found.z[0].masked_fill(outlying, 0.0)
            is_suspect = z > _SUSPECT * math.sqrt(2 * math.log(z.shape[-1]))
            number = 1 + (is_likely & is_suspect).sum(-1, keepdim=True) // 4
            is_first = z.argsort(-1, descending=True).argsort(-1) < number
            following = (outlying & is_likely) | (is_suspect & is_first)
            is_done = (sets == following).all(-1).any(0) | (len(tried) - best > _PATIENCE)
            is_done |= following.sum(-1) > _MOST * following.shape[-1]
            if is_done.all():
                chosen = torch.stack([tried[i][j] for j, i in enumerate(best.tolist())])
                return self.having(self.base, chosen)
            following = torch.where(is_done.unsqueeze(-1), outlying, following)
            noise = self.having(self.base, following * found.spread[0])

    def _left_out(self, model: Any) -> _LeftOut:
        values, conditioning = model.values, model.conditioning()
        noise = self.base.variance(values, model.places(model.data.X, values), True)
        mean, in_fit = conditioning.left_out()
        residual = (conditioning.targets - mean).nan_to_num()
        variance = (in_fit - self.added).maximum(noise).nan_to_num(nan=1.0)
        size = residual.abs().maximum(_NEAR * variance.sqrt())
        inverse = 2 * _SIZES / self.share * size  # of the density of an outlier
        return _LeftOut(
            tails=-inverse.log(),
            normal=_log_normal(residual, variance) + math.log1p(-self.share),
            in_fit=_log_normal(residual, in_fit.nan_to_num(nan=1.0)),
            z=residual.abs() / variance.sqrt(),
            spread=inverse.square() / (2 * math.pi),
        )


class _LeftOut(NamedTuple):
    """Each training target by what all others predict, ``S x m x n``."""

    tails: Tensor  # log density, if it is an outlier
    normal: Tensor  # and if it is not
    in_fit: Tensor  # and with the variance that it has in the fit
    z: Tensor  # residual in standard deviations
    spread: Tensor  # variance of an outlier of the density by the tails


def _log_normal(residual: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * (residual.square() / variance + (2 * math.pi * variance).log())
