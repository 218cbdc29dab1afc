"""Leave-one-out predictions in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from botorch.models import ModelListGP, SingleTaskGP
from botorch.models.transforms.outcome import Standardize
from torch import Tensor

from gpadjust.core import GP, StackedGP
from gpadjust.core.gaussian import DRAWS, Marginals
from gpadjust.validation.scores import Scores, central_share

ROUNDING = 1e-8  # of the observations' standard deviation; to predict better shows nothing
_FAR = 6.0  # standard deviations, where a probability next to 1 is rounded
_CLEAR = 3.5  # standard errors, below which a correlation of errors counts as none
_LEAST = 1e-6  # eigenvalue of a correlation matrix
_COMPONENTS = 64  # that draws are resampled to, for each observation


@dataclass(frozen=True)
class LeaveOneOut:
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
        output_names: The names of the outputs; empty if the model has none.
        is_outlier: Whether an observation is an outlier of a noise with heavy tails, ``n x m``;
            None of other noise. Scores leave these out, but for the density.
    """

    X: Tensor
    Y: Tensor
    mean: Tensor
    variance: Tensor
    log_density: Tensor
    pit: Tensor
    output_names: tuple[str, ...] = ()
    is_outlier: Tensor | None = None

    @property
    def residuals(self) -> Tensor:
        """Normal numbers of the same probability as the observations, ``n x m``.

        Of a Gaussian prediction, and far out, they are ``(Y - mean) / sd``.
        """
        z = torch.special.ndtri(self.pit)
        return torch.where(z.abs() < _FAR, z, (self.Y - self.mean) / self.variance.sqrt())

    def score(self, level: float = 0.95) -> Scores:
        """Return the scores of the predictions.

        Args:
            level: Nominal coverage, between 0 and 1.
        """
        Y = self.Y if self.is_outlier is None else self.Y.masked_fill(self.is_outlier, torch.nan)
        names, pit = self.output_names, self.pit.masked_fill(Y.isnan(), torch.nan)
        mean = self.mean.nan_to_num()  # where nothing was observed
        scores = Scores.of(mean, self.variance, Y, level=level, output_names=names)
        share, nlpd = central_share(pit, level), -self.log_density.nanmean(-2)
        return replace(scores, pit=pit, coverage=share, nlpd=nlpd)


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
        model: A model of this library, a ``SingleTaskGP``, or a ``ModelListGP`` of such with the
            same training inputs.

    Raises:
        TypeError: If the model is of another kind.
        ValueError: If its outcome transform is not a shift and scale, or the parts of a list have
            different inputs.

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
    if isinstance(model, ModelListGP):
        return _side_by_side([leave_one_out(part) for part in model.models])
    if isinstance(model, SingleTaskGP):
        return _of_botorch(model)
    if not isinstance(model, StackedGP) and not isinstance(model, GP):
        raise TypeError(
            "Expected a model of this library, a SingleTaskGP, or a ModelListGP of such; found "
            f"{type(model).__name__}. Of a model without leave-one-out predictions hold some "
            "observations out, and compare model.interval(X) with them."
        )
    marginals, data = _left_out(model), model.data
    Y = data.Y
    is_outlier = getattr(getattr(model, "noise", None), "is_outlier", None)
    return LeaveOneOut(
        data.X, Y, *marginals.prediction, marginals.log_density(Y), marginals.probability(Y),
        data.output_names, is_outlier,
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


def _of_botorch(model: SingleTaskGP) -> LeaveOneOut:
    """Return leave-one-out predictions by a model of BoTorch, in the user's units."""
    transform = getattr(model, "outcome_transform", None)
    if transform is not None and not isinstance(transform, Standardize):
        raise ValueError(
            "Expected outcome_transform as Standardize or None, so that predictions are Gaussian "
            f"in the user's units; found {type(transform).__name__}. Transform the data before."
        )
    was_training = model.training
    model.train()  # in which its inputs are the user's
    X, y = model.train_inputs[0], model.train_targets
    prior = model.likelihood(model(X), [X])
    alpha = torch.linalg.solve(prior.covariance_matrix, (y - prior.mean).unsqueeze(-1)).squeeze(-1)
    variance = prior.covariance_matrix.inverse().diagonal(dim1=-1, dim2=-2).reciprocal()
    model.train(was_training)
    several = model.num_outputs > 1
    X = X[0] if several else X
    Y, mean, variance = (
        each.mT if several else each.unsqueeze(-1) for each in (y, y - alpha * variance, variance)
    )
    if transform is not None:
        Y, _ = transform.untransform(Y)
        mean, variance = transform.untransform(mean, variance)
    marginals = Marginals(mean.unsqueeze(DRAWS), variance.unsqueeze(DRAWS))
    return LeaveOneOut(X, Y, mean, variance, marginals.log_density(Y), marginals.probability(Y))


def _side_by_side(parts: Sequence[LeaveOneOut]) -> LeaveOneOut:
    """Return the outputs of several models as those of one."""
    first = parts[0]
    if any(part.X.shape != first.X.shape or not torch.equal(part.X, first.X) for part in parts):
        raise ValueError(
            "Expected models of the same training inputs in the list; found others: call "
            "`leave_one_out` on each of `model.models`."
        )
    names = ("Y", "mean", "variance", "log_density", "pit")
    columns: dict[str, Any] = {n: torch.cat([getattr(p, n) for p in parts], -1) for n in names}
    masks = [part.is_outlier for part in parts]
    if any(mask is not None for mask in masks):
        none = [torch.zeros_like(part.Y, dtype=torch.bool) for part in parts]
        pairs = zip(masks, none, strict=True)
        columns["is_outlier"] = torch.cat([n if mask is None else mask for mask, n in pairs], -1)
    outputs = tuple(name for part in parts for name in part.output_names)
    return replace(first, output_names=outputs, **columns)


def observations(model: Any) -> tuple[Tensor, Tensor]:
    """Return the observations of a model in the user's units, ``n x d`` and ``n x m``."""
    if hasattr(model, "data"):
        return model.data.X, model.data.Y
    loo = leave_one_out(model)
    return loo.X, loo.Y


def error_correlation(model: Any) -> Tensor | None:
    r"""The correlation of outputs by a model's left-out errors, ``m x m``; None if none is clear.

    A correlation r of n pairs has the standard error :math:`(1 - r^2) / \sqrt n`. It counts where
    :math:`|r| \sqrt n` is more than 3.5, and is shrunk by the share of its square that is chance
    (Schaefer and Strimmer 2005).
    """
    if model.num_outputs < 2 or not isinstance(model, GP):
        return None
    errors = model.data.Y - model.left_out().prediction.mean
    seen = ~errors.isnan()
    errors, seen = errors.nan_to_num(nan=0.0), seen.double()
    number = (seen.mT @ seen).clamp_min(1.0)
    size = (errors.square().mT @ seen).clamp_min(torch.finfo(errors.dtype).tiny)
    r = (errors.mT @ errors) / (size * size.mT).sqrt()
    clear = r.abs() * number.sqrt() > _CLEAR
    chance = (1 - r.square()).square() / (number * r.square().clamp_min(1e-12))
    r = torch.where(clear, r * (1 - chance).clamp_min(0.0), 0.0)
    r.fill_diagonal_(1.0)
    if not (r - torch.eye(len(r))).any():
        return None
    values, vectors = torch.linalg.eigh(r)
    if values[0] < _LEAST:  # pairs that are seen together in other rows than others
        r = vectors * values.clamp_min(_LEAST) @ vectors.mT
        sd = r.diagonal().sqrt()
        r = r / sd / sd.unsqueeze(-1)
    return r
