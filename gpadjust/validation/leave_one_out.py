"""Leave-one-out predictions in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import check_level
from gpadjust.core import GP, StackedGP
from gpadjust.core.gaussian import DRAWS, Marginals
from gpadjust.display import Display, html_table
from gpadjust.validation.scores import Scores, central_share
from gpadjust.words import number, percent

ROUNDING = 1e-8  # of the observations' standard deviation; to predict better shows nothing
_FAR = 6.0  # standard deviations, where a probability next to 1 is rounded
_COMPONENTS = 64  # that draws are resampled to, for each observation


@dataclass(frozen=True)
class LeaveOneOut(Display):
    """Predictions of each observation from all the others, in the user's units.

    Attributes:
        X: Inputs, ``n x d``.
        Y: Observations, ``n x m``; NaN where there is none.
        mean: Their predictions, ``n x m``; medians of a model with a link.
        variance: The variances of the predictions, observation noise included.
        log_density: The log predictive densities of the observations, in nats; of standard
            deviations of at least 1e-8 of that of the observations, as less is rounding. NaN where
            there is no observation.
        pit: The predicted probabilities of less than was observed; NaN where nothing was.
        output_names: The names of the outputs.
        is_outlier: Whether an observation is an outlier of a noise with heavy tails, ``n x m``;
            None of other noise. Scores leave these out, but for the density.
        marginals: The distributions of the predictions; None of Gaussian ones.
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

    def score(self, level: float = 0.95) -> Scores:
        """Return the scores of the predictions, with the coverage of intervals of a level."""
        Y = self.Y if self.is_outlier is None else self.Y.masked_fill(self.is_outlier, torch.nan)
        mean = self.mean.nan_to_num()  # where nothing was observed
        scores = Scores.of(mean, self.variance, Y, level=level, output_names=self.output_names)
        # Predictions are mixtures, whose probabilities and densities are known better.
        pit = self.pit.masked_fill(Y.isnan(), torch.nan)
        share, nlpd = central_share(pit, level), -self.log_density.nanmean(-2)
        return replace(scores, pit=pit, coverage=share, nlpd=nlpd)

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

    (Rasmussen and Williams 2006, eqs. 5.10-5.12; Sundararajan and Keerthi 2001). The draws have
    seen the observation; for its prediction they have the weights
    :math:`1 / p(y_i | y_{-i}, \theta)`, at most :math:`\sqrt S` times the average (Gelfand et al.
    1992; Ionides 2008). After a point fit there is one draw, and scores of few points are
    optimistic. Of a :class:`~gpadjust.StackedGP` it is the mixture of its models' predictions; its
    weights, and the scale of the outcomes, have seen all.

    Args:
        model: A model of this library, such as :class:`~gpadjust.CKA`, or a
            :class:`~gpadjust.StackedGP`.

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
            f"Expected a model of this library, such as CKA; found {type(model).__name__}. Of a "
            "list take each model by itself; of a model without leave-one-out predictions hold "
            "some observations out, and compare model.interval(X) with them."
        )
    marginals, data = _left_out(model), model.data
    is_outlier = getattr(getattr(model, "noise", None), "is_outlier", None)
    return LeaveOneOut(
        data.X, data.Y, *marginals.prediction, marginals.log_density(data.Y),
        marginals.probability(data.Y), data.output_names, is_outlier, marginals,
    )  # fmt: skip


def _left_out(model: Any) -> Marginals:
    """Return the predictions of left-out observations, by components of equal weights."""
    if isinstance(model, StackedGP):
        return model.marginals_of(*_mixed(model, [_left_out(each) for each in model.models]))
    means, variances = model.left_out_at(model.draws)
    y = model.on_gaussian_scale(model.data.Y)
    spread = (y - y.nanmean(-2, keepdim=True)).square().nanmean(-2, keepdim=True)
    variances = variances.maximum(ROUNDING**2 * spread)
    log_density = -0.5 * ((y - means).square() / variances + variances.log())
    rows = _without_each(log_density)
    return model.marginals_of(means.gather(DRAWS, rows), variances.gather(DRAWS, rows))


def _without_each(log_density: Tensor) -> Tensor:
    """Return which draws, ``S' x n x m``, are those without each observation, by densities."""
    S = len(log_density)
    weight = (-log_density).nan_to_num(nan=0.0).softmax(0).clamp_max(S**-0.5)
    ends = (weight / weight.sum(0)).cumsum(0)
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
            chosen.append(torch.stack([each[rows, :, j] for each in (part.means, part.variances)]))
        outputs.append(torch.cat(chosen, 1))
    return torch.stack(outputs, -1)
