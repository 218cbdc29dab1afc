"""Scores of Gaussian predictions and of mixtures of Gaussians, over the observed points only.

A true value is NaN where it was not observed; scores are NaN for an output without any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior
from torch import Tensor
from torch.distributions import Normal

from gpadjust.checks import check_columns, check_level
from gpadjust.core.gaussian import DRAWS, Marginals


def central_share(pit: Tensor, level: float) -> Tensor:
    """Return the share of PIT values ``... x n x m`` in a level's central interval, ``... x m``."""
    check_level(level)
    return _mean_over_observed(((pit - 0.5).abs() <= level / 2).to(pit.dtype), pit)


@dataclass(frozen=True)
class Scores:
    """Quality of predictions at the observed points.

    Leading dimensions, such as the steps of a free run, are a batch, and ``scores[i]`` is a part.

    Attributes:
        rmse: Root mean square error, ``... x m``, in y's units.
        median: Median absolute error, ``... x m``, in y's units.
        nlpd: Mean negative log predictive density, ``... x m``, in nats.
        crps: Mean continuous ranked probability score, ``... x m``, in y's units (Gneiting and
            Raftery 2007, eq. 21).
        coverage: Share of the points in the central interval, ``... x m``.
        pit: Probability integral transform of each point, ``... x n x m``: the distribution
            function at the true value, NaN where not observed. Uniform between 0 and 1 if intervals
            of all levels have their coverage (Dawid 1984).
        energy: Mean energy score of all outputs together, ``...``, where there are draws.
        output_names: The names of the outputs; empty if they have none.
    """

    rmse: Tensor
    median: Tensor
    nlpd: Tensor
    crps: Tensor
    coverage: Tensor
    pit: Tensor
    energy: Tensor | None = None
    output_names: tuple[str, ...] = ()

    @classmethod
    def compute(
        cls,
        mean: Tensor,
        variance: Tensor,
        y: Tensor,
        *,
        level: float = 0.95,
        interval: tuple[Tensor, Tensor] | None = None,
        energy: Tensor | None = None,
        output_names: Sequence[str] = (),
    ) -> Scores:
        """Compute the scores of Gaussian predictions, in closed form.

        Args:
            mean: Predicted means, ``... x n x m``.
            variance: Predicted variances, of the same shape. Points with NaN count in ``rmse`` and
                ``median`` only.
            y: True values, ``... x n x m``, NaN where not observed.
            level: Nominal coverage, between 0 and 1.
            interval: Ends of the interval of that level, ``... x n x m`` each, if not Gaussian.
            energy: The energy score of draws, ``...``.
            output_names: The names of the ``m`` outputs.

        Raises:
            TypeError: If one is not a tensor of numbers.
            ValueError: If the shapes disagree, means have NaN, variances are negative, or ``level``
                is not between 0 and 1.
        """
        gaussians = _gaussians(mean, variance.nan_to_num(nan=1.0, posinf=math.inf), y)
        judged = y.masked_fill(variance.isnan(), math.nan)
        scores = _scores(gaussians, y, judged, level)
        if interval is not None:
            values = judged + 0 * (interval[0] + interval[1])  # NaN where an end is
            is_inside = (interval[0] <= values) & (values <= interval[1])
            share = _mean_over_observed(is_inside.to(mean.dtype), values)
            scores = replace(scores, coverage=share)
        return replace(scores, energy=energy, output_names=tuple(output_names))

    def __getitem__(self, part: Any) -> Scores:
        """Return the scores of a part of the batch; raise a TypeError if there is no batch."""
        if self.rmse.dim() < 2:
            raise TypeError(
                "These scores have no batch to take a part of; an output is `scores.rmse[j]`."
            )
        parts: dict[str, Any] = {n: v[part] for n, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **parts)


def score(posterior: Posterior, Y: Tensor, level: float = 0.95) -> Scores:
    """Judge a posterior by observations.

    If ``Y`` is noisy, pass the posterior of *observations*, ``observation_noise=True``.

    Args:
        posterior: The posterior of a model of this library, or one of BoTorch that is Gaussian at
            each point or a mixture. With a link ``crps`` is by the mean and the variance.
        Y: Observations, ``... x n x m``, NaN where missing.
        level: Nominal coverage, between 0 and 1.

    Raises:
        TypeError: If ``posterior`` has no mean and variance, or ``Y`` is not a tensor.
        ValueError: If ``Y`` has another shape than the posterior, or ``level`` is not between 0
            and 1.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> Z = torch.rand(20, 1, dtype=torch.float64)
        >>> with torch.no_grad():
        ...     scores = score(model.posterior(Z), 2 * torch.sin(6 * Z) + Z)
        >>> scores.rmse.shape, scores.pit.shape
        (torch.Size([1]), torch.Size([20, 1]))
    """
    marginals = getattr(posterior, "marginals", None)
    if not isinstance(marginals, Marginals):
        mean = getattr(posterior, "mean", None)
        variance = getattr(posterior, "variance", None)
        if not (isinstance(mean, Tensor) and isinstance(variance, Tensor)):
            raise TypeError(
                "Expected a posterior, with a mean and a variance, got "
                f"{type(posterior).__name__}; a model has one, `model.posterior(X, "
                "observation_noise=True)`."
            )
        if isinstance(posterior, GaussianMixturePosterior):
            marginals = Marginals(mean, variance)  # of the draws of a fully Bayesian model
        else:
            marginals = _gaussians(mean, variance, Y)
    _check(Y, mean=marginals.prediction.mean)
    return _scores(marginals, Y, Y, level)


def energy_score(draws: Tensor, y: Tensor) -> Tensor:
    r"""Return the mean energy score of draws of all outputs together; lower is better.

    :math:`\frac1K \sum_i |x_i - y| - \frac{1}{2 K (K - 1)} \sum_{i \neq j} |x_i - x_j|` of ``K``
    draws (Gneiting and Raftery 2007, sec. 4.3; without bias of ``K``: Ferro 2014). Give all outputs
    one scale first, as the largest one dominates a distance.

    Args:
        draws: ``K x ... x n x m``, at least two.
        y: True values, ``... x n x m``; points with NaN are left out.
    """
    is_observed = ~y.isnan().any(-1)
    error = (draws - _filled(y)).norm(dim=-1).mean(0)
    # Point by point, as all pairs at once are n K^2; not by products, which cancel.
    mode = "donot_use_mm_for_euclid_dist"
    points = draws.movedim(0, -2).flatten(0, -3)
    pairs = error.new_zeros(len(points))
    for i, point in enumerate(points):
        pairs[i] = torch.cdist(point, point, compute_mode=mode).sum()
    # sum_i |x_i - y| / K - sum_ij |x_i - x_j| / (2 K (K - 1))
    values = error - pairs.reshape(error.shape) / (2 * len(draws) * (len(draws) - 1))
    return values.masked_fill(~is_observed, 0).sum(-1) / is_observed.sum(-1)


def _scores(marginals: Marginals, y: Tensor, judged: Tensor, level: float) -> Scores:
    """Return the scores of mixtures; errors at ``y``, all else at the judged values."""
    mean = marginals.prediction.mean
    values = marginals.probability(judged)
    # The median of no points is an error in torch.
    median = (mean - y).abs().nanmedian(-2).values if y.shape[-2] else y.sum(-2) / 0
    return Scores(
        rmse=_mean_over_observed((mean - _filled(y)).square(), y).sqrt(),
        median=median,
        nlpd=_mean_over_observed(-marginals.log_density(_filled(judged)), judged),
        crps=_crps(marginals, judged),
        coverage=central_share(values, level),
        pit=values,
    )


def _crps(marginals: Marginals, y: Tensor) -> Tensor:
    r"""Return the score of mixtures (Grimit et al. 2006), with :math:`A(\mu, \sigma^2) = E|Z|`.

    .. math:: \frac1S \sum_i A(y - \mu_i, \sigma_i^2)
        - \frac{1}{2 S^2} \sum_{i, j} A(\mu_i - \mu_j, \sigma_i^2 + \sigma_j^2)

    With a link it is the score of a Gaussian with the prediction's mean and variance.
    """
    if type(marginals) is Marginals:
        mean, variance = (moment.movedim(DRAWS, 0) for moment in marginals)
    else:
        mean, variance = (moment.unsqueeze(0) for moment in marginals.prediction)
    score = _absolute_moment(_filled(y) - mean, variance).mean(0)
    for mean_i, variance_i in zip(mean, variance, strict=True):  # all pairs at once are S^2 n m
        spread = _absolute_moment(mean - mean_i, variance + variance_i).mean(0)
        score = score - spread / (2 * len(mean))
    return _mean_over_observed(score, y)


def _absolute_moment(mean: Tensor, variance: Tensor) -> Tensor:
    """Return the expectation of ``|Z|`` for a normal ``Z``."""
    # A tiny variance instead of zero, so that the score has its limit.
    sd = variance.sqrt().clamp_min(torch.finfo(variance.dtype).tiny ** 0.5)
    z = mean / sd
    normal = Normal(torch.zeros_like(z), torch.ones_like(z))
    # E|Z| = mu (2 Phi(z) - 1) + 2 sigma phi(z)
    return mean * (2 * normal.cdf(z) - 1) + 2 * sd * normal.log_prob(z).exp()


def _gaussians(mean: Tensor, variance: Tensor, y: Tensor) -> Marginals:
    """Return checked predictions of single Gaussians."""
    _check(y, mean=mean, variance=variance)
    return Marginals(mean.unsqueeze(DRAWS), variance.unsqueeze(DRAWS))


def _check(y: Tensor, **predicted: Tensor) -> None:
    """Raise an error unless means, and variances, are numbers of the shape of ``y``."""
    for name, values in {**predicted, "y": y}.items():
        check_columns(name, values, 0, more=True)
    if y.dim() < 2:
        raise ValueError(
            f"Expected y of shape ... x n x m, n points of m outputs, got {tuple(y.shape)}; give "
            "a single output a column in all arguments, `.unsqueeze(-1)`."
        )
    for name, values in predicted.items():
        if values.shape != y.shape:
            raise ValueError(
                f"Expected {name} of y's shape {tuple(y.shape)}, got {tuple(values.shape)}."
            )
        if values.isnan().any():
            raise ValueError(
                f"Expected {name} without NaN, found {int(values.isnan().sum())} of "
                f"{values.numel()}; only y may be NaN, where it was not observed."
            )
        if name == "variance" and (values < 0).any():
            raise ValueError(
                f"Expected variances of at least 0, got {values.min().item():.3g}; if they are "
                "negative by rounding, pass `variance.clamp_min(0)`."
            )


def _filled(y: Tensor) -> Tensor:
    """Return true values with 0 where they are NaN, which are left out later."""
    return y.masked_fill(y.isnan(), 0)


def _mean_over_observed(values: Tensor, y: Tensor) -> Tensor:
    """Return the mean over the points at which ``y`` is not NaN, ``... x n x m`` to ``... x m``."""
    missing = y.isnan()
    return values.masked_fill(missing, 0).sum(-2) / (~missing).sum(-2)
