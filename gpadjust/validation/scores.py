"""Scores of Gaussian predictions, and of equally weighted mixtures of them.

A true value may be NaN where it was not observed. Scores are over the observed points only, and NaN
for an output that has none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from torch import Tensor
from torch.distributions import Normal

from gpadjust.checks import check_columns, check_level
from gpadjust.core.gaussian import DRAWS, Marginals


def rmse(mean: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    """Root mean square error over the points.

    Args:
        mean: Predicted means, ``... x n x m``; of a mixture, those of its components.
        y: True values, ``... x n x m``, NaN where not observed.
        mixture_dim: The dimension of ``mean`` along which the components of an equally weighted
            mixture lie: -3 for ``... x S x n x m``, as in BoTorch's fully Bayesian posteriors.

    Returns:
        ``... x m``, in the units of ``y``.

    Raises:
        TypeError: If ``mean`` or ``y`` are no tensors of numbers.
        ValueError: If the shapes disagree, or ``mean`` has NaN.

    Example:
        >>> import torch
        >>> rmse(torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [4.0]]))
        tensor([1.4142])
    """
    (mean,) = _components(y, mixture_dim, mean=mean)
    return _mean_over_observed((mean.mean(0) - _filled(y)).square(), y).sqrt()


def nlpd(mean: Tensor, variance: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    """Mean negative log predictive density over the points; lower is better.

    Arguments and errors are those of :func:`rmse`, and the predicted ``variance``, of the shape of
    ``mean``, which is not negative.

    Returns:
        ``... x m``, in nats.

    Example:
        >>> import torch
        >>> zero = torch.zeros(3, 1)
        >>> nlpd(zero, torch.ones(3, 1), zero)
        tensor([0.9189])
    """
    mean, variance = _components(y, mixture_dim, mean=mean, variance=variance)
    density = Normal(mean, _sd(variance)).log_prob(_filled(y))
    return _mean_over_observed(math.log(len(mean)) - density.logsumexp(0), y)


def crps(mean: Tensor, variance: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    r"""Mean continuous ranked probability score over the points; lower is better.

    In closed form (Grimit et al. 2006, for a mixture; Gneiting and Raftery 2007, eq. 21, for one
    Gaussian), with :math:`A(\mu, \sigma^2) = E|Z|` of :math:`Z \sim N(\mu, \sigma^2)`:

    .. math:: \frac1S \sum_i A(y - \mu_i, \sigma_i^2)
        - \frac{1}{2 S^2} \sum_{i, j} A(\mu_i - \mu_j, \sigma_i^2 + \sigma_j^2)

    Returns:
        ``... x m``, in the units of ``y``.

    Arguments and errors are those of :func:`nlpd`.

    Example:
        >>> import torch
        >>> zero = torch.zeros(3, 1)
        >>> crps(zero, torch.ones(3, 1), zero)
        tensor([0.2337])
    """
    mean, variance = _components(y, mixture_dim, mean=mean, variance=variance)
    score = _absolute_moment(_filled(y) - mean, variance).mean(0)
    for mean_i, variance_i in zip(mean, variance, strict=True):  # all pairs at once are S^2 n m
        spread = _absolute_moment(mean - mean_i, variance + variance_i).mean(0)
        score = score - spread / (2 * len(mean))
    return _mean_over_observed(score, y)


def pit(mean: Tensor, variance: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    """Probability integral transform: the predicted distribution function at the true value.

    Returns:
        ``... x n x m``, between 0 and 1, or NaN where not observed; uniform if intervals
        of all levels hold (Dawid 1984).

    Arguments and errors are those of :func:`nlpd`.

    Example:
        >>> import torch
        >>> pit(torch.zeros(2, 1), torch.ones(2, 1), torch.tensor([[0.0], [1.0]]))
        tensor([[0.5000],
                [0.8413]])
    """
    mean, variance = _components(y, mixture_dim, mean=mean, variance=variance)
    return Normal(mean, _sd(variance)).cdf(_filled(y)).mean(0).masked_fill(y.isnan(), math.nan)


def coverage(
    mean: Tensor, variance: Tensor, y: Tensor, level: float = 0.95, *,
    mixture_dim: int | None = None,
) -> Tensor:  # fmt: skip
    """Share of the points that lie within the central interval of a given level.

    Arguments and errors are those of :func:`nlpd`, and the nominal coverage ``level``, a number
    between 0 and 1.

    Returns:
        ``... x m``, between 0 and 1; near ``level`` if the intervals hold.

    Example:
        >>> import torch
        >>> coverage(torch.zeros(2, 1), torch.ones(2, 1), torch.tensor([[1.0], [3.0]]))
        tensor([0.5000])
    """
    return central_share(pit(mean, variance, y, mixture_dim=mixture_dim), level)


def central_share(pit: Tensor, level: float) -> Tensor:
    """Share of PIT values (``... x n x m``) in the central interval of a level: ``... x m``."""
    check_level(level)
    return _mean_over_observed(((pit - 0.5).abs() <= level / 2).to(pit.dtype), pit)


@dataclass(frozen=True)
class Scores:
    """Quality of predictions at the observed points.

    One type for all: of a posterior (:func:`score`), of left-out observations
    (:meth:`~gpadjust.validation.LeaveOneOut.score`), of transitions and of free runs. Leading
    dimensions, such as the steps of a free run, are a batch: ``scores[i]`` are those of a part.

    Attributes:
        rmse: Root mean square error, ``... x m``, in y's units.
        median: Median absolute error, ``... x m``, in y's units.
        nlpd: Mean negative log predictive density, ``... x m``, in nats.
        crps: Mean continuous ranked probability score, ``... x m``, in y's units.
        coverage: Share of the points in the central interval, ``... x m``.
        pit: Probability integral transform of each point, ``... x n x m``, NaN where not observed.
        energy: Mean energy score of all outputs together, ``...``, where there are draws of them.
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
    def of(
        cls,
        mean: Tensor,
        variance: Tensor,
        y: Tensor,
        *,
        level: float = 0.95,
        interval: tuple[Tensor, Tensor] | None = None,
        mixture_dim: int | None = None,
        energy: Tensor | None = None,
        output_names: Sequence[str] = (),
    ) -> Scores:
        """The scores of Gaussian predictions.

        Args:
            mean: Predicted means, as in :func:`rmse`.
            variance: Predicted variances, of the same shape. NaN where the prediction says none:
                these points count in ``rmse`` and ``median`` only.
            y: True values, ``... x n x m``, NaN where not observed.
            level: Nominal coverage, between 0 and 1.
            interval: Lower and upper ends of the interval of that level, ``... x n x m`` each.
                Default: those of the prediction's own distribution.
            mixture_dim: As in :func:`rmse`.
            energy: The energy score of draws, ``...``.
            output_names: The names of the ``m`` outputs.

        Raises:
            TypeError: As :func:`coverage`.
            ValueError: As :func:`coverage`.

        Example:
            >>> import torch
            >>> mean, y = torch.zeros(5, 20, 2), torch.randn(5, 20, 2)
            >>> scores = Scores.of(mean, torch.ones(5, 20, 2), y)  # 5 steps of 20 windows
            >>> scores.rmse.shape, scores[4].rmse.shape
            (torch.Size([5, 2]), torch.Size([2]))
        """
        error = (_components(y, mixture_dim, mean=mean)[0].mean(0) - y).abs()
        silent = variance.isnan()
        silent = silent if mixture_dim is None else silent.any(mixture_dim)
        judged = y.masked_fill(silent, math.nan)
        predicted = mean, variance.nan_to_num(nan=1.0, posinf=math.inf)
        values = pit(*predicted, judged, mixture_dim=mixture_dim)
        if interval is None:
            share = central_share(values, level)
        else:
            check_level(level)
            inside = ((interval[0] <= judged) & (judged <= interval[1])).to(mean.dtype)
            known = judged + 0 * (interval[0] + interval[1])  # NaN where an end is
            share = _mean_over_observed(inside, known)
        return cls(
            rmse=rmse(mean, y, mixture_dim=mixture_dim),
            median=error.nanmedian(-2).values if y.shape[-2] else error.sum(-2) / 0,
            nlpd=nlpd(*predicted, judged, mixture_dim=mixture_dim),
            crps=crps(*predicted, judged, mixture_dim=mixture_dim),
            coverage=share,
            pit=values,
            energy=energy,
            output_names=tuple(output_names),
        )

    def __getitem__(self, part: Any) -> Scores:
        """The scores of a part of the batch: an index of its leading dimensions.

        Raises:
            IndexError: If there is no batch, or not this part of it.
        """
        if self.rmse.dim() < 2:
            raise IndexError(
                "These scores have no batch to take a part of; an output is `scores.rmse[j]`."
            )
        given: dict[str, Any] = vars(self)
        parts = {name: v[part] for name, v in given.items() if isinstance(v, Tensor)}
        return Scores(**{**given, **parts})

    def __iter__(self) -> Iterator[Scores]:
        """The scores of each part of the batch; an IndexError if there is none."""
        whole = self[:]  # an IndexError of the first part would end a loop in silence
        return (whole[i] for i in range(len(whole.rmse)))


def score(posterior: Posterior, Y: Tensor, level: float = 0.95) -> Scores:
    """Judge a posterior by what was observed.

    Of noisy ``Y`` take the posterior of *observations*, ``observation_noise=True``.

    Args:
        posterior: That of a model of this library (with a link ``crps`` is by the prediction and
            its variance), or one of BoTorch that is Gaussian at each point or a mixture.
        Y: Observations, ``... x n x m``, NaN where there is none.
        level: Nominal coverage, between 0 and 1.

    Raises:
        TypeError: If ``posterior`` has no mean and variance, ``Y`` is no tensor, or ``level`` no
            number.
        ValueError: If ``Y`` does not have the posterior's shape, or ``level`` is not between 0
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
    if isinstance(marginals := getattr(posterior, "marginals", None), Marginals):
        return _of_marginals(marginals, Y, level)
    dim = MCMC_DIM if isinstance(posterior, GaussianMixturePosterior) else None
    mean, variance = getattr(posterior, "mean", None), getattr(posterior, "variance", None)
    if not (isinstance(mean, Tensor) and isinstance(variance, Tensor)):
        raise TypeError(
            f"Expected a posterior, with a mean and a variance, got {type(posterior).__name__}; "
            "that of a model is `model.posterior(X, observation_noise=True)`."
        )
    return Scores.of(mean, variance, Y, level=level, mixture_dim=dim)


def _of_marginals(marginals: Marginals, Y: Tensor, level: float) -> Scores:
    """Return the scores of mixtures at each point by itself, as of a model with a link."""
    if type(marginals) is Marginals:
        return Scores.of(*marginals, Y, level=level, mixture_dim=DRAWS)
    scores = Scores.of(*marginals.prediction, Y, level=level)
    below = marginals.probability(Y)
    nlpd_ = -_mean_over_observed(marginals.log_density(Y), Y)
    return replace(scores, nlpd=nlpd_, pit=below, coverage=central_share(below, level))


def energy_score(draws: Tensor, y: Tensor) -> Tensor:
    r"""Mean energy score of draws of all outputs together; lower is better.

    :math:`\frac1K \sum_i |x_i - y| - \frac{1}{2 K (K - 1)} \sum_{i \neq j} |x_i - x_j|` of ``K``
    draws (Gneiting and Raftery 2007, sec. 4.3; without bias of ``K``: Ferro 2014). Give all outputs
    one scale first, as a distance is no more than the largest of them. Of draws that are all equal
    it is the distance itself.

    Args:
        draws: ``K x ... x n x m``, at least two.
        y: True values, ``... x n x m``; points with NaN are left out.

    Returns:
        ``...``, in the units of ``y``; NaN where there is no point.

    Example:
        >>> import torch
        >>> energy_score(torch.tensor([[[0.0]], [[2.0]]]), torch.tensor([[1.0]]))
        tensor(0.)
    """
    known = ~y.isnan().any(-1)
    error = (draws - _filled(y)).norm(dim=-1).mean(0)
    # Point by point, as all pairs at once are n K^2; not by products, which cancel.
    mode = "donot_use_mm_for_euclid_dist"
    points = draws.movedim(0, -2).flatten(0, -3)
    pairs = [torch.cdist(each, each, compute_mode=mode).sum() for each in points]
    spread = torch.stack(pairs).reshape(known.shape) if pairs else torch.zeros_like(error)
    values = error - spread / (2 * len(draws) * (len(draws) - 1))
    return values.masked_fill(~known, 0).sum(-1) / known.sum(-1)


def _components(y: Tensor, mixture_dim: int | None, **predicted: Tensor) -> list[Tensor]:
    """Mean and variance, checked, their components in front: ``S x ... x n x m``."""
    for name, values in predicted.items():
        check_columns(name, values, 0, more=True)
    if not isinstance(y, Tensor):
        raise TypeError(
            f"Expected y to be a torch tensor, got {type(y).__name__}; convert it with "
            "`torch.as_tensor(y, dtype=torch.float64)`."
        )
    if y.dim() < 2:
        raise ValueError(
            f"Expected y of shape ... x n x m, n points of m outputs, got {tuple(y.shape)}; give "
            "one output its column with `.unsqueeze(-1)`, of all that is passed."
        )
    shape = list(predicted["mean"].shape)
    if mixture_dim is not None:
        if mixture_dim not in range(-len(shape), len(shape)):
            raise ValueError(
                f"There is no dimension {mixture_dim} in means of shape {tuple(shape)}; of a "
                "prediction that is not a mixture mixture_dim is None."
            )
        del shape[mixture_dim]
    shapes = [tuple(values.shape) for values in predicted.values()]
    if shape != list(y.shape) or shapes[0] != shapes[-1]:
        raise ValueError(
            f"Expected {' and '.join(predicted)} of y's shape {tuple(y.shape)}, beside the "
            f"dimension mixture_dim={mixture_dim}, got {' and '.join(map(str, shapes))}."
        )
    for name, values in predicted.items():
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
    if mixture_dim is None:
        return [values.unsqueeze(0) for values in predicted.values()]
    return [values.movedim(mixture_dim, 0) for values in predicted.values()]


def _filled(y: Tensor) -> Tensor:
    """True values with a number where they are NaN, which is left out later."""
    return y.masked_fill(y.isnan(), 0)


def _mean_over_observed(values: Tensor, y: Tensor) -> Tensor:
    """The mean over the points at which ``y`` is not NaN, ``... x n x m`` to ``... x m``."""
    missing = y.isnan()
    return values.masked_fill(missing, 0).sum(-2) / (~missing).sum(-2)


def _absolute_moment(mean: Tensor, variance: Tensor) -> Tensor:
    """The expectation of ``|Z|`` for a normal ``Z``."""
    sd = _sd(variance)
    z = mean / sd
    normal = Normal(torch.zeros_like(z), torch.ones_like(z))
    return mean * (2 * normal.cdf(z) - 1) + 2 * sd * normal.log_prob(z).exp()


def _sd(variance: Tensor) -> Tensor:
    """Standard deviations, next to none instead of none, so that scores have their limits."""
    return variance.sqrt().clamp_min(torch.finfo(variance.dtype).tiny ** 0.5)
