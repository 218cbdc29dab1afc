"""Fit a model: draw its unknown numbers given the data, or find their most likely values."""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.core.noise import Noise
from gpadjust.core.nuts import CHAINS, nuts
from gpadjust.core.sample import GROUPS, Draws, Normal, around_mode, maximise, sample
from gpadjust.core.straight import Straight
from gpadjust.core.unknowns import standard_normal
from gpadjust.physics.error import PhysicsError
from gpadjust.physics.least_squares import least_squares_fit
from gpadjust.progress import long_work
from gpadjust.threads import threads_for

if TYPE_CHECKING:
    from gpadjust.core.model import GP

_SMALL = 40  # points: up to these draws begin with the prior
_MEDIUM, _SHARED = 100, 200  # up to these they are moved; the latter if outputs share numbers
_FIRST_OF_PRIOR = 16  # draws from the prior for each one that results
_FEWER = 4  # times, of these draws, where they only look for missed parts of the posterior
_FIRST = 4  # draws from Laplace's approximation for each one that results
_SELDOM = 1e-3  # a nested model of less probability at its mode is not drawn from
_OF_NUTS = 640  # draws, a multiple of 16
_BEFORE_NUTS = 512  # draws of the default fit, around which chains jump
_SEARCHES = 4  # for the mode
_BEFORE_SEARCH, _FIRST_OF_SEARCH = 64, 32  # draws of a point fit, and how many begin for each
_STEPS, _STEPS_OF_SHARED = 2_000, 200  # the latter with a fit by least squares, and begun again
_NEAR = 0.3  # difference of all coordinates below which two searches have found the same mode
_LESS_LIKELY = 5.0  # difference of log density from the best mode beyond which a mode is ignored
_MIXED = 1.05  # R-hat below which chains agree
_MOVED = 0.35  # predicted standard deviations by which another seed may move the mean


class SamplingWarning(UserWarning):
    """Another seed would move predictions by much."""


@dataclass(frozen=True)
class FitResult:
    """Result of :func:`fit`, with a text that summarises it.

    Args:
        method: ``"bayes"``, ``"map"`` or ``"nuts"``.
        log_evidence: The log probability of the targets of each output, ``m``, in their units (of
            outputs that share unknown numbers, of all together); None of a point fit and of NUTS, a
            lower bound of many rows.
        probabilities: The probability of each nested model by its text, for each output.
        error: Change of the mean at a left-out training input by another seed, root mean square, in
            predicted standard deviations; NaN of a point fit.
        num_draws: How many draws predictions average over.
        parameter_error: Change of the mean of an unknown parameter of the physics by another seed,
            at most, in posterior standard deviations; NaN without any and of a point fit.
        rhat: The worst split R-hat of all numbers; NaN but of NUTS.
    """

    method: str
    log_evidence: Tensor | None = None
    probabilities: dict[str, list[float]] = field(default_factory=dict)
    error: float = math.nan
    num_draws: int = 1
    parameter_error: float = math.nan
    rhat: float = math.nan

    @property
    def converged(self) -> bool:
        """Whether predictions hardly depend on the seed."""
        return not (self.error > _MOVED or self.rhat > _MIXED)

    def __str__(self) -> str:
        lines = []
        outputs = [*zip(*self.probabilities.values(), strict=True)]
        for j, shares in enumerate(outputs):
            parts = [f"{text} {p:.2f}" for text, p in zip(self.probabilities, shares, strict=True)]
            output = f" (output {j + 1})" if len(outputs) > 1 else ""
            lines.append(f"Probabilities{output}: {', '.join(parts)}.")
        if self.method == "map":
            lines.append("Point fit: intervals ignore the uncertainty of the hyper-parameters.")
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
    """Fit a model to its data, whatever its draws were before.

    ``"bayes"`` draws all unknown numbers from their posterior: by sequential Monte Carlo from the
    prior up to 40 points, from Laplace's approximation beyond; beyond 100 points (200 if outputs
    share unknown numbers, as parameters of a physics) its draws are weighted once and not moved.
    Where a physics has unknown parameters and a term varies, what draws from the prior reach beyond
    is added up to 100 points.
    Nested models are pooled by their posterior probabilities. ``"map"`` finds the most likely
    numbers of the whole model. ``"nuts"`` is a slow reference without nested models: Pyro's NUTS in
    four chains that also jump around draws of the default fit. A bar shows progress after 5 s.

    Args:
        model: The model.
        method: ``"bayes"``, ``"map"`` or ``"nuts"``.
        num_draws: Number of draws, a multiple of 4 (of NUTS from 16 on); predictions average over a
            quarter of them. Default: 80, 32 (of more than 40 points) or 16 (of more than 100), or
            256, 128 or 64 if outputs share unknown numbers; predictions then average over 16, 8 or
            4 of them. Of NUTS 640, after half as many to adapt.
        seed: Seed.

    Warns:
        SamplingWarning: If another seed would change predictions by much, or chains do not agree.

    Raises:
        ValueError: If the method or number of draws is unknown, or the data are a batch; of NUTS
            also if there are nested models or no density.
        TypeError: If it is not a model of this library, or num_draws is not a whole number.
        PhysicsError: If the physics fails by nearly all draws of its parameters.
        ImportError: Of NUTS, if Pyro is not installed.

    Example:
        >>> import torch
        >>> from gpadjust.core import ZeroMeanGP, fit
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> fit(ZeroMeanGP(X, X.sin())).converged
        True
    """
    if not hasattr(model, "log_likelihood"):
        raise TypeError(
            f"Expected a model of gpadjust.core; found {type(model).__name__}. Of a list fit each "
            "model: for part in model.models: fit(part)."
        )
    if method not in tuple(_METHODS):
        raise ValueError(f"Unknown method {method!r}; expected 'bayes', 'map' or 'nuts'.")
    if method == "nuts" and not model.has_density:
        kind = type(model).__name__
        raise ValueError(f"{kind} has no density for NUTS; take a model of fewer rows.")
    if method == "nuts" and model.table.choices:
        raise ValueError("NUTS does not draw from nested models; build it with nested=False.")
    least = 4 * CHAINS if method == "nuts" else 4  # R-hat needs four draws a chain
    if num_draws is not None:
        num_draws = checked_whole("num_draws", num_draws)
        if num_draws < least or num_draws % 4:
            expected = f"a multiple of 4, from {least} on"
            raise ValueError(f"Expected num_draws as {expected}; found {num_draws}.")
    if model.data.Y.dim() > 2:
        batch = tuple(model.batch_shape)
        raise ValueError(f"Expected a model of one data set; found fantasies, a batch {batch}.")
    with threads_for(len(model.data.Y)), long_work("fit", "evaluations"):
        result: FitResult | None = model.fit_itself(method, num_draws, seed)
        if result is None:
            model.noise = model.noise.learnt(model, partial(_roughly_fitted, model, seed))
            result = _METHODS[method](model, num_draws, seed)
    if result.rhat > _MIXED:
        warnings.warn(
            f"Chains do not agree, split R-hat is {result.rhat:.2f}. Draw more: "
            f"fit(model, 'nuts', num_draws={4 * len(model.draws)}).",
            SamplingWarning, stacklevel=2,
        )  # fmt: skip
    if result.error > _MOVED:
        warnings.warn(
            f"Predictions depend on the seed: another one would move them by {result.error:.2f} of "
            f"their standard deviation. Draw more: fit(model, num_draws={4 * len(model.draws)}).",
            SamplingWarning, stacklevel=2,
        )  # fmt: skip
    return result


def _most_likely(model: GP, num_draws: int | None, seed: int) -> FitResult:
    """Set the most likely coordinates of the whole model; a number of draws has no effect."""
    first, *others = _parts(model, seed)
    mode = modes(first, 0, seed, True)
    for part in others:
        mode = _rivals(part, 0, modes(part, 0, seed, True, mode))
    if model.table.shared:
        start, _ = around_mode(partial(model.log_likelihood, choice=0), mode[0], True)
        mode = model.table.with_choice(start.mean.unsqueeze(0), 0)
    model.set_draws(mode[:1])
    return FitResult("map")


def _by_nuts(model: GP, num_draws: int | None, seed: int) -> FitResult:
    """Set draws by NUTS, which begins with those of the default fit."""
    number = num_draws or _OF_NUTS
    draws, rhat = nuts(model, _sampled(model, _BEFORE_NUTS, seed)[0].u, number, seed)
    model.set_draws(draws, number // 4)
    return FitResult("nuts", num_draws=len(model.u), rhat=rhat)


def _averaged(model: GP, num_draws: int | None, seed: int) -> FitResult:
    """Set draws of all nested models, pooled by their probabilities."""
    number, averaged = _default_numbers(model)
    if num_draws is not None:
        number, averaged = num_draws, num_draws // 4
    sampled = _sampled(model, number, seed)
    weights = _weights(model, {k: draws.log_evidence for k, draws in sampled.items()})
    shares = weights.mean(1)  # K x B
    model.set_draws(_pooled(sampled, shares, number), averaged)
    # Two groups that were resampled apart, with the weights of nested models by each of them.
    half = number // GROUPS
    slices = [slice(g * half, (g + 1) * half) for g in range(GROUPS)]
    groups = [_pooled(sampled, weights[:, g], half, slices[g]) for g in range(GROUPS)]
    parameter_error = math.nan
    if any(f_p.unknowns for f_p in model.physics):
        parameter_error = _parameter_error(model, groups)
    choices = zip(model.table.choices, shares.expand(-1, len(model.unit)).tolist(), strict=False)
    return FitResult(
        "bayes",
        _evidence(model, sampled),
        {choice.text: probabilities for choice, probabilities in choices},
        _error(model, groups) * math.sqrt(number / averaged),
        len(model.u),
        parameter_error,
    )


_METHODS = {"bayes": _averaged, "map": _most_likely, "nuts": _by_nuts}


def _roughly_fitted(model: GP, seed: int, noise: Noise) -> GP:
    """Return a copy of a model with another noise, at its most likely numbers."""
    copy = model.with_noise(noise)
    copy.set_draws(modes(copy, 0, seed)[:1])
    return copy


def _default_numbers(model: GP) -> tuple[int, int]:
    """Return the number of draws, and over how many of them predictions average."""
    size = bisect_left((_SMALL, _MEDIUM), model.targets().shape[-1])  # up to 40, 100
    drawn = (256, 128, 64) if model.table.shared else (80, 32, 16)
    return drawn[size], (16, 8, 4)[size]


def _sampled(model: GP, number: int, seed: int) -> dict[int, Draws]:
    """Return draws of each nested model; of more than 40 rows of each that is likely enough."""
    is_small = model.targets().shape[-1] <= _SMALL
    if model.table.shared:
        sampled = _around_ridges(model, number, seed)
    elif is_small:
        sampled = {
            k: _from_prior(model, k, number, seed) for k in range(len(model.table.log_prior))
        }
    else:
        sampled = _around_modes(model, number, seed)
    if not any(draws.log_evidence.isfinite().all() for draws in sampled.values()):
        raise PhysicsError(
            "The physics fails by nearly all draws of its parameters. Expected it to hold at those "
            "that the priors allow; narrow these: Unknown(1.0, sd=0.1, bounds=(0.8, 1.2))."
        )
    with_choice = model.table.with_choice
    return {k: draws._replace(u=with_choice(draws.u, k)) for k, draws in sampled.items()}


def _from_prior(model: GP, choice: int, number: int, seed: int, repeats: int = 1) -> Draws:
    """Return draws of a nested model that begin with its prior, ``repeats`` times each."""
    density, like = partial(model.log_likelihood, choice=choice), model.u.detach()[0]
    size = GROUPS * max(1, number // (GROUPS * repeats))
    draws = sample(density, like, size, seed, first=_FIRST_OF_PRIOR * repeats)
    repeated = [_evenly(half, number // GROUPS) for half in draws.u.chunk(GROUPS)]
    return draws._replace(u=torch.cat(repeated))


def _around_modes(model: GP, number: int, seed: int) -> dict[int, Draws]:
    """Return draws of each likely nested model that begin with Laplace's approximation."""
    like, with_moves = model.u.detach()[0], model.targets().shape[-1] <= _MEDIUM
    sampled = {}
    for k, start in _starts(model, seed).items():
        density = partial(model.log_likelihood, choice=k)
        sampled[k] = sample(density, like, number, seed, start, _FIRST, with_moves)
    return sampled


def _around_ridges(model: GP, number: int, seed: int) -> dict[int, Draws]:
    """Return the same in coordinates in which ridges are straight.

    What draws from the prior reach beyond is added, if some of a quarter of them do: of few rows,
    and of more where a term varies, such as delta, which may take a parameter's place.
    """
    like, n = model.u.detach()[0], model.targets().shape[-1]
    starts = _starts(model, seed)
    varies = any(term.varies for term in model.terms)
    choices = [*starts] if varies and n <= _MEDIUM else []
    if n <= _SMALL:
        choices = [*range(len(model.table.log_prior))]
    sampled = {}
    for k in choices:
        draws = _from_prior(model, k, number, seed, _FEWER)
        if draws.log_evidence.isfinite().all():  # not if f_p fails by nearly all of the prior
            sampled[k] = draws
    for k, start in starts.items():
        straight = Straight(model, start, k, k not in sampled)
        others = sampled.get(k)
        if others is not None:
            if straight.misses(others.u).any():
                others = _from_prior(model, k, number, seed)
            missed = straight.misses(others.u)
        points = straight.points(_FIRST * number, seed)
        start, guide = straight.start, straight.linear
        draws = sample(straight, like, number, seed, start, _FIRST, n <= _SHARED, points, guide)
        sampled[k] = draws._replace(u=straight.coordinates(draws.u))
        if others is not None:
            sampled[k] = _joined(sampled[k], others, missed)
    return sampled


def _joined(draws: Draws, others: Draws, is_missed: Tensor) -> Draws:
    """Return draws of a part of the posterior of one problem, and others that it misses, ``N``.

    Each group of both has a share by its evidence.
    """
    parts, evidence = [], []
    groups = (draws.u.chunk(GROUPS), others.u.chunk(GROUPS), is_missed.chunk(GROUPS))
    for g, (u, v, missed) in enumerate(zip(*groups, strict=True)):
        # The evidence beyond the part is that of the others times the share of the missed.
        beyond = others.log_evidence[g] + missed.to(u).mean().log()
        logs = torch.cat([draws.log_evidence[g], beyond])
        counts = _counts(logs.softmax(0), len(u))
        parts += [_evenly(u, counts[0]), _evenly(v[missed], counts[1])]
        evidence.append(logs.logsumexp(0, keepdim=True))
    return Draws(torch.cat(parts), torch.stack(evidence))


def _evenly(u: Tensor, number: int) -> Tensor:
    """Return a number of rows, evenly from all."""
    rows = (torch.arange(number) + 0.5) * len(u) / max(number, 1)
    return u[rows.long()]


def _starts(model: GP, seed: int) -> dict[int, Normal]:
    """Return Laplace's approximation of each nested model that is likely enough.

    Modes are sought by some of the rows first, then from there by four times as many, up to all.
    A nested model that is unlikely by some of them is left out: that its odds recover has a
    probability of the odds at most (Ville's inequality).
    """
    ends: dict[int, Tensor] = {}
    is_precise = bool(model.table.shared)  # parameters of a physics may have many exact digits
    likely = [*range(len(model.table.log_prior))]
    for part in _parts(model, seed):
        starts = {}
        for k in likely:
            ends[k] = modes(part, k, seed, is_precise, ends.get(k))
            density = partial(part.log_likelihood, choice=k)
            starts[k] = around_mode(density, ends[k][0], is_precise)
        weights = _weights(model, {k: log.unsqueeze(0) for k, (_, log) in starts.items()})
        likely = [k for k in starts if bool((weights[k] > _SELDOM).any())]
    return {k: starts[k][0] for k in likely}


def _parts(model: GP, seed: int) -> list[GP]:
    """Return models of 40 rows, 160 and so on, if the noise can have fewer, and of all rows."""
    n, size = len(model.data.Y), _SMALL
    parts = []
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    while 2 * size < n:
        parts.append(model.subset_rows(order[:size].sort().values))
        size *= 4
    return [*filter(None, parts), model]


def modes(
    model: GP, choice: int, seed: int, is_precise: bool = False, before: Tensor | None = None
) -> Tensor:
    """Return the most likely end of some searches, or two that are nearly as likely, ``2 x B x P``.

    Searches begin at ``before``, the ends of those by fewer rows; without these with likely draws
    from the prior, its medians, and a fit of parameters by least squares. Those of a point fit by
    up to 200 rows begin with all of these, and up to 40 rows with draws from the posterior, which
    also find narrow modes.
    """
    density, like = partial(model.log_likelihood, choice=choice), model.u.detach()[0]
    n, shared = model.targets().shape[-1], len(model.table.shared)
    is_thorough = n <= _SHARED and is_precise and not shared
    if before is not None and not is_thorough:
        return _sorted(model, choice, maximise(density, before, is_precise))
    number = max(16, 6400 // max(len(model.data.Y), 25))
    generator = torch.Generator().manual_seed(seed)
    u = standard_normal((number, *like.shape), generator, like)
    searches = _SEARCHES // 2 if choice else _SEARCHES
    others = before
    if others is None:
        others = u[:0]
    if is_thorough and n <= _SMALL:
        draws = sample(density, like, _BEFORE_SEARCH, seed, first=_FIRST_OF_SEARCH)
        others = _sorted(model, choice, draws.u)[: _SEARCHES // 2]
    likely = _sorted(model, choice, u)[: searches - 1 - len(others)]
    begins = torch.cat([others, likely, torch.zeros_like(u[:1])])
    if shared:
        begins[-2] = _with_least_squares(model, choice, u)
    most = _STEPS_OF_SHARED if is_precise and shared else _STEPS
    ends = maximise(density, begins, is_precise, most)
    return _rivals(model, choice, _sorted(model, choice, ends))


def _rivals(model: GP, choice: int, ends: Tensor) -> Tensor:
    """Return the first of sorted ends ``N x B x P`` of searches, or two, as :func:`modes` does."""
    log_density = _log_density(model, choice, ends)
    is_near = (ends - ends[0]).abs().amax(-1) < _NEAR
    rival, second = log_density.masked_fill(is_near, -math.inf).max(0)
    if not (rival > log_density[0] - _LESS_LIKELY).any():
        return ends[:1]
    return torch.stack([ends[0], ends[second, torch.arange(len(second), device=second.device)]])


def _with_least_squares(model: GP, choice: int, u: Tensor) -> Tensor:
    """Return coordinates ``B x P`` with the best parameters, by draws ``N x B x P`` of a prior."""
    p = len(model.table.shared)
    targets = model.targets().nan_to_num().flatten()
    others = torch.zeros_like(u[:1, :, :-p])

    def misfit(z: Tensor) -> Tensor:
        u_of_z = torch.cat([others.expand(len(z), -1, -1), z.to(u).unsqueeze(1)], -1)
        return (model.prior_mean(model.table.with_choice(u_of_z, choice)) - targets).cpu()

    z = least_squares_fit(misfit, u[:, 0, -p:].cpu()).to(u)
    return torch.cat([others[0], z.unsqueeze(0)], -1)


def _sorted(model: GP, choice: int, u: Tensor) -> Tensor:
    """Return coordinates ``N x B x P`` of a nested model, the most likely ones first."""
    order = _log_density(model, choice, u).argsort(0, descending=True)
    return model.table.with_choice(u.gather(0, order.unsqueeze(-1).expand_as(u)), choice)


def _log_density(model: GP, choice: int, u: Tensor) -> Tensor:
    """Return the log posterior density of a nested model but for a constant, ``N x B``."""
    # log p(y | u) - |u|^2 / 2
    density = model.log_likelihood(u, False, choice=choice)[0] - 0.5 * u.square().sum(-1)
    return density.nan_to_num(nan=-math.inf)


def _weights(model: GP, log_evidence: dict[int, Tensor]) -> Tensor:
    """Return posterior probabilities ``K x G x B`` by log evidences ``G x B``."""
    prior = model.table.log_prior
    like = next(iter(log_evidence.values()))
    logs = like.new_full((len(prior), *like.shape), -math.inf)
    # p(k | y) is proportional to p(k) Z_k.
    for k, value in log_evidence.items():
        logs[k] = prior[k] + value
    return logs.softmax(0)


def _evidence(model: GP, sampled: dict[int, Draws]) -> Tensor:
    """Return the log evidence of each problem, in the user's units."""
    prior = model.table.log_prior
    logs = torch.stack([prior[k] + draws.log_evidence for k, draws in sampled.items()])
    total = logs.logsumexp(0).logsumexp(0) - math.log(GROUPS)
    units = model.log_jacobian()
    if len(total) == 1:
        units = units.sum()
    return total + units


def _pooled(
    draws: dict[int, Draws], weights: Tensor, number: int, group: slice = slice(None)
) -> Tensor:
    """Return ``number x B x P`` draws of nested models, all or a group, by weights ``K x B``."""
    problems = []
    for b in range(weights.shape[-1]):
        counts = enumerate(_counts(weights[:, b], number))
        parts = [_evenly(draws[k].u[group, b], count) for k, count in counts if count]
        problems.append(torch.cat(parts))
    return torch.stack(problems, 1)


def _counts(shares: Tensor, number: int) -> list[int]:
    """Return whole numbers in proportion to shares, of a given sum, by largest remainders."""
    exact = shares * number
    counts = exact.floor()
    order = (counts - exact).argsort()
    counts[order[: number - int(counts.sum())]] += 1
    return [int(count) for count in counts]


def _error(model: GP, groups: list[Tensor]) -> float:
    """Return the change of the mean by another seed, in predicted standard deviations.

    Both groups of draws predict the left-out targets.
    """
    means, variances = zip(*(model.left_out_at(u) for u in groups), strict=True)
    sd = (torch.cat(variances).mean(0) + torch.cat(means).var(0, correction=0)).sqrt()
    # The difference of means of N / 2 draws has twice the standard deviation of a mean of N.
    difference = (means[0].mean(0) - means[1].mean(0)) / 2
    return float((difference / sd).square().nanmean().sqrt())


def _parameter_error(model: GP, groups: list[Tensor]) -> float:
    """Return the largest change of the mean of a parameter by another seed, in posterior sd."""
    one, other = (model.physics_parameters_at(u).mean for u in groups)
    error = (one - other).abs() / (2 * model.physics_parameters_at(torch.cat(groups)).sd)
    return float(error.nan_to_num().max())  # 0 / 0 where all draws are the same
