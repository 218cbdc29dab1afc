"""Links: models of outputs with bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from statistics import NormalDist
from typing import Any, NamedTuple, Self

import torch
from botorch.models.transforms.outcome import OutcomeTransform
from botorch.posteriors.transformed import TransformedPosterior
from torch import Tensor

from gpadjust.checks import marked_rows
from gpadjust.core import structures
from gpadjust.core.gaussian import Marginals, Prediction
from gpadjust.core.model import GP
from gpadjust.core.posterior import MixturePosterior

NAMED = {"log": (0.0, math.inf), "logit": (0.0, 1.0)}
_LARGEST = 1e150  # without an upper bound: its square, and sums of such, are finite
_LOW, _HIGH = (NormalDist().cdf(z) for z in (-1.0, 1.0))  # the ends of 68.27 %


class Link(NamedTuple):
    r"""The link :math:`g(y) = \log \frac{y - a}{b - y} - c` of an output between bounds a and b.

    Without an upper bound, :math:`g(y) = \log(y - a) - c`. The location c of each output is the
    mean of g at the targets, so that nothing depends on the unit of a positive output.
    """

    lower: float
    upper: float
    location: Tensor  # c, m

    @classmethod
    def parse(cls, link: Any) -> Link:
        """Return the link of a name or of two bounds, without a location."""
        bounds: Any = NAMED.get(link) if isinstance(link, str) else link
        is_pair = isinstance(bounds, tuple | list) and len(bounds) == 2
        if not is_pair or not {*map(type, bounds)} <= {int, float}:
            raise TypeError(f"Expected link as 'log', 'logit' or two bounds; found {link!r}.")
        lower, upper = map(float, bounds)
        if not (math.isfinite(lower) and lower < upper):
            raise ValueError(
                f"Expected a finite lower bound below the upper one; found {lower:g} and {upper:g}."
                " If an output has an upper bound only, model its distance from the bound."
            )
        return cls(lower, upper, torch.zeros((), dtype=torch.float64))

    @property
    def formula(self) -> str:
        """The link as a formula of y."""
        above = f"(y - {self.lower:g})" if self.lower else "y"
        if math.isinf(self.upper):
            return f"log({above.strip('()')})"
        return f"log({above} / ({self.upper:g} - y))"

    def covers(self, y: Tensor) -> Tensor:
        """Return which values are within the bounds, or NaN."""
        return ~((y <= self.lower) | (y >= self.upper))

    def logs(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return log(y - a) and log(b - y), minus infinity beyond a bound; 0 without an upper."""
        above = (y - self.lower).clamp_min(0.0).log()
        if math.isinf(self.upper):
            return above, torch.zeros_like(y)
        return above, (self.upper - y).clamp_min(0.0).log()

    def value(self, y: Tensor) -> Tensor:
        """Return g of values ``... x m``; infinite at the bounds and beyond."""
        above, below = self.logs(y)
        return above - below - self.location.to(y)

    def log_slope(self, y: Tensor) -> Tensor:
        """Return the logarithm of the derivative of g."""
        above, below = self.logs(y)
        if math.isinf(self.upper):
            return -above  # dg / dy = 1 / (y - a)
        # dg / dy = (b - a) / ((y - a) (b - y))
        return math.log(self.upper - self.lower) - above - below

    def inverse(self, z: Tensor) -> Tensor:
        """Return y of values of g, strictly within the bounds and finite despite rounding."""
        z = z + self.location.to(z)
        bounds = z.new_tensor([self.lower, min(self.upper, _LARGEST)])
        least, most = bounds.nextafter(bounds.flip(0)).tolist()
        is_open = math.isinf(self.upper)
        # y = a + e^(g + c), or a + (b - a) / (1 + e^-(g + c))
        above = z.exp() if is_open else (self.upper - self.lower) * z.sigmoid()
        return (self.lower + above).clamp(least, most)

    def of_outputs(self, outputs: Sequence[int] | slice) -> Link:
        """Return the link of some outputs."""
        return self._replace(location=self.location[outputs])


class LinkedMarginals(Marginals):
    """Mixtures of distributions at single points, Gaussian after a link."""

    link: Link

    def __new__(cls, means: Tensor, variances: Tensor, link: Link) -> Self:
        """Make mixtures of components of g, ``... x S x q x m``."""
        new = super().__new__(cls, means, variances)
        new.link = link
        return new

    @property
    def prediction(self) -> Prediction:
        """The median, and the square of half the width of the central 68.27 %, ``... x q x m``."""
        # Rare values decide the moments: for a wide mixture these may be infinite, and the mean
        # outside of every interval. So these are the quantiles at -1, 0 and 1 sd of a Gaussian.
        sd = (self.quantile(_HIGH) - self.quantile(_LOW)) / 2
        return Prediction(self.quantile(0.5), sd.square())

    def quantile(self, level: float) -> Tensor:
        """Return the quantiles ``... x q x m`` of a level."""
        return self.link.inverse(Marginals(*self).quantile(level))

    def probability(self, Y: Tensor) -> Tensor:
        """Return the probability of values below ``Y``."""
        return Marginals(*self).probability(self.link.value(Y))

    def log_density(self, Y: Tensor) -> Tensor:
        """Return the log density at values ``Y``; NaN where ``Y`` is NaN."""
        # p(y) = p(g(y)) dg/dy
        density = Marginals(*self).log_density(self.link.value(Y)) + self.link.log_slope(Y)
        return density.masked_fill(~self.link.covers(Y), -math.inf)


class LinkedPosterior(TransformedPosterior):
    """The joint posterior in the user's units; moments are those of :class:`LinkedMarginals`."""

    def __init__(self, mixture: MixturePosterior, link: Link) -> None:
        self.mixture, self.link = mixture, link
        self.marginals = LinkedMarginals(*mixture.marginals, link)
        super().__init__(
            mixture, link.inverse,
            lambda *_: self.marginals.quantile(0.5),
            lambda *_: self.marginals.prediction.variance,
        )  # fmt: skip

    @property
    def distribution(self) -> Any:
        """An AttributeError for code that needs a Gaussian, such as BoTorch's entropy."""
        raise AttributeError(
            f"The model is Gaussian in {self.link.formula}, not in y. Take an acquisition function "
            "that needs the mean and variance alone, or samples: its name begins with qLog."
        )

    @property
    def covariance_matrix(self) -> Tensor:
        """Variances of the predictions with the correlations of g(y), of one output."""
        K = self.mixture.covariance_matrix
        # Cov_ij = sd_i corr_ij sd_j
        scale = (self.variance.squeeze(-1) / K.diagonal(dim1=-1, dim2=-2)).sqrt()
        return scale.unsqueeze(-1) * K * scale.unsqueeze(-2)

    def quantile(self, value: Tensor) -> Tensor:
        """Return quantiles ``... x q x m``; several levels are a further first dimension."""
        quantiles = [self.marginals.quantile(level) for level in value.flatten().tolist()]
        return torch.stack(quantiles).squeeze(0)

    def density(self, value: Tensor) -> Tensor:
        """Return the density at values ``... x q x m``."""
        return self.marginals.log_density(value).exp()

    def scalarized(self, weights: Tensor, offset: float = 0.0) -> TransformedPosterior:
        """Raise a TypeError: a sum of outputs with a link has no closed form."""
        raise TypeError(
            "Expected no scalarisation of outputs with a link. Take samples, "
            "objective=LinearMCObjective(weights), or one output, model.subset_output([0])."
        )


class NotGaussian(OutcomeTransform):
    """An identity transform, by which BoTorch's lists of models see non-Gaussian posteriors."""

    def forward(self, Y: Tensor, Yvar: Tensor | None = None, X: Tensor | None = None) -> Any:
        """Return observations and variances without a change."""
        return Y, Yvar


class Linked(GP):
    r"""A structure for outputs with bounds: the structure of :math:`g(y)`, with the physics g(f_p).

    Data, predictions, intervals, samples and functions are in the user's units and within the
    bounds. A logarithm makes rho an exponent and errors relative. Predictions are medians, with the
    square of half the width of the central 68.27 % as variance. ``term``, ``rho``, ``delta`` and
    the summary are on the scale of g, as are kernels and means among the arguments. To search on
    this scale, pass ``objective=GenericMCObjective(lambda Y, X=None: Y[..., 0].log())``.

    Args as of the structure, and:

    Args:
        link: ``"log"`` for positive outputs, ``"logit"`` for shares between 0 and 1, or two bounds;
            the upper bound may be infinite.

    Raises:
        TypeError: If the link is something else.
        ValueError: If bounds are not a finite and a larger number, or targets are outside of them.
        PhysicsError: If the physics is outside of the bounds.

    Example:
        >>> import torch
        >>> from gpadjust.core import fit
        >>> from gpadjust.kinds.links import LinkedCKA
        >>> X = torch.linspace(0.1, 2, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = LinkedCKA(X, 1 - (-X).exp(), physics=lambda X: X / (1 + X), link="logit")
        >>> result = fit(model)
        >>> lower, upper = model.interval(torch.tensor([[0.0001], [9.0]]).double())
        >>> bool((lower > 0).all() and (upper < 1).all())
        True
    """

    outcome_transform = NotGaussian()

    def __init__(
        self, train_X: Any, train_Y: Any, train_Yvar: Any = None, *, link: Any = "log",
        **options: Any,
    ) -> None:  # fmt: skip
        self.link = Link.parse(link)
        super().__init__(train_X, train_Y, train_Yvar, **options)
        self.settings["link"] = link

    @property
    def scale_formula(self) -> str:  # type: ignore[override]
        """The link as a formula, with its location."""
        return f"{self.link.formula} - [{', '.join(f'{c:.6g}' for c in self.link.location)}]"

    def read_scale(self, Y: Tensor) -> None:
        """Set the location to the mean of g at the targets."""
        self.link = self.link._replace(location=self.on_gaussian_scale(Y).nanmean(-2))

    def holds(self, Y: Tensor) -> Tensor:
        """Return which values are within the bounds, or NaN."""
        return self.link.covers(Y)

    def on_gaussian_scale(self, Y: Tensor) -> Tensor:
        """Return g of targets or outputs; raise a ValueError outside of the bounds."""
        outside = ~self.holds(Y)
        if outside.any():
            rows = marked_rows(outside.any(-1))
            raise ValueError(
                f"Expected targets above {self.link.lower:g} and below {self.link.upper:g} for the "
                f"link {self.link.formula}; found {float(Y[outside][0]):.6g} in {len(rows)} "
                f"row(s), the first row {rows[0]}. Correct them, make them NaN if they are "
                "missing, or give other bounds: link=(lower, upper)."
            )
        return self.link.value(Y)

    def off_gaussian_scale(self, Z: Tensor) -> Tensor:
        """Return y of values of g."""
        return self.link.inverse(Z)

    def noise_in_units(self, Y: Tensor, Yvar: Tensor) -> Tensor:
        """Return known variances by the delta method, ``... x m x n``, in units."""
        # Var g(y) = (dg/dy)^2 Var y
        variances = super().noise_in_units(Y, Yvar) * (2 * self.link.log_slope(Y)).exp().mT
        # A missing target has no slope: any variance will do.
        mean = variances.nanmean(-1, keepdim=True)
        return variances.where(~variances.isnan(), mean).nan_to_num(nan=1.0)

    def usual_noise(self, Y: Tensor) -> Tensor | None:
        """Return the mean of the known variances of g, as variances of y."""
        if self.noise.known is None:
            return None
        variances = (self.noise.known.mean(-1, keepdim=True) * self.unit.square()).mT
        return variances * (-2 * self.link.log_slope(Y)).exp()

    def log_jacobian(self) -> Tensor:
        """Return the log density of the targets less that of g, ``m``."""
        return super().log_jacobian() + self.link.log_slope(self.data.Y).nansum(-2)

    def _noise_at(self, X: Tensor, asked: bool | Tensor) -> Tensor:
        """Return noise variances of g; the delta method at the median converts the user's."""
        if asked is True:
            return super()._noise_at(X, asked)
        variances = self.checked_noise(asked, X)
        return self.noise_in_units(self.marginals(X).quantile(0.5), variances).unsqueeze(-3)

    def marginals_of(self, means: Tensor, variances: Tensor) -> LinkedMarginals:
        """Return the distributions of components of g, ``... x S x q x m``."""
        return LinkedMarginals(means, variances, self.link)

    def posterior_of(self, mixture: MixturePosterior, outputs: Any) -> LinkedPosterior:
        """Return the posterior of some outputs of a mixture on the scale of g."""
        return LinkedPosterior(mixture, self.link.of_outputs(outputs))

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; raise a ValueError for an unknown number."""
        new = super().subset_output(idcs)
        new.link = self.link.of_outputs(self.checked_outputs(idcs))
        return new


@cache
def linked(structure: Any) -> type[Linked]:
    """Return the class of a structure, such as CKA, with a link."""
    if not isinstance(structure, type) or not issubclass(structure, GP):
        raise TypeError(f"Expected a structure, such as CKA; found {structure!r}.")
    if issubclass(structure, Linked):
        return structure
    name = structure.__name__
    text = f":class:`~gpadjust.core.{name}` of outputs with bounds, see :class:`Linked`."
    members = {"__doc__": text, "__module__": __name__}  # the module, as files name it
    linked_structure: Any = type(f"Linked{name}", (Linked, structure), members)
    return linked_structure


LinkedCKA = linked(structures.CKA)
LinkedRRA = linked(structures.RRA)
LinkedPhysicsMeanGP = linked(structures.PhysicsMeanGP)
LinkedScaleGP = linked(structures.ScaleGP)
LinkedZeroMeanGP = linked(structures.ZeroMeanGP)
LinkedCalibratedPhysics = linked(structures.CalibratedPhysics)
