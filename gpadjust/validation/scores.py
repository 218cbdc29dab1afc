"""Scores of Gaussian predictions, and of equally weighted mixtures of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from torch import Tensor
from torch.distributions import Normal


def rmse(mean: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    """Root mean square error over the points.

    Args:
        mean: Predicted means, ``... x n x m``; of a mixture, those of its components.
        y: True values, ``... x n x m``.
        mixture_dim: The dimension of ``mean`` along which the components of an equally weighted
            mixture lie: -3 for ``... x S x n x m``, as in BoTorch's fully Bayesian posteriors.

    Returns:
        ``... x m``, in the units of ``y``.

    Raises:
        ValueError: If the shapes disagree.

    Example:
        >>> import torch
        >>> rmse(torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [4.0]]))
        tensor([1.4142])
    """
    mean, _, y = _components(mean, mean, y, mixture_dim)
    return (mean.mean(0) - y).square().mean(-2).sqrt()


def nlpd(mean: Tensor, variance: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    """Mean negative log predictive density over the points; lower is better.

    Args:
        mean: Predicted means, as in :func:`rmse`.
        variance: Predicted variances, of the same shape.
        y: True values, ``... x n x m``.
        mixture_dim: As in :func:`rmse`.

    Returns:
        ``... x m``, in nats.

    Raises:
        ValueError: If the shapes disagree.

    Example:
        >>> import torch
        >>> zero = torch.zeros(3, 1)
        >>> nlpd(zero, torch.ones(3, 1), zero)
        tensor([0.9189])
    """
    mean, variance, y = _components(mean, variance, y, mixture_dim)
    density = Normal(mean, _sd(variance)).log_prob(y)
    return (math.log(len(mean)) - density.logsumexp(0)).mean(-2)


def crps(mean: Tensor, variance: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    r"""Mean continuous ranked probability score over the points; lower is better.

    In closed form (Grimit et al. 2006, for a mixture; Gneiting and Raftery 2007, eq. 21, for one
    Gaussian), with :math:`A(\mu, \sigma^2) = E|Z|` of :math:`Z \sim N(\mu, \sigma^2)`:

    .. math:: \frac1S \sum_i A(y - \mu_i, \sigma_i^2)
        - \frac{1}{2 S^2} \sum_{i, j} A(\mu_i - \mu_j, \sigma_i^2 + \sigma_j^2)

    Args:
        mean: Predicted means, as in :func:`rmse`.
        variance: Predicted variances, of the same shape.
        y: True values, ``... x n x m``.
        mixture_dim: As in :func:`rmse`.

    Returns:
        ``... x m``, in the units of ``y``.

    Raises:
        ValueError: If the shapes disagree.

    Example:
        >>> import torch
        >>> zero = torch.zeros(3, 1)
        >>> crps(zero, torch.ones(3, 1), zero)
        tensor([0.2337])
    """
    mean, variance, y = _components(mean, variance, y, mixture_dim)
    score = _absolute_moment(y - mean, variance).mean(0)
    for mean_i, variance_i in zip(mean, variance, strict=True):  # all pairs at once are S^2 n m
        spread = _absolute_moment(mean - mean_i, variance + variance_i).mean(0)
        score = score - spread / (2 * len(mean))
    return score.mean(-2)


def pit(mean: Tensor, variance: Tensor, y: Tensor, *, mixture_dim: int | None = None) -> Tensor:
    """Probability integral transform: the predicted distribution function at the true value.

    Args:
        mean: Predicted means, as in :func:`rmse`.
        variance: Predicted variances, of the same shape.
        y: True values, ``... x n x m``.
        mixture_dim: As in :func:`rmse`.

    Returns:
        ``... x n x m``, between 0 and 1; uniform for calibrated predictions (Dawid 1984).

    Raises:
        ValueError: If the shapes disagree.

    Example:
        >>> import torch
        >>> pit(torch.zeros(2, 1), torch.ones(2, 1), torch.tensor([[0.0], [1.0]]))
        tensor([[0.5000],
                [0.8413]])
    """
    mean, variance, y = _components(mean, variance, y, mixture_dim)
    return Normal(mean, _sd(variance)).cdf(y).mean(0)


def coverage(
    mean: Tensor,
    variance: Tensor,
    y: Tensor,
    level: float = 0.95,
    *,
    mixture_dim: int | None = None,
) -> Tensor:
    """Share of the points that lie within the central interval of a given level.

    Args:
        mean: Predicted means, as in :func:`rmse`.
        variance: Predicted variances, of the same shape.
        y: True values, ``... x n x m``.
        level: Nominal coverage, between 0 and 1.
        mixture_dim: As in :func:`rmse`.

    Returns:
        ``... x m``, between 0 and 1; calibrated predictions have it near ``level``.

    Raises:
        ValueError: If ``level`` is not between 0 and 1, or the shapes disagree.

    Example:
        >>> import torch
        >>> coverage(torch.zeros(2, 1), torch.ones(2, 1), torch.tensor([[1.0], [3.0]]))
        tensor([0.5000])
    """
    return central_share(pit(mean, variance, y, mixture_dim=mixture_dim), level)


def central_share(pit: Tensor, level: float) -> Tensor:
    """Share of PIT values (``... x n x m``) in the central interval of a level: ``... x m``."""
    if not 0 < level < 1:
        raise ValueError(f"Expected level between 0 and 1, got {level}.")
    return ((pit - 0.5).abs() <= level / 2).to(pit.dtype).mean(-2)


@dataclass(frozen=True)
class Scores:
    """How good a prediction was.

    Attributes:
        rmse: Root mean square error, ``... x m``, in y's units.
        nlpd: Mean negative log predictive density, ``... x m``, in nats.
        crps: Mean continuous ranked probability score, ``... x m``, in y's units.
        coverage: Share of the points in the central interval, ``... x m``.
        pit: Probability integral transform of each point, ``... x n x m``.
    """

    rmse: Tensor
    nlpd: Tensor
    crps: Tensor
    coverage: Tensor
    pit: Tensor


def score(posterior: Posterior, Y: Tensor, level: float = 0.95) -> Scores:
    """Judge a posterior by what was observed.

    Ask the model for the posterior of *observations*, ``observation_noise=True``, if ``Y`` is
    noisy.

    Args:
        posterior: Any BoTorch posterior that is Gaussian at each point; that of a fully Bayesian
            model (``GaussianMixturePosterior``) is judged as the mixture that it is.
        Y: Observations, ``... x n x m``.
        level: Nominal coverage, between 0 and 1.

    Raises:
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
    dim = MCMC_DIM if isinstance(posterior, GaussianMixturePosterior) else None
    mean, variance = posterior.mean, posterior.variance
    values = pit(mean, variance, Y, mixture_dim=dim)
    return Scores(
        rmse=rmse(mean, Y, mixture_dim=dim),
        nlpd=nlpd(mean, variance, Y, mixture_dim=dim),
        crps=crps(mean, variance, Y, mixture_dim=dim),
        coverage=central_share(values, level),
        pit=values,
    )


def _components(
    mean: Tensor, variance: Tensor, y: Tensor, mixture_dim: int | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Bring the components to the front: two ``S x ... x n x m``, and ``y`` as it is."""
    if mixture_dim is None:
        components = (mean.unsqueeze(0), variance.unsqueeze(0))
    elif -mean.dim() <= mixture_dim < mean.dim():
        components = (mean.movedim(mixture_dim, 0), variance.movedim(mixture_dim, 0))
    else:
        raise ValueError(
            f"There is no dimension {mixture_dim} in means of shape {tuple(mean.shape)}; pass "
            "mixture_dim=None for a prediction that is not a mixture."
        )
    if components[0].shape[1:] != y.shape or mean.shape != variance.shape:
        raise ValueError(
            f"Expected means and variances of y's shape {tuple(y.shape)} (and the components' "
            f"dimension `mixture_dim`, if any), got {tuple(mean.shape)} and "
            f"{tuple(variance.shape)} with mixture_dim={mixture_dim}."
        )
    return (*components, y)


def _absolute_moment(mean: Tensor, variance: Tensor) -> Tensor:
    """The expectation of ``|Z|`` for a normal ``Z``."""
    sd = _sd(variance)
    z = mean / sd
    normal = Normal(torch.zeros_like(z), torch.ones_like(z))
    return mean * (2 * normal.cdf(z) - 1) + 2 * sd * normal.log_prob(z).exp()


def _sd(variance: Tensor) -> Tensor:
    """Standard deviations, next to none instead of none, so that scores have their limits."""
    return variance.sqrt().clamp_min(torch.finfo(variance.dtype).tiny ** 0.5)
