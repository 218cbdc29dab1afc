"""Links: outputs with bounds, which a model without bounds is made of."""

from __future__ import annotations

import math
from typing import Any

import torch
from botorch.models.transforms.outcome import Log, OutcomeTransform, Standardize
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.posteriors.transformed import TransformedPosterior
from torch import Tensor

from gpadjust.models.posteriors import mixture_moments, mixture_quantile
from gpadjust.models.training_data import TrainingData

_NODES = torch.linspace(-8.5, 8.5, 129, dtype=torch.float64)  # of the trapezoidal rule
NAMED = {"log": (0.0, math.inf), "logit": (0.0, 1.0)}


class Logit(OutcomeTransform):
    r"""The link :math:`g(y) = \log \frac{y - a}{b - y}` of an output between bounds a and b.

    A model with it is one of :math:`g(y)` with the physics :math:`g(f_p)`, and answers in the
    user's units: predictions, intervals and functions stay within the bounds. With :math:`b =
    \infty` it is :math:`\log(y - a)`: rho is an exponent then, and errors are relative.

    Args:
        lower: The bound a.
        upper: The bound b.

    Raises:
        TypeError: If a bound is no number.
        ValueError: If a is infinite, or not below b.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, fit
        >>> from gpadjust.models import Logit
        >>> X = torch.linspace(0.1, 2, 8, dtype=torch.float64).unsqueeze(-1)
        >>> share = 1 - (-X).exp()
        >>> model = CKA(X, share, physics=lambda X: X / (1 + X), outcome_transform=Logit(0, 1))
        >>> result = fit(model)
        >>> lower, upper = model.interval(torch.tensor([[0.0001], [9.0]]).double())
        >>> bool((lower > 0).all() and (upper < 1).all())
        True
    """

    def __init__(self, lower: float = 0.0, upper: float = 1.0) -> None:
        super().__init__()
        given = {"lower": lower, "upper": upper}
        if any(isinstance(v, bool) or not isinstance(v, int | float) for v in given.values()):
            raise TypeError(f"Expected bounds as two numbers, got {lower!r} and {upper!r}.")
        self.lower, self.upper = float(lower), float(upper)
        if not (math.isfinite(self.lower) and self.lower < self.upper):
            raise ValueError(
                f"Expected a finite lower bound below the upper one, got {lower} and {upper}; for "
                "an output with an upper bound alone, model its distance from that."
            )

    @classmethod
    def of(cls, given: Any) -> Logit | None:
        """The link that is meant: BoTorch's ``Log``, a name, two bounds, or a link.

        None for what is none. A ValueError for a ``Log`` of some outputs only, or another name.
        """
        if isinstance(given, str) and given not in NAMED:
            raise ValueError(
                f"Unknown outcome_transform {given!r}; expected {', '.join(map(repr, NAMED))}, a "
                "pair of bounds, Log, Logit, Standardize or None."
            )
        if isinstance(given, Log):
            if given._outputs is not None:
                raise ValueError(
                    f"Expected Log of all outputs, got outputs {given._outputs} alone; make a "
                    "model of each output, and a ModelListGP of them."
                )
            given = "log"
        if isinstance(given, str):
            given = NAMED[given]
        if isinstance(given, tuple | list):
            if len(given) != 2:
                raise ValueError(f"Expected two bounds as outcome_transform, got {given!r}.")
            return cls(*given)
        return given if isinstance(given, Logit) else None

    @property
    def bounds(self) -> tuple[float, float]:
        """Both bounds, as a file has them."""
        return self.lower, self.upper

    @property
    def formula(self) -> str:
        """The link as a formula of y."""
        above = f"y - {self.lower:g}" if self.lower else "y"
        if math.isinf(self.upper):
            return f"log({above})"
        above = f"({above})" if self.lower else above
        return f"log({above} / ({self.upper:g} - y))"

    @property
    def where(self) -> str:
        """The values that it takes, in words."""
        above = f"above {self.lower:g}"
        return above if math.isinf(self.upper) else f"{above} and below {self.upper:g}"

    def holds(self, y: Tensor) -> Tensor:
        """Which values are within the bounds."""
        return (y > self.lower) & (y < self.upper)

    def value(self, y: Tensor) -> Tensor:
        """The link g of values; NaN stays, and the bounds are infinite."""
        above = (y - self.lower).clamp_min(0.0).log()
        return above if math.isinf(self.upper) else above - (self.upper - y).clamp_min(0.0).log()

    def inverse(self, z: Tensor) -> Tensor:
        """The reverse of :meth:`value`."""
        if math.isinf(self.upper):
            return self.lower + z.exp()
        return self.lower + (self.upper - self.lower) * z.sigmoid()

    def log_slope(self, y: Tensor) -> Tensor:
        """The logarithm of the derivative of g."""
        above = (y - self.lower).log()
        if math.isinf(self.upper):
            return -above
        return math.log(self.upper - self.lower) - above - (self.upper - y).log()

    def moments(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of y of normal g(y): in closed form for a logarithm.

        Otherwise by the trapezoidal rule over 17 standard deviations, whose error is below 1e-6 of
        the distance of the bounds up to a standard deviation of 20.
        """
        if math.isinf(self.upper):
            size = (mean + variance / 2).exp()
            return self.lower + size, size.square() * variance.expm1()
        sd, middle = variance.sqrt(), self.inverse(mean)
        weights = (-_NODES.square() / 2).softmax(0).tolist()
        first, second = torch.zeros_like(mean), torch.zeros_like(mean)
        for node, weight in zip(_NODES.tolist(), weights, strict=True):
            away = self.inverse(mean + node * sd) - middle  # not y itself, which would cancel
            first, second = first + weight * away, second + weight * away.square()
        return middle + first, (second - first.square()).clamp_min(0.0)

    def of_data(self, data: TrainingData) -> TrainingData:
        """Data with the link of targets; a ValueError if one is not within the bounds."""
        checked_within(self, data.Y, "train_Y")
        Y, Yvar = self(data.Y, data.Yvar)
        return data._replace(Y=Y, Yvar=None if Yvar is None else Yvar.nan_to_num(nan=1.0))

    def units(self, after: Standardize) -> LinkedUnits:
        """The link and then shift and scale."""
        return LinkedUnits(self, after)

    def forward(
        self, Y: Tensor, Yvar: Tensor | None = None, X: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """The link of observations, and their variances by its slope (the delta method)."""
        return self.value(Y), None if Yvar is None else Yvar * (2 * self.log_slope(Y)).exp()

    def untransform(
        self, Y: Tensor, Yvar: Tensor | None = None, X: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """The reverse."""
        y = self.inverse(Y)
        return y, None if Yvar is None else Yvar * (-2 * self.log_slope(y)).exp()

    def posterior(self, posterior: Posterior) -> LinkedPosterior:
        """The posterior of y, by that of g(y)."""
        return LinkedPosterior(posterior, self)

    def untransform_posterior(self, posterior: Posterior, X: Tensor | None = None) -> Posterior:
        """The posterior in the user's units."""
        return LinkedPosterior(posterior, self)

    def subset_output(self, idcs: list[int]) -> Logit:
        """The link itself, which is the same for all outputs."""
        return self

    def __deepcopy__(self, memo: Any) -> Logit:
        """The link itself, which nothing changes."""
        return self

    def extra_repr(self) -> str:
        """Both bounds."""
        return f"{self.lower:g}, {self.upper:g}"


class LinkedUnits(Standardize):
    """A link, and then shift and scale of its values: the outcome transform of a model.

    Args:
        link: The link.
        units: Shift and scale after it.
    """

    _is_linear = False

    def __init__(self, link: Logit, units: Standardize) -> None:
        super().__init__(m=units._m, batch_shape=units._batch_shape)
        self.link, self._is_trained = link, torch.tensor(True)
        self.means, self.stdvs, self._stdvs_sq = units.means, units.stdvs, units._stdvs_sq
        self.eval()

    def forward(
        self, Y: Tensor, Yvar: Tensor | None = None, X: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """From the user's units to the model's."""
        checked_within(self.link, Y, "Y")
        return super().forward(*self.link(Y, Yvar), X)

    def untransform(
        self, Y: Tensor, Yvar: Tensor | None = None, X: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """From the model's units to the user's."""
        return self.link.untransform(*super().untransform(Y, Yvar, X))

    def untransform_posterior(self, posterior: Posterior, X: Tensor | None = None) -> Posterior:
        """The posterior in the user's units."""
        return LinkedPosterior(super().untransform_posterior(posterior, X), self.link)

    def train(self, mode: bool = True) -> LinkedUnits:
        """Stay in eval mode: shift and scale are known."""
        return super().train(False)

    def subset_output(self, idcs: list[int]) -> LinkedUnits:
        """The units of some outputs."""
        plain = Standardize(m=self._m, batch_shape=self._batch_shape)
        plain.means, plain.stdvs, plain._stdvs_sq = self.means, self.stdvs, self._stdvs_sq
        plain._is_trained = self._is_trained
        return type(self)(self.link, plain.eval().subset_output(idcs))


class LinkedPosterior(TransformedPosterior):
    """The posterior of an output with a link, in the user's units.

    Draws and moments are exact; of a model that holds samples they are those of each sample, as
    BoTorch has them, and ``mixture_mean``, ``mixture_variance`` and ``quantile`` those of all.
    """

    def __init__(self, posterior: Posterior, link: Logit) -> None:
        super().__init__(
            posterior,
            link.inverse,
            lambda mean, variance: link.moments(mean, variance)[0],
            lambda mean, variance: link.moments(mean, variance)[1],
        )
        self.link, self.is_mixture = link, hasattr(posterior, "mixture_mean")

    @property
    def mixture_mean(self) -> Tensor:
        """The mean of the mixture, ``batch_shape x q x m``."""
        return self._moments()[0]

    @property
    def mixture_variance(self) -> Tensor:
        """The variance of the mixture, ``batch_shape x q x m``."""
        return self._moments()[1]

    def quantile(self, value: Tensor) -> Tensor:
        """Quantiles at ``b`` levels or one, ``(b) x batch_shape x q x m``."""
        if value.numel() > 1:
            return torch.stack([self.quantile(level) for level in value])
        mean, variance = self._posterior.mean, self._posterior.variance
        if not self.is_mixture:
            mean, variance = mean.unsqueeze(MCMC_DIM), variance.unsqueeze(MCMC_DIM)
        return mixture_quantile(mean, variance, float(value), self.link)

    def judged(self, Y: Tensor) -> tuple[Tensor, Tensor]:
        """The probability of less than values ``... x q x m`` at each, and their log density."""
        mean, variance = self._posterior.mean, self._posterior.variance
        if not self.is_mixture:
            mean, variance = mean.unsqueeze(MCMC_DIM), variance.unsqueeze(MCMC_DIM)
        Y = Y.unsqueeze(MCMC_DIM).expand_as(mean)
        normal = torch.distributions.Normal(mean, variance.sqrt(), validate_args=False)
        z = self.link.value(Y)
        density = (normal.log_prob(z) + self.link.log_slope(Y)).logsumexp(MCMC_DIM)
        return normal.cdf(z).mean(MCMC_DIM), density - math.log(mean.shape[MCMC_DIM])

    @property
    def distribution(self) -> Any:
        """None: a NotImplementedError, as it is not normal."""
        raise NotImplementedError(
            "An output with a link has no normal posterior; take draws (`rsample`), `mean`, "
            "`variance` and `quantile`, each point by itself."
        )

    def _moments(self) -> tuple[Tensor, Tensor]:
        if not self.is_mixture:
            return self.mean, self.variance
        return mixture_moments(*self.link.moments(self._posterior.mean, self._posterior.variance))


def plain(transform: OutcomeTransform) -> Any:
    """The bounds of a link, which a file can hold; another transform as it is."""
    link = Logit.of(transform)
    return transform if link is None else link.bounds


def checked_within(link: Logit, Y: Tensor, name: str) -> None:
    """Raise a ValueError if observations are not within the bounds of a link."""
    outside = ~link.holds(Y) & ~Y.isnan()
    if outside.any():
        row = outside.any(-1).nonzero()[0].tolist()
        raise ValueError(
            f"Expected {name} {link.where}, as {link.formula} is modelled, found "
            f"{int(outside.sum())} other(s), the first {float(Y[outside][0]):.6g} in row "
            f"{row[-1]}. Correct them, make them NaN if they were not measured, or give other "
            "bounds: outcome_transform=Logit(lower, upper)."
        )
