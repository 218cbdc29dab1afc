"""Leave-one-out predictions in closed form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from botorch.models import ModelListGP
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.utils.transforms import is_fully_bayesian
from linear_operator import to_dense
from torch import Tensor

from gpadjust.gp.noise import Noise
from gpadjust.models import StackedGP, TermsGP, VariationalCKA
from gpadjust.models.exact_conditioning import Factors
from gpadjust.models.heavy_tails import with_tails
from gpadjust.models.stacked import Part
from gpadjust.validation.scores import Scores, central_share

ROUNDING = 1e-8  # of the observations' standard deviation; to predict better shows nothing


@dataclass(frozen=True)
class LeaveOneOut:
    """Predictions of each observation from all the others, in the user's units.

    Attributes:
        X: Raw inputs, ``batch_shape x n x d``.
        Y: Observations, ``batch_shape x n x m``; NaN where there is none.
        mean: Their predictions, of the same shape.
        variance: The variances of the predictions, observation noise included.
        log_density: The log predictive densities of the observations, in nats, of the same shape;
            of a mixture its own, whose shape the other scores take as Gaussian; of standard
            deviations of at least 1e-8 of that of the observations, as less is rounding. NaN where
            there is no observation.
        output_names: The names of the outputs; empty if the model has none.
        pit: The predicted probabilities of less than was observed, of outputs with a link, whose
            predictions are not Gaussian; else None.
        is_outlier: Mask of the observations that count as outliers of a noise with heavy tails, of
            the shape of ``Y``; None of other noise. Mean and variance are of an observation that is
            none; the density allows that it may be one. Scores leave them out, but for the density.
    """

    X: Tensor
    Y: Tensor
    mean: Tensor
    variance: Tensor
    log_density: Tensor
    output_names: tuple[str, ...] = ()
    pit: Tensor | None = None
    is_outlier: Tensor | None = None

    @property
    def residuals(self) -> Tensor:
        """Standardized residuals, ``(Y - mean) / sd``, ``batch_shape x n x m``.

        Of outputs with a link they are those of normal numbers of the same probability.
        """
        if self.pit is not None:
            return torch.special.ndtri(self.pit.clamp(1e-15, 1 - 1e-15))
        return (self.Y - self.mean) / self.variance.sqrt()

    def below(self) -> Tensor:
        """The predicted probabilities of less than was observed, ``batch_shape x n x m``."""
        return torch.special.ndtr(self.residuals) if self.pit is None else self.pit

    def score(self, level: float = 0.95) -> Scores:
        """The scores of the predictions; the density is that of a mixture where they are one.

        Args:
            level: Nominal coverage, between 0 and 1.
        """
        names = self.output_names
        Y = self.Y if self.is_outlier is None else self.Y.masked_fill(self.is_outlier, torch.nan)
        scores = Scores.of(self.mean, self.variance, Y, level=level, output_names=names)
        if self.pit is not None:
            scores = replace(scores, pit=self.pit, coverage=central_share(self.pit, level))
        return replace(scores, nlpd=-self.log_density.nanmean(-2))


def leave_one_out(
    model: BatchedMultiOutputGPyTorchModel | ModelListGP | StackedGP,
) -> LeaveOneOut:
    r"""Predict each observation from all the others, without fitting again.

    The hyper-parameters (and the scale of the outcomes) stay as they are, so that each left-out
    observation has had its say in them: with few points the scores are optimistic. With the
    covariance :math:`K` of the observations, noise included, and
    :math:`\alpha = K^{-1} (y - m)`,

    .. math:: \mu_{-i} = y_i - \alpha_i / [K^{-1}]_{ii}, \quad
        \sigma^2_{-i} = 1 / [K^{-1}]_{ii}

    (Rasmussen and Williams 2006, eqs. 5.10-5.12; Sundararajan and Keerthi 2001). Of an
    :class:`~gpadjust.AR1` only points of the high level are left out.

    Of a model that holds samples of its hyper-parameters, these *are* without the left-out
    observation: a sample has the weight :math:`1 / p(y_i | y_{-i}, \theta)`, at most
    :math:`\sqrt S` times the average (Gelfand et al. 1992; Ionides 2008), and mean and variance
    are those of the weighted mixture. Of a :class:`~gpadjust.StackedGP` it is the mixture of its
    parts' predictions; its weights stay.

    Args:
        model: Any model of this library, a ``SingleTaskGP``, or a ``ModelListGP`` of such with the
            same training inputs. It stays as it is.

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
        return _join([leave_one_out(part) for part in model.models])
    if isinstance(model, StackedGP):
        return _join([_of_parts(parts) for parts in model.parts])
    if isinstance(model, VariationalCKA):
        raise TypeError(
            "Expected an exact model, got a VariationalCKA: of so many observations hold some out, "
            "build the model of the others, and compare model.interval(X) with what was held out."
        )
    if not isinstance(model, BatchedMultiOutputGPyTorchModel):
        raise TypeError(
            "Expected a model of this library, a SingleTaskGP, or a ModelListGP of such, got "
            f"{type(model).__name__}."
        )
    transform = getattr(model, "outcome_transform", None)
    if transform is not None and not isinstance(transform, Standardize):
        raise ValueError(
            f"The outcome transform {type(transform).__name__} is not a shift and scale, so the "
            "predictions are not Gaussian in the user's units; use Standardize or None, and "
            "transform the data beforehand."
        )
    with _evaluating(model), torch.no_grad():
        X, rows = _measurements(model)
        mean, variance = model.left_out() if isinstance(model, TermsGP) else _targets(model)
        targets = model.train_targets
        if isinstance(model, TermsGP):
            targets, mean = model.measured_targets(), mean + model.measured_targets() - targets
        Y, mean, variance = (
            _outputs_last(model, t)[..., rows, :] for t in (targets, mean, variance)
        )
        # A missing observation is predicted from all that there are, but not compared.
        missing, link, own_pit = Y.isnan(), getattr(model, "link", None), None
        mean, variance = mean.masked_fill(missing, 0.0), variance.masked_fill(missing, 1.0)
        if transform is not None:
            # Of a model with a link these are in its units.
            Y, mean = (Standardize.untransform(transform, values)[0] for values in (Y, mean))
            variance = variance * transform.stdvs.square()
        if is_fully_bayesian(model):
            X, Y = X.select(MCMC_DIM, 0), Y.select(MCMC_DIM, 0)
        else:
            mean, variance = mean.unsqueeze(MCMC_DIM), variance.unsqueeze(MCMC_DIM)
        density, is_outlier = log_densities(mean, variance, Y), None
        if isinstance(model, TermsGP) and model.has_heavy_tails:
            density = with_tails(density, Y.unsqueeze(MCMC_DIM) - mean, variance)
            kept = _outputs_last(model, model.noise.trusted(model.train_targets))[..., rows, :]
            kept = kept.select(MCMC_DIM, 0) if is_fully_bayesian(model) else kept
            is_outlier = kept.isnan() & ~Y.isnan()
        weight = _without_each(density)
        if link is not None:
            below = torch.special.ndtr((Y.unsqueeze(MCMC_DIM) - mean) / variance.sqrt())
            own_pit = (weight * below).sum(MCMC_DIM).clamp(0, 1)  # but for rounding
            own_pit = own_pit.masked_fill(Y.isnan(), torch.nan)
            (mean, variance), Y = link.moments(mean, variance), link.inverse(Y)
            density = density + link.log_slope(Y).unsqueeze(MCMC_DIM)
        mean, variance, density = _mixture_of(mean, variance, density, weight)
    X, Y = X[..., rows, :].expand(*mean.shape[:-1], X.shape[-1]), Y.expand(mean.shape)
    names = getattr(model, "output_names", ())
    return LeaveOneOut(X.clone(), Y.clone(), mean, variance, density, names, own_pit, is_outlier)


def log_densities(mean: Tensor, variance: Tensor, Y: Tensor) -> Tensor:
    """Return log densities ``... x n x m`` by Gaussians ``... x S x n x m``; NaN if missing."""
    spread = (Y - Y.nanmean(-2, keepdim=True)).square().nanmean(-2, keepdim=True).sqrt()
    sd = torch.maximum(variance.sqrt(), ROUNDING * spread.unsqueeze(MCMC_DIM))
    normal = torch.distributions.Normal(mean, sd, validate_args=False)
    return normal.log_prob(Y.unsqueeze(MCMC_DIM))


def _without_each(density: Tensor) -> Tensor:
    """Weights of samples that have seen all, for each observation to have had no say in them."""
    weight = (-density).nan_to_num(nan=0.0).softmax(MCMC_DIM)
    weight = weight.clamp_max(weight.shape[MCMC_DIM] ** -0.5)
    return weight / weight.sum(MCMC_DIM, keepdim=True)


def _mixture_of(
    mean: Tensor, variance: Tensor, density: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, variance and log density of mixtures with weights, 1 in all, along ``MCMC_DIM``."""
    center = (weight * mean).sum(MCMC_DIM, keepdim=True)
    spread = (mean - center).square()
    total = (weight.log() + density).logsumexp(MCMC_DIM)
    return center.squeeze(MCMC_DIM), (weight * (variance + spread)).sum(MCMC_DIM), total


def _of_parts(parts: Sequence[Part]) -> LeaveOneOut:
    """Return leave-one-out predictions by the mixture of several models of one output."""
    numbers = torch.tensor([part.number for part in parts], dtype=torch.float64)
    weight = (numbers / numbers.sum()).reshape(-1, 1, 1)
    return mixed([leave_one_out(part.model) for part in parts], weight)


def mixed(each: Sequence[LeaveOneOut], weight: Tensor) -> LeaveOneOut:
    """The predictions by a mixture of ``K`` models with weights ``K x 1 x m``, 1 in all."""
    parts = ((loo.mean, loo.variance, loo.log_density) for loo in each)
    mean, variance, density = (torch.stack(p, MCMC_DIM) for p in zip(*parts, strict=True))
    mean, variance, density = _mixture_of(mean, variance, density, weight)
    pit = None
    if any(loo.pit is not None for loo in each):
        pit = (weight * torch.stack([loo.below() for loo in each], MCMC_DIM)).sum(MCMC_DIM)
        pit = pit.clamp(0, 1)
    return replace(each[0], mean=mean, variance=variance, log_density=density, pit=pit)


def observations(model: Any) -> tuple[Tensor, Tensor]:
    """The observations that a model was given, ``n x d`` and ``n x m`` in the user's units.

    Of an :class:`~gpadjust.AR1` those of the high level; of a batch the first.
    """
    if isinstance(model, ModelListGP | StackedGP):
        several = isinstance(model, ModelListGP)
        models = model.models if several else [parts[0].model for parts in model.parts]
        parts = [observations(part) for part in models]
        return parts[0][0], torch.cat([Y for _, Y in parts], dim=-1)
    if isinstance(model, VariationalCKA):
        data: Any = model.data()
        return data["train_X"], data["train_Y"]
    with _evaluating(model), torch.no_grad():
        X, rows = _measurements(model)
        targets = model.measured_targets() if isinstance(model, TermsGP) else model.train_targets
        Y = _outputs_last(model, targets)
        transform = getattr(model, "outcome_transform", None)
        Y = Y if transform is None else transform.untransform(Y)[0]
    X, Y = X[..., rows, :], Y[..., rows, :]
    return X.reshape(-1, *X.shape[-2:])[0], Y.reshape(-1, *Y.shape[-2:])[0]


def _targets(model: Any) -> tuple[Tensor, Tensor]:
    """Return left-out predictions of targets, for models of other libraries."""
    inputs, y = model.train_inputs[0], model.train_targets
    covariance = to_dense(model.covar_module(inputs))
    residual = y - model.mean_module(inputs).expand(covariance.shape[:-1])
    noise = Noise(model.likelihood).at(inputs)
    factors = Factors.of(covariance + torch.diag_embed(noise.expand(residual.shape)), residual)
    variance = factors.squared_columns().reciprocal()
    return y - factors.alpha * variance, variance


def _measurements(model: Any) -> tuple[Tensor, slice]:
    """Raw training inputs, ``... x n x d``, and which rows of them can be left out."""
    inputs = model.train_inputs[0]
    raw = getattr(model, "_original_train_inputs", None)
    inputs = inputs if raw is None else raw
    if model.num_outputs > 1:
        inputs = inputs[..., 0, :, :]
    return model.measured_rows(inputs) if isinstance(model, TermsGP) else (inputs, slice(None))


def _outputs_last(model: Any, values: Tensor) -> Tensor:
    """Bring ``... x (m) x n`` to ``... x n x m``."""
    return values.mT if model.num_outputs > 1 else values.unsqueeze(-1)


@contextmanager
def _evaluating(model: Any) -> Iterator[None]:
    """Put the model in eval mode, in which its training inputs are transformed, for a while."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        if was_training:
            model.train()


def _join(parts: list[LeaveOneOut]) -> LeaveOneOut:
    """Put the outputs of several models side by side."""
    X = parts[0].X
    for part in parts[1:]:
        if part.X.shape != X.shape or not torch.equal(part.X, X):
            raise ValueError(
                "The models of the list have different training inputs, so their observations do "
                "not belong to the same points; call `leave_one_out` on each of `model.models`."
            )
    columns = ((part.Y, part.mean, part.variance, part.log_density) for part in parts)
    Y, mean, variance, density = (torch.cat(each, dim=-1) for each in zip(*columns, strict=True))
    names = tuple(name for part in parts for name in part.output_names)
    linked = any(part.pit is not None for part in parts)
    pit = torch.cat([part.below() for part in parts], dim=-1) if linked else None
    masks = [part.is_outlier for part in parts]
    told = any(mask is not None for mask in masks)
    pairs = zip(parts, masks, strict=True)
    none_too = [torch.zeros_like(p.Y, dtype=torch.bool) if m is None else m for p, m in pairs]
    is_outlier = torch.cat(none_too, dim=-1) if told else None
    return LeaveOneOut(X, Y, mean, variance, density, names, pit, is_outlier)
