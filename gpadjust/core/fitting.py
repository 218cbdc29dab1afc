"""Fit a model: draw its unknown numbers given the data, or find their most likely values."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gpadjust.core.noise import Noise
from gpadjust.core.nuts import CHAINS, nuts
from gpadjust.core.sample import (
    GROUPS,
    Draws,
    Normal,
    around_mode,
    maximise,
    sample,
)
from gpadjust.core.straight import Straight
from gpadjust.core.threads import threads_for
from gpadjust.core.unknowns import standard_normal
from gpadjust.physics.least_squares import least_squares_fit
from gpadjust.progress import long_work

if TYPE_CHECKING:
    from gpadjust.core.model import GP

_SMALL = 40  # points: up to these draws begin with the prior
_MEDIUM, _SHARED = 100, 200  # up to these they are moved; the latter if outputs share numbers
_FIRST = 4  # draws from Laplace's approximation for each one that is kept
_SELDOM = 1e-3  # a nested model of less probability at its mode is not drawn from
_OF_NUTS = 640  # draws, a multiple of 16
_BEFORE_NUTS = 512  # draws of the default fit, around which chains jump
_SEARCHES = 4  # for the mode
_STEPS, _STEPS_OF_SHARED = 2_000, 200  # the latter with a fit by least squares, and begun again
_NEAR = 0.3  # difference of all coordinates below which two searches have found the same mode
_LESS_LIKELY = 5.0  # difference of log density from the best mode beyond which a mode is ignored
_MIXED = 1.05  # R-hat below which chains agree
_MOVED = 0.35  # predicted standard deviations by which another seed may move the mean


class SamplingWarning(UserWarning):
    """Another seed would move predictions by much."""


@dataclass(frozen=True)
class FitResult:
    """What :func:`fit` has found; its text is what to read first.

    Args:
        method: ``"bayes"``, ``"map"`` or ``"nuts"``.
        log_evidence: The log probability of the targets of each output, ``m``, in their units (of
            outputs that share unknown numbers, of all together); None of a point fit and of NUTS, a
            lower bound of many rows.
        probabilities: The probability of each nested model by its text, for each output.
        effective: The least number of starting draws that count, of all outputs.
        error: By how many predicted standard deviations another seed would move the mean at a
            training input that is left out, root mean square; NaN of a point fit.
        num_draws: How many draws predictions average over.
        parameter_error: By how many posterior standard deviations another seed would move the mean
            of an unknown parameter of the physics, at most; NaN without any and of a point fit.
        rhat: The worst split R-hat of all numbers; NaN but of NUTS.
    """

    method: str
    log_evidence: Tensor | None = None
    probabilities: dict[str, list[float]] = field(default_factory=dict)
    effective: float = math.nan
    error: float = math.nan
    num_draws: int = 1
    parameter_error: float = math.nan
    rhat: float = math.nan

    @property
    def converged(self) -> bool:
        """Whether predictions hardly depend on the seed."""
        return not (self.error > _MOVED or self.rhat > _MIXED)

    def __str__(self) -> str:
        lines, outputs = [], [*zip(*self.probabilities.values(), strict=True)]
        for j, shares in enumerate(outputs):
            parts = [f"{text} {p:.2f}" for text, p in zip(self.probabilities, shares, strict=True)]
            which = f" (output {j + 1})" if len(outputs) > 1 else ""
            lines.append(f"Probabilities{which}: {', '.join(parts)}.")
        if self.method == "map":
            lines.append("Point fit: intervals ignore what is unknown of the hyper-parameters.")
        elif self.method == "nuts":
            text = f"NUTS, {CHAINS} chains; the worst split R-hat is {self.rhat:.3f}."
            lines.append(f"{self.num_draws} draws; {text}")
        else:
            lines.append(
                f"{self.num_draws} draws; another seed would move predictions by {self.error:.2f} "
                "of their standard deviation."
            )
            if not math.isnan(self.parameter_error):
                lines[-1] += f" It would move means of parameters by {self.parameter_error:.2f}."
        return "\n".join(lines)


def fit(
    model: GP, method: str = "bayes", *, num_draws: int | None = None, seed: int = 0
) -> FitResult:
    """Fit a model to its data, from the prior: what it held before has no influence.

    ``"bayes"`` draws all unknown numbers from their posterior: by sequential Monte Carlo from the
    prior up to 40 points, from Laplace's approximation beyond; beyond 100 points (200 if outputs
    share unknown numbers, as parameters of a physics) its draws are weighted once and not moved.
    Nested models are drawn from apart and pooled by their posterior probabilities. ``"map"``
    brings the numbers of the whole model to their most likely values. ``"nuts"`` draws from the
    same density by Pyro's NUTS, in four chains that also jump around draws of the default fit: a
    slow reference, of a model without nested ones.
    After five seconds a bar of tqdm shows that it goes on.

    Args:
        model: The model.
        method: ``"bayes"``, ``"map"`` or ``"nuts"``.
        num_draws: Number of draws, a multiple of 4 (of NUTS from 16 on); predictions average over a
            quarter of them. Default: 80, 32 (of more than 40 points) or 16 (of more than 100), or
            256, 128 or 64 if outputs share unknown numbers, as parameters of a physics; predictions
            then average over 16, 8 or 4 of them. Of NUTS 640, after half as many that are not
            kept.
        seed: Seed.

    Warns:
        SamplingWarning: If another seed would move predictions by much, or chains do not agree.

    Raises:
        ValueError: If the method or number of draws is another one, or the data are a batch; of
            NUTS also if the model is averaged with nested ones, or is fitted without a density.

    Example:
        >>> import torch
        >>> from gpadjust.core import ZeroMeanGP, fit
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> fit(ZeroMeanGP(X, X.sin())).converged
        True
    """
    if not hasattr(model, "log_likelihood"):
        raise TypeError(f"Expected a model of gpadjust.core; found {type(model).__name__}.")
    if method not in ("bayes", "map", "nuts"):
        raise ValueError(f"Unknown method {method!r}; expected 'bayes', 'map' or 'nuts'.")
    if method == "nuts":
        _check_density(model)
    least = 4 * CHAINS if method == "nuts" else 4  # R-hat needs four draws a chain
    if num_draws is not None and (num_draws < least or num_draws % 4):
        raise ValueError(
            f"Expected num_draws as a multiple of 4, from {least} on; found {num_draws}."
        )
    if model.data.Y.dim() > 2:
        batch = tuple(model.batch_shape)
        raise ValueError(f"Expected a model of one data set; found fantasies, a batch {batch}.")
    with threads_for(len(model.data.Y)), long_work("fit", "evaluations"):
        result: FitResult | None = model.fit_itself(method, num_draws, seed)
        if result is None:
            result = _fitted(model, method, num_draws, seed)
    if result.rhat > _MIXED:
        warnings.warn(
            f"Chains do not agree, split R-hat is {result.rhat:.2f}. Draw more: "
            f"fit(model, 'nuts', num_draws={4 * len(model.draws)}).",
            SamplingWarning,
            stacklevel=2,
        )
    if result.error > _MOVED:
        warnings.warn(
            f"Predictions depend on the seed: another one would move them by {result.error:.2f} of "
            "their standard deviation. Draw more: "
            f"fit(model, num_draws={4 * len(model.draws)}).",
            SamplingWarning,
            stacklevel=2,
        )
    return result


def _check_density(model: GP) -> None:
    """Raise a ValueError if NUTS cannot draw from the model."""
    if not model.has_density:
        raise ValueError(
            f"{type(model).__name__} has no density of its unknown numbers, which NUTS needs; take "
            "a model of gpadjust.core with fewer rows."
        )
    if model.table.choices:
        raise ValueError(
            "NUTS does not draw from several nested models; build the model with nested=False, and "
            "compare with the default fit of that."
        )


def _fitted(model: GP, method: str, num_draws: int | None, seed: int) -> FitResult:
    """Let a model hold draws, or the most likely coordinates."""
    model.noise = model.noise.learnt(model, partial(_roughly_fitted, model, seed))
    if method == "map":
        mode = modes(model, 0, seed, is_precise=True)[:1]
        if model.table.shared:
            start, _ = around_mode(partial(model.log_likelihood, choice=0), mode[0], True)
            mode = model.table.with_choice(start.mean.unsqueeze(0), 0)
        model.set_draws(mode)
        return FitResult(method)
    if method == "nuts":
        number = num_draws or _OF_NUTS
        first = _sampled(model, _BEFORE_NUTS, seed)[0].u
        draws, rhat = nuts(model, first, number, seed)
        model.set_draws(draws, number // 4)
        return FitResult(method, num_draws=len(model.u), rhat=rhat)
    number, kept = _default_numbers(model) if num_draws is None else (num_draws, num_draws // 4)
    sampled = _sampled(model, number, seed)
    weights = _weights(model, {k: draws.log_evidence for k, draws in sampled.items()})
    shares = weights.mean(1)  # K x B
    model.set_draws(_pooled(sampled, shares, number), kept)
    # Two groups that were resampled apart, with the weights of nested models by each of them.
    groups = [_pooled(sampled, weights[:, g], number // GROUPS, g + 1) for g in range(GROUPS)]
    error = _error(model, groups) * math.sqrt(number / kept)
    has_unknowns = any(physics.unknowns for physics in model.physics)
    parameter_error = _parameter_error(model, groups) if has_unknowns else math.nan
    choices = zip(model.table.choices, shares.expand(-1, len(model.unit)).tolist(), strict=False)
    effective = min(float(draws.effective.min()) for draws in sampled.values())
    return FitResult(
        method, _evidence(model, sampled), {choice.text: p for choice, p in choices},
        effective, error, len(model.u), parameter_error,
    )  # fmt: skip


def _roughly_fitted(model: GP, seed: int, noise: Noise) -> GP:
    """Return a copy of a model with another noise, at its most likely numbers."""
    copy = model.with_noise(noise)
    copy.set_draws(modes(copy, 0, seed)[:1])
    return copy


def _default_numbers(model: GP) -> tuple[int, int]:
    """Return how many draws are made, and over how many of them predictions average."""
    n, is_shared = model.targets().shape[-1], bool(model.table.shared)
    if n <= _SMALL:
        return 256 if is_shared else 80, 16
    if n <= _MEDIUM:
        return 128 if is_shared else 32, 8
    return 64 if is_shared else 16, 4


def _sampled(model: GP, number: int, seed: int) -> dict[int, Draws]:
    """Return draws of each nested model; of more than 40 rows of each that is likely enough."""
    n, prior = model.targets().shape[-1], model.table.log_prior
    has_moves = n <= (_SHARED if model.table.shared else _MEDIUM)
    is_small, like = n <= _SMALL, model.u.detach()[0]
    starts = {} if is_small and not model.table.shared else _starts(model, seed)
    sampled: dict[int, Draws] = {}
    for k in range(len(prior)) if is_small else starts:
        draw = partial(sample, like=like, number=number, seed=seed)
        density = partial(model.log_likelihood, choice=k)
        draws = draw(density) if is_small else None
        if k in starts and model.table.shared:
            straight, first = Straight(model, starts[k], k), draws
            points = straight.points(_FIRST * number, seed)
            draws = draw(
                straight, start=straight.start, first=_FIRST, with_moves=has_moves, points=points
            )
            draws = draws._replace(u=straight.coordinates(draws.u))
            draws = draws if first is None else _joined(draws, first, straight.misses(first.u))
        elif draws is None:
            draws = draw(density, start=starts[k], first=_FIRST, with_moves=has_moves)
        sampled[k] = draws._replace(u=model.table.with_choice(draws.u, k))
    return sampled


def _joined(draws: Draws, others: Draws, is_missed: Tensor) -> Draws:
    """Return draws of a part of the posterior of one problem, and the others from beyond it.

    Each group of both has a share by its evidence, of the others by that of those missed ``N``.
    """
    parts, evidence = [], []
    groups = (draws.u.chunk(GROUPS), others.u.chunk(GROUPS), is_missed.chunk(GROUPS))
    for g, (u, v, missed) in enumerate(zip(*groups, strict=True)):
        beyond = others.log_evidence[g] + missed.to(u).mean().log()
        logs = torch.cat([draws.log_evidence[g], beyond])
        counts = _counts(logs.softmax(0), len(u))
        for each, count in zip((u, v[missed]), counts, strict=True):
            at = (torch.arange(count) + 0.5) * len(each) / max(count, 1)
            parts.append(each[at.long()])
        evidence.append(logs.logsumexp(0, keepdim=True))
    return Draws(torch.cat(parts), torch.stack(evidence), draws.effective)


def _starts(model: GP, seed: int) -> dict[int, Normal]:
    """Return Laplace's approximation of each nested model that is likely enough.

    Modes are searched by some of the rows first, then from there by four times as many, up to all.
    A nested model that is unlikely by some of them is left out: that its odds recover has a
    probability of the odds at most (Ville's inequality).
    """
    ends: dict[int, Tensor] = {}
    is_precise = bool(model.table.shared)  # parameters of a physics may be known to many digits
    likely = [*range(len(model.table.log_prior))]
    for part in _parts(model, seed):
        for k in likely:
            is_first = k not in ends
            ends[k] = (
                modes(part, k, seed, is_precise)
                if is_first
                else _sorted(
                    part, k, maximise(partial(part.log_likelihood, choice=k), ends[k], is_precise)
                )
            )
        starts = {
            k: around_mode(partial(part.log_likelihood, choice=k), ends[k][0], is_precise)
            for k in likely
        }
        likely = _likely(model, {k: evidence for k, (_, evidence) in starts.items()})
    return {k: starts[k][0] for k in likely}


def _parts(model: GP, seed: int) -> list[GP]:
    """Return models of 40 rows, 160 and so on, as far as the noise has fewer, and the whole."""
    n, size = len(model.data.Y), _SMALL
    parts: list[GP] = []
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    while 2 * size < n:
        part = model.subset_rows(order[:size].sort().values)
        parts += [] if part is None else [part]
        size *= 4
    return [*parts, model]


def modes(model: GP, choice: int, seed: int, is_precise: bool = False) -> Tensor:
    """Return the most likely end of some searches, or two that are nearly as likely, ``2 x B x P``.

    Searches begin with the most likely of some draws from the prior, and the medians of the priors.
    """
    like, number = model.u.detach()[0], max(16, 6400 // max(len(model.data.Y), 25))
    generator = torch.Generator().manual_seed(seed)
    u = standard_normal((number, *like.shape), generator, like)
    searches = _SEARCHES if choice == 0 else _SEARCHES // 2
    begins = torch.cat([_sorted(model, choice, u)[: searches - 1], torch.zeros_like(u[:1])])
    if model.table.shared:
        begins[-2] = _with_least_squares(model, choice, u)
    most = _STEPS_OF_SHARED if is_precise and model.table.shared else _STEPS
    ends = maximise(partial(model.log_likelihood, choice=choice), begins, is_precise, most)
    ends = _sorted(model, choice, ends)
    density = _log_density(model, choice, ends)
    is_near = (ends - ends[0]).abs().amax(-1) < _NEAR
    rival, second = density.masked_fill(is_near, -math.inf).max(0)
    if not (rival > density[0] - _LESS_LIKELY).any():
        return ends[:1]
    return torch.stack([ends[0], ends[second, torch.arange(len(like))]])


def _with_least_squares(model: GP, choice: int, u: Tensor) -> Tensor:
    """Return coordinates ``B x P`` with the parameters that fit targets best.

    Others are in the middle of their priors; the search takes draws from these, ``N x B x P``.
    """
    p, targets = len(model.table.shared), model.targets().nan_to_num().flatten()
    others = torch.zeros_like(u[:1, :, :-p])

    def misfit(z: Tensor) -> Tensor:
        at = torch.cat([others.expand(len(z), -1, -1), z.to(u).unsqueeze(1)], -1)
        return (model.prior_mean(model.table.with_choice(at, choice)) - targets).cpu()

    z = least_squares_fit(misfit, u[:, 0, -p:].cpu()).to(u)
    return torch.cat([others[0], z.unsqueeze(0)], -1)


def _sorted(model: GP, choice: int, u: Tensor) -> Tensor:
    """Return coordinates ``N x B x P`` of a nested model, the most likely ones first."""
    order = _log_density(model, choice, u).argsort(0, descending=True)
    return model.table.with_choice(u.gather(0, order.unsqueeze(-1).expand_as(u)), choice)


def _log_density(model: GP, choice: int, u: Tensor) -> Tensor:
    """Return the log posterior density of a nested model but for a constant, ``N x B``."""
    density = partial(model.log_likelihood, choice=choice)(u, False)[0] - 0.5 * u.square().sum(-1)
    return density.nan_to_num(nan=-math.inf)


def _likely(model: GP, log_evidence: dict[int, Tensor]) -> list[int]:
    """Return the nested models that are not unlikely in all problems."""
    weights = _weights(model, {k: value.unsqueeze(0) for k, value in log_evidence.items()})
    return [k for k in log_evidence if bool((weights[k] > _SELDOM).any())]


def _weights(model: GP, log_evidence: dict[int, Tensor]) -> Tensor:
    """Return posterior probabilities ``K x G x B`` by log evidences ``G x B``."""
    prior = model.table.log_prior
    like = next(iter(log_evidence.values()))
    logs = like.new_full((len(prior), *like.shape), -math.inf)
    for k, value in log_evidence.items():
        logs[k] = prior[k] + value
    return logs.softmax(0)


def _evidence(model: GP, sampled: dict[int, Draws]) -> Tensor:
    """Return the log evidence of each problem, in the user's units."""
    prior = model.table.log_prior
    logs = torch.stack([prior[k] + draws.log_evidence for k, draws in sampled.items()])
    total = logs.logsumexp(0).logsumexp(0) - math.log(GROUPS)
    units = model.log_jacobian()
    return total + (units if len(total) > 1 else units.sum())


def _pooled(draws: Mapping[int, Draws], weights: Tensor, number: int, part: int = 0) -> Tensor:
    """Return ``number x B x P`` draws of all nested models in proportion to weights ``K x B``.

    They are of all draws, or, with the part 1 or 2, of one of the groups.
    """
    problems = []
    for b in range(weights.shape[-1]):
        drawn = []
        for k, count in enumerate(_counts(weights[:, b], number)):
            if count:
                u = draws[k].u if not part else draws[k].u.chunk(GROUPS)[part - 1]
                at = (torch.arange(count) + 0.5) * len(u) / count
                drawn.append(u[at.long(), b])
        problems.append(torch.cat(drawn))
    return torch.stack(problems, 1)


def _counts(shares: Tensor, number: int) -> list[int]:
    """Return whole numbers in proportion to shares, of a given sum, by largest remainders."""
    exact = shares * number
    counts = exact.floor()
    order = (counts - exact).argsort()
    counts[order[: number - int(counts.sum())]] += 1
    return [int(count) for count in counts]


def _error(model: GP, groups: list[Tensor]) -> float:
    """Return how far another seed would move the mean, in predicted standard deviations.

    Both groups of draws predict the left-out targets. The difference of two means of N / 2 draws
    has a standard deviation twice that of one of N.
    """
    predicted = [model.left_out_at(u) for u in groups]
    mean, variance = (torch.cat(each) for each in zip(*predicted, strict=True))
    sd = (variance.mean(0) + mean.var(0, correction=0)).sqrt()
    difference = (predicted[0][0].mean(0) - predicted[1][0].mean(0)) / 2
    return float((difference / sd).square().nanmean().sqrt())


def _parameter_error(model: GP, groups: list[Tensor]) -> float:
    """Return how far another seed would move the mean of a parameter of the physics.

    It is in posterior standard deviations, the largest of all parameters.
    """
    one, other = (model.physics_parameters_at(u).mean for u in groups)
    error = (one - other).abs() / (2 * model.physics_parameters_at(torch.cat(groups)).sd)
    return float(error.nan_to_num().max())  # 0 / 0 where all draws are the same
