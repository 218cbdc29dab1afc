"""Leave-one-out predictions in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Normal, StudentT

from gpadjust.checks import check_level
from gpadjust.core import GP, StackedGP
from gpadjust.core.data import Data
from gpadjust.core.gaussian import DRAWS, Marginals
from gpadjust.display import Display, html_table
from gpadjust.physics import Physics
from gpadjust.validation.scores import Scores, central_share
from gpadjust.words import number, percent

_ROUNDING = 1e-8  # of the observations' standard deviation; to predict better shows nothing
_WORST = -1e6  # nats; a density of zero would make the differences of all others infinite
_FAR = 6.0  # standard deviations, where a probability next to 1 is rounded
_COMPONENTS = 64  # that draws are resampled to, for each observation


@dataclass(frozen=True)
class LeaveOneOut(Display):
    """Predictions of each observation from all the others, in the user's units.

    Attributes:
        X: Inputs, ``n x d``.
        Y: Observations, ``n x m``; NaN where missing.
        mean: Their predictions, ``n x m``; medians of a model with a link.
        variance: The variances of the predictions, observation noise included.
        log_density: The log predictive densities of the observations, in nats; NaN where there is
            none. Predicted standard deviations are at least 1e-8 of that of the observations.
        pit: The predicted probabilities of values below the observations; NaN where missing.
        output_names: The names of the outputs.
        is_outlier: Whether an observation is an outlier of a noise with heavy tails, ``n x m``;
            None of other noise. Scores leave these out, but for the density.
        marginals: The distributions of the predictions; None if they are Gaussian.
    """

    X: Tensor
    Y: Tensor
    mean: Tensor
    variance: Tensor
    log_density: Tensor
    pit: Tensor
    output_names: tuple[str, ...]
    is_outlier: Tensor | None = None
    marginals: Marginals | None = None

    def interval(self, level: float = 0.95) -> tuple[Tensor, Tensor]:
        """Return both ends of the central intervals of a level, ``n x m`` each."""
        check_level(level)
        marginals = self.marginals
        if marginals is None:
            marginals = Marginals(self.mean.unsqueeze(DRAWS), self.variance.unsqueeze(DRAWS))
        return marginals.quantile((1 - level) / 2), marginals.quantile((1 + level) / 2)

    @property
    def residuals(self) -> Tensor:
        """Normal numbers of the same probability as the observations, ``n x m``.

        Of a Gaussian prediction, and far out, they are ``(Y - mean) / sd``.
        """
        z = torch.special.ndtri(self.pit)
        return torch.where(z.abs() < _FAR, z, (self.Y - self.mean) / self.variance.sqrt())

    @property
    def judged(self) -> Tensor:
        """The observations that scores are of, ``n x m``; NaN where missing or an outlier."""
        return self.Y if self.is_outlier is None else self.Y.masked_fill(self.is_outlier, torch.nan)

    def score(self, level: float = 0.95) -> Scores:
        """Return the scores of the predictions, with the coverage of intervals of a level."""
        Y = self.judged
        mean = self.mean.nan_to_num()  # where nothing was observed
        scores = Scores.compute(mean, self.variance, Y, level=level, output_names=self.output_names)
        # Predictions are mixtures: take their own probabilities and densities.
        pit = self.pit.masked_fill(Y.isnan(), torch.nan)
        nlpd = -self.log_density.nanmean(-2)
        return replace(scores, pit=pit, coverage=central_share(pit, level), nlpd=nlpd)

    def densities_of(self, output: int) -> Tensor:
        """Return the log densities of an output by the ``n`` different inputs of observations.

        Those of the same inputs are summed: repeated observations would seem to be further evidence
        of where a model is right.
        """
        is_observed = ~self.Y[:, output].isnan()
        density = self.log_density[is_observed, output]
        density = density.nan_to_num(nan=_WORST, neginf=_WORST).clamp_min(_WORST)
        distinct, group = self.X[is_observed].unique(dim=0, return_inverse=True)
        if len(distinct) < len(density):
            density = density.new_zeros(len(distinct)).index_add(0, group, density)
        return density

    def _repr_html_(self) -> str:
        scores = self.score()
        columns = (scores.rmse, scores.median, scores.coverage, -scores.nlpd)
        rows = [
            [name, number(rmse), number(median), percent(share), number(density)]
            for name, rmse, median, share, density in zip(self.output_names, *columns, strict=True)
        ]
        head = ["", "RMSE", "median error", "in 95 %", "mean log density"]
        return html_table(f"Left-out predictions of {len(self.X)} observations", head, rows)


@torch.no_grad()
def leave_one_out(model: Any) -> LeaveOneOut:
    r"""Predict each observation from all the others, without fitting again.

    With the covariance :math:`K` of the observations, noise included, and
    :math:`\alpha = K^{-1} (y - m)`, each draw of the unknown numbers predicts

    .. math:: \mu_{-i} = y_i - \alpha_i / [K^{-1}]_{ii}, \quad
        \sigma^2_{-i} = 1 / [K^{-1}]_{ii}

    (Rasmussen and Williams 2006, eqs. 5.10-5.12). The draws have seen the observation; for its
    prediction they have the weights
    :math:`1 / p(y_i | y_{-i}, \theta)`, at most :math:`\sqrt S` times the average (Gelfand et al.
    1992; Ionides 2008). After a point fit there is one draw, and scores of few points are
    optimistic. For a :class:`~gpadjust.StackedGP` return the mixture of its models' predictions;
    its weights have seen all observations.

    Args:
        model: A model such as :class:`~gpadjust.CKA`, or a :class:`~gpadjust.StackedGP`.

    Raises:
        TypeError: If the model is of another kind.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, fit
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> result = fit(model)
        >>> loo = leave_one_out(model)
        >>> loo.mean.shape, bool(loo.score().rmse < 0.1)
        (torch.Size([8, 1]), True)
    """
    if not isinstance(model, GP | StackedGP):
        raise TypeError(
            f"Expected a model of this library, such as CKA; found {type(model).__name__}. Pass "
            "the models of a list one by one; for any other model hold some observations out, and "
            "compare model.interval(X) with them."
        )
    marginals = _left_out(model)
    data = model.data
    return LeaveOneOut(
        data.X,
        data.Y,
        *marginals.prediction,
        log_density=marginals.log_density(data.Y),
        pit=marginals.probability(data.Y),
        output_names=data.output_names,
        is_outlier=getattr(getattr(model, "noise", None), "is_outlier", None),
        marginals=marginals,
    )


@torch.no_grad()
def left_out_by_physics(
    physics: Physics, data: Data, is_outlier: Tensor | None = None
) -> LeaveOneOut:
    r"""Return left-out predictions by a physics as it is, with noise of an unknown variance.

    Nothing is fitted, :math:`y_i = f_p(x_i) + s_i \epsilon_i`, with :math:`s_i = 1` or
    :math:`|f_p(x_i)|`, whichever predicts an output better. A left-out observation has Student's
    distribution about f_p with the mean square error at the others and ``n - 1`` degrees of freedom
    (Gelman et al. 2013, section 3.2); with known variances it is Gaussian.
    """
    X, Y = data.X, data.Y
    mean = physics(X)
    least = _ROUNDING**2 * (Y - Y.nanmean(0)).square().nanmean(0)
    if data.Yvar is not None:
        variance = data.Yvar.maximum(least)
        density = Normal(mean, variance.sqrt(), False).log_prob(Y)
    else:
        variance, density = _with_noise(Y, mean, torch.ones_like(mean), least)
        sizes = mean.abs()
        relative = _with_noise(Y, mean, sizes, least / sizes.square())
        is_relative = relative[1].nansum(0) > density.nansum(0)  # not if f_p is 0 somewhere
        variance = torch.where(is_relative, relative[0], variance)
        density = torch.where(is_relative, relative[1], density)
    pit = torch.special.ndtr((Y - mean) / variance.sqrt())
    return LeaveOneOut(X, Y, mean, variance, density, pit, data.output_names, is_outlier)


def _with_noise(Y: Tensor, mean: Tensor, sizes: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """Return variances and log densities, ``n x m``, of noise in proportion to sizes ``n x m``."""
    # (y - f) / s has Student's distribution, and y the density of that over s.
    squares = ((Y - mean) / sizes).square()
    freedom = (~Y.isnan()).sum(0) - 1
    others = squares.nansum(0) - squares.nan_to_num(nan=0.0)
    scale = sizes * (others.clamp_min(0) / freedom).maximum(least).sqrt()
    student = StudentT(freedom.to(mean), mean, scale, validate_args=False)
    return student.variance.nan_to_num(nan=torch.inf), student.log_prob(Y)


def _left_out(model: Any) -> Marginals:
    """Return the predictions of left-out observations, by components of equal weights."""
    if isinstance(model, StackedGP):
        return model.marginals_of(*_mixed(model, [_left_out(part) for part in model.models]))
    means, variances = model.left_out_at(model.draws)
    y = model.on_gaussian_scale(model.data.Y)
    spread = (y - y.nanmean(-2, keepdim=True)).square().nanmean(-2, keepdim=True)
    variances = variances.maximum(_ROUNDING**2 * spread)
    # log N(y_i | mu_i, s_i^2) of each draw, up to a constant
    log_density = -0.5 * ((y - means).square() / variances + variances.log())
    rows = _without_each(log_density)
    return model.marginals_of(means.gather(DRAWS, rows), variances.gather(DRAWS, rows))


def _without_each(log_density: Tensor) -> Tensor:
    """Return draws, ``S' x n x m``, of the posterior without each observation, by densities."""
    S = len(log_density)
    # w_s = 1 / p(y_i | theta_s), normalised, at most sqrt(S) times the average
    weight = (-log_density).nan_to_num(nan=0.0).softmax(0).clamp_max(S**-0.5)
    ends = (weight / weight.sum(0)).cumsum(0)  # systematic resampling: even heights
    heights = (torch.arange(_COMPONENTS if S > 1 else 1).to(ends) + 0.5) / _COMPONENTS
    return (heights.reshape(-1, 1, 1, 1) > ends).sum(1).clamp_max(S - 1)


def _mixed(model: StackedGP, parts: list[Marginals]) -> Tensor:
    """Return means and variances ``2 x S x n x m`` of the components of a mixture."""
    outputs = []
    for j in range(model.num_outputs):
        chosen = []
        for i, part in enumerate(parts):
            count = int((model.owners[:, j] == i).sum())
            rows = ((torch.arange(count) + 0.5) * len(part.means) / max(1, count)).long()
            chosen.append(torch.stack([part.means[rows, :, j], part.variances[rows, :, j]]))
        outputs.append(torch.cat(chosen, 1))
    return torch.stack(outputs, -1)
