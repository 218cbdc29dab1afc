"""Full Bayes: sampling a model's hyper-parameters."""

from __future__ import annotations

import math
import warnings
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.inference import annealing
from gpadjust.inference.annealing import Particles, Proposal
from gpadjust.inference.calibrate import Calibrated, calibrate_roughly, warn_of_parameters
from gpadjust.inference.optimise import MANY, NOWHERE, Search, maximise
from gpadjust.inference.parameter_draws import draw_parameters
from gpadjust.inference.priors import LogPriors, register_priors
from gpadjust.inference.proposals import Both, Normal, around_optima
from gpadjust.inference.relevance import (
    ADJUSTED,
    ALONE,
    WITHOUT,
    alone,
    held,
    mixed,
    probabilities,
    without_physics,
)
from gpadjust.inference.representative import LeftOut, disagreement, left_out, representative
from gpadjust.inference.targets import LogPosterior
from gpadjust.inference.vectors import Parameters
from gpadjust.models import TermsGP, TermsModel
from gpadjust.models.parameters import shared_parameters

_DRAWS = (128, 1024)  # the least and the most by default
_COST = 5_120_000  # draws times observations squared
_COST_OF_PARTICLES = 2500  # particles times observations
_LEAST_PARTICLES = 16  # of as many draws as by default, in proportion
_MOST_PARTICLES = 128
_GRADIENTS = 100  # of each particle, at most
_STARTS = (8, 128)  # of the search, and how many are screened for them
_STARTS_OF_RIVAL = (4, 64)  # the same of the model without its physics
_LEAST_WEIGHED = 3  # observations of an output, for the physics to be weighed by them
_DECISIVE = 5.0  # difference of log evidences that needs no closer look
_SAMPLES = {40: 16, 100: 8, math.inf: 4}  # that a model holds, of up to so many observations
_SAMPLED_ALONE = 2_000_000  # samples times observations squared, of a physics without a GP
_SAMPLES_OF_PARAMETERS = 16  # at least, where a physics has unknown ones
_RETURNED = 1024  # draws of parameters of a physics, at least
_HELD_ALONE = 256  # samples of a physics without a GP, at most
_LEAST_POWER = 0.3  # of the way to the posterior, for draws that show it
_LEAST_SIZE_OF_PARAMETERS = 64.0
_HINT = "Raise num_draws, or give narrower priors, that of the noise above all."
_UNSEEN = 0.05  # of the posterior of parameters, near optima that no search came to
_OFF = 0.3  # predicted standard deviations between what halves of the draws predict, of their mean


class SamplingWarning(UserWarning):
    """The draws of the hyper-parameters do not show their distribution."""


@dataclass(frozen=True, repr=False)
class SampleResult:
    """Result of sampling the hyper-parameters; it prints as a sentence.

    Attributes:
        effective_size: The equivalent number of independent draws of those that were made, of each
            output, ``batch_shape x (m)``: as many as were, if two halves of them agree. Beside
            unknown parameters of the physics also by the weights of theirs, as they are, or by
            what those remember that moved.
        converged: Whether the draws are of the posterior, of each output, of the same shape;
            there is a :class:`~gpadjust.inference.SamplingWarning` if not, also where left-out
            observations are predicted differently by two halves of the draws. Of more than 150
            observations they are weighted draws around the optima, of the posterior to a power of
            0.3 at least.
        draws: Equally likely draws of each hyper-parameter of the model with its physics, ``k x``
            its shape, by its name: 16 to 256 by default, 1,024 beside unknown parameters of the
            physics, whose own are those of all samples. Of a center that is learnt in standard
            deviations of f_p from its mean.
        relevance: Posterior probability that the physics is of use at all, of each output, of the
            same shape; None of a model that is not weighed without it.
        sufficiency: Posterior probability that the physics, with noise, is all there is, which
            needs no adjustment, of the same shape; None of a model that is not weighed beside it.
        num_samples: How many samples the model holds, and ``seconds`` what the fit took on the
            wall clock; :func:`~gpadjust.fit` says both.

    Example:
        >>> import torch
        >>> from gpadjust import ZeroMeanGP, fit
        >>> X = torch.linspace(0, 1, 6, dtype=torch.float64).unsqueeze(-1)
        >>> fit(ZeroMeanGP(X, X.sin()))  # doctest: +ELLIPSIS
        converged, 16 samples (effective size ...), ... s
    """

    effective_size: Tensor
    converged: Tensor
    draws: dict[str, Tensor]
    relevance: Tensor | None = None
    sufficiency: Tensor | None = None
    num_samples: int | None = None
    seconds: float | None = None

    def to_arviz(self) -> Any:
        """The draws as ArviZ has them: a DataTree with the group ``posterior``, of one chain.

        The draws are equally likely, and not in the order of a chain. An ImportError without
        ArviZ, ``pip install "gpadjust[arviz]"``.
        """
        try:
            from arviz_base import from_dict
        except ImportError as error:
            raise ImportError(
                'to_arviz() needs arviz-base; run `pip install "gpadjust[arviz]"`.'
            ) from error
        draws = {name: each.detach().cpu().numpy()[None] for name, each in self.draws.items()}
        return from_dict({"posterior": draws})

    def __repr__(self) -> str:
        """A sentence; of several outputs with their least effective size."""
        bad, number = int((~self.converged).sum()), self.converged.numel()
        some = f" in {bad} of {number} outputs" if number > 1 else ""
        parts = [f"NOT converged{some}" if bad else "converged"]
        size = f"effective size {self.effective_size.min():.3g}"
        known = self.num_samples is not None
        parts.append(f"{self.num_samples} samples ({size})" if known else size)
        for of, what in (
            (self.relevance, "the physics is of use"),
            (self.sufficiency, "the physics needs no adjustment"),
        ):
            if of is not None:
                shares = ", ".join(f"{share:.2g}" for share in of.flatten().tolist())
                parts.append(f"{what} with probability {shares}")
        if self.seconds is not None:
            parts.append(f"{self.seconds:.1f} s")
        return ", ".join(parts)


class _Draws(NamedTuple):
    """Draws of the hyper-parameters of a model with ``B`` outputs.

    Attributes:
        target: What they are drawn from.
        particles: The draws.
        rough: Log evidences by Laplace's approximation, ``B``.
    """

    target: LogPosterior
    particles: Particles
    rough: Tensor

    def is_good(self) -> Tensor:
        """True if the draws are of the posterior, ``B``."""
        return self.particles.power >= _LEAST_POWER

    def away(self) -> Tensor:
        """The constant between targets and their prior mean, in spreads of the targets, ``B``."""
        parameters, targets = self.target.parameters, self.target.targets
        mean, *_ = self.target.distribution(parameters.unflatten(parameters.current()))
        spread = (targets - targets.nanmean(-1, keepdim=True)).square().nanmean(-1).sqrt()
        return (targets - mean.squeeze(0)).nanmean(-1).abs() / spread

    def log_evidence(self) -> Tensor:
        """The log evidence by all states, ``B``; rough if particles are of a density on the way."""
        return self.particles.log_evidence.where(self.particles.power == 1, self.rough)

    def raw(self, rows: Tensor) -> dict[str, Tensor]:
        """Raw parameters of draws of the numbers ``k x B``, ``k x`` their shape, by name."""
        positions, parameters = self.particles.positions, self.target.parameters
        every = torch.arange(rows.shape[-1], device=rows.device)
        return parameters.to_raw(parameters.unflatten(positions[rows, every]))


def sample(
    model: TermsGP,
    search: Search,
    num_samples: int | None = None,
    num_draws: int | None = None,
) -> SampleResult:
    """Sample a model's hyper-parameters and put the samples into it, see :func:`~gpadjust.fit`.

    The draws begin with the prior and around the optima that the search finds; its seed is that of
    both.
    """
    _check(model)
    n, generator = model.train_targets.shape[-1], torch.Generator().manual_seed(search.seed)
    num_draws = num_draws or _default_num_draws(n)
    if model.has_unknowns:
        return _with_parameters(model, search, num_samples, num_draws, generator)
    copy = deepcopy(model)
    settled = _settle_shared(copy, search)
    can_be_weighed = not settled and _can_be_weighed(model)
    rivals = {WITHOUT: without_physics(copy), ALONE: alone(copy)} if can_be_weighed else {}
    register_priors(copy)
    num_samples = num_samples or default_num_samples(n)
    every = {ADJUSTED: _draw(LogPosterior(copy), search, num_draws, generator)}
    draws = every[ADJUSTED]
    for name, rival in rivals.items():
        if rival is not None:
            register_priors(rival)
            found = (LogPosterior(rival), search, num_draws // 2, generator, draws.log_evidence())
            every[name] = _draw(*found)
    away = draws.away() if WITHOUT in every else 0.0
    shares = probabilities({k: each.log_evidence() for k, each in every.items()}, away)
    best = torch.stack([*shares.values()]).argmax(0)  # what most samples are of is what counts
    size = torch.stack([each.particles.effective_size() for each in every.values()])
    good = torch.stack([each.is_good() for each in every.values()])
    size, is_good = (each.gather(0, best[None])[0] for each in (size, good))
    positions = draws.particles.positions
    middle = positions.mean(0)
    counts = [len(each.particles.positions) for each in every.values()]
    of = torch.repeat_interleave(torch.arange(len(every)), torch.tensor(counts)).to(
        positions.device
    )
    apart = [left_out(each.target, each.particles.positions) for each in every.values()]
    predicted = LeftOut(*(torch.cat(each) for each in zip(*apart, strict=True)))
    parts = held(shares)
    weights = torch.cat([(parts[k] / m).expand(m, -1) for k, m in zip(every, counts, strict=True)])
    own = torch.cat([positions, middle.expand(sum(counts[1:]), *middle.shape)])
    rows = representative(predicted, own, weights, num_samples, of)
    raw = [
        each.raw((rows - sum(counts[:i])).clamp(0, counts[i] - 1))
        for i, each in enumerate(every.values())
    ]
    samples = raw[0]
    if len(every) > 1:
        models = [each.target.model for each in every.values()]
        which = of[rows].reshape(num_samples, *model._aug_batch_shape)
        samples = mixed([*zip(raw, models, strict=True)], which)
    shape = model._aug_batch_shape
    relevance = (1 - shares[WITHOUT]).reshape(shape) if WITHOUT in shares else None
    sufficiency = shares[ALONE].reshape(shape) if ALONE in shares else None
    off = disagreement(predicted, weights, draws.target.targets)
    is_good &= off <= _OFF
    _hold(model, samples, settled)
    named = _named(draws.target.parameters, draws.particles.positions)
    return _result(size, is_good, named, draws.target.parameters, relevance, sufficiency)


class _ParameterDraws(NamedTuple):
    """Draws of a model whose physics has unknown parameters.

    Attributes:
        target: Of the hyper-parameters, with the parameters integrated out.
        vectors: Of the hyper-parameters, ``K x B x q``.
        coordinates: Of the parameters that go with them, ``K x p``.
        size: Effective sample size of the hyper-parameters, ``B``, and ``own`` of the parameters.
        is_good: True if the draws are of the posterior, ``B``.
        log_evidence: ``B``.
        calibrated: The model near its most likely parameters.
    """

    target: LogPosterior
    vectors: Tensor
    coordinates: Tensor
    size: Tensor
    own: Tensor
    is_good: Tensor
    log_evidence: Tensor
    calibrated: Calibrated

    def raw(self, rows: Tensor) -> dict[str, Tensor]:
        """Raw parameters of draws of the numbers ``k``, ``k x`` their shape, by name."""
        parameters = self.target.parameters
        held = parameters.to_raw(parameters.unflatten(self.vectors[rows]))
        return held | {"input_transform.coordinates": self.coordinates[rows]}


def _draw_with_parameters(
    model: TermsGP, search: Search, number: int, num_draws: int, generator: torch.Generator
) -> _ParameterDraws:
    """Draw hyper-parameters and parameters of the physics."""
    calibrated = calibrate_roughly(model, search)
    register_priors(model)
    target = LogPosterior(model, None, calibrated.marginalized)
    parameters = target.parameters
    vectors = parameters.current()  # if all is known but the parameters of the physics
    log_densities = log_evidence = vectors.new_zeros(1)
    size = vectors.new_full((parameters.num_problems,), math.inf)
    is_good = size > 0
    if parameters.names:
        draws = _draw(target, search, num_draws, generator)
        size, is_good = draws.particles.effective_size(), draws.is_good()
        vectors, log_evidence = draws.particles.positions, draws.log_evidence()
        # What is not done of the way to the posterior leaves a part.
        left = (1 - draws.particles.power) * draws.particles.log_ratio
        log_densities = (target.log_likelihood(vectors) - left).sum(-1)
    found = draw_parameters(calibrated, parameters, vectors, log_densities, number, generator)
    vectors, coordinates, own = found
    return _ParameterDraws(
        target, vectors, coordinates, size, own, is_good, log_evidence, calibrated
    )


def _with_parameters(
    model: TermsGP,
    search: Search,
    num_samples: int | None,
    num_draws: int,
    generator: torch.Generator,
) -> SampleResult:
    """Sample a model whose physics has unknown parameters.

    One output is weighed against the physics alone, whose parameters are its own.
    """
    copy, n = deepcopy(model), model.train_targets.shape[-1]
    settled = _settle_shared(copy, search)
    can_be_weighed = not settled and _can_be_weighed(model) and model.num_outputs == 1
    rival = alone(copy) if can_be_weighed else None
    if num_samples is None:
        known = all(term.is_known for term in model.terms)
        least = min(_HELD_ALONE, _SAMPLED_ALONE // n**2) if known else 0
        num_samples = max(default_num_samples(n), _SAMPLES_OF_PARAMETERS, least)
    number = max(_RETURNED, num_samples)
    found = _draw_with_parameters(copy, search, number, num_draws, generator)
    parts, share = [found], found.size.new_zeros(())
    kept = share
    if rival is not None:
        parts.append(_draw_with_parameters(rival, search, number, num_draws, generator))
        names = (ADJUSTED, ALONE)
        shares = probabilities({k: p.log_evidence for k, p in zip(names, parts, strict=True)})
        share, kept = shares[ALONE].squeeze(), held(shares)[ALONE].squeeze()
    main = parts[int(share > 0.5)]  # what most samples are of is what counts
    own = (1 - kept).square() / found.own + kept.square() / parts[-1].own  # of the mean of both
    few, many = bool(own > 1 / _LEAST_SIZE_OF_PARAMETERS), main.calibrated.unseen >= _UNSEEN
    is_good, hint = main.is_good, _HINT
    unknowns = found.calibrated.calibration.unknowns.names
    if few or many:
        is_good = is_good & False
        why = "many values of them explain the observations" if many else "few draws of them count"
        hint = f"It is {', '.join(unknowns)} of the physics: {why}. Give narrower priors, or "
        hint += "observe what tells them apart."

    def drawn(total: int) -> tuple[Tensor, Tensor]:
        """Numbers of draws, spread over all of each part, and the parts."""
        last = int((total * kept).round())
        counts = [total - last, last]
        spread = [torch.linspace(0, number - 1, n, device=kept.device).round() for n in counts]
        of = torch.cat([kept.new_full((n,), i) for i, n in enumerate(counts)])
        return torch.cat(spread).long(), of.long()

    rows, of = drawn(num_samples)
    samples, (every, origin) = found.raw(rows), drawn(number)
    coordinates = found.coordinates[every]
    if rival is not None:
        pairs = [(part.raw(rows), part.target.model) for part in parts]
        samples = mixed(pairs, of.reshape(-1, *[1] * len(model._aug_batch_shape)))
        coordinates = coordinates.where(origin[:, None] == 0, parts[1].coordinates[every])
    named = _named(found.target.parameters, found.vectors)
    named |= model.input_transform.remember(coordinates)
    _hold(model, samples, settled)
    found.calibrated.calibration.direct(model, samples["input_transform.coordinates"])
    told = found.calibrated.information.precision.sum(-3)
    warn_of_parameters(unknowns, told, found.calibrated.near.point)
    size = main.size.minimum(own.reciprocal())
    enough = share.reshape(found.target.parameters.batch_shape) if rival is not None else None
    return _result(size, is_good, named, found.target.parameters, None, enough, hint)


def _hold(model: TermsGP, samples: dict[str, Tensor], settled: dict[str, Tensor]) -> None:
    """Put samples into a model, beside values of what outputs share."""
    if settled:
        model.train()  # its inputs are then transformed again, with what they are at now
    with torch.no_grad():
        for name, value in settled.items():
            model.get_parameter(name).copy_(value)
    model.hold_samples(samples)


def _named(parameters: Parameters, vectors: Tensor) -> dict[str, Tensor]:
    """The parameters themselves of vectors ``k x B x p``, by their names."""
    raw = parameters.to_raw(parameters.unflatten(vectors))
    return {r.name.replace("raw_", ""): r.parameter(raw[r.name]) for r in parameters.rows}


def _result(
    size: Tensor,
    is_good: Tensor,
    draws: dict[str, Tensor],
    parameters: Parameters,
    relevance: Tensor | None = None,
    sufficiency: Tensor | None = None,
    hint: str = _HINT,
) -> SampleResult:
    """The result of a fit, with a warning and a hint if draws do not show the posterior."""
    size, converged = (each.reshape(parameters.batch_shape) for each in (size, is_good))
    if not converged.all():
        warnings.warn(
            f"The draws of {int((~converged).sum())} of {converged.numel()} outputs do not show "
            f"the posterior (effective sample size {size.min():.2g}). {hint}",
            SamplingWarning,
            stacklevel=4,
        )
    return SampleResult(size, converged, draws, relevance, sufficiency)


def _can_be_weighed(model: TermsGP) -> bool:
    """Return whether the number of observations allows to weigh a model without its physics."""
    fewest = int((~model.train_targets.isnan()).sum(-1).min())
    return fewest >= _LEAST_WEIGHED and model.train_targets.shape[-1] <= MANY


def _default_num_draws(num_points: int) -> int:
    """Return the default number of draws that a fit begins with."""
    return max(_DRAWS[0], min(_DRAWS[1], _COST // num_points**2))


def default_num_samples(num_points: int) -> int:
    """Return the default number of samples that a model of so many observations holds."""
    return next(number for most, number in _SAMPLES.items() if num_points <= most)


def _check(model: TermsGP) -> None:
    """Raise the error of a model that cannot be sampled."""
    if isinstance(model, TermsModel) and model.not_sampled:
        raise ValueError(model.not_sampled)
    if not isinstance(model, TermsGP):
        raise TypeError(
            f"Sampling needs a model of gpadjust, got {type(model).__name__}; ZeroMeanGP is the "
            "plain Gaussian process."
        )
    model.check_can_be_sampled()


def _settle_shared(model: TermsGP, search: Search) -> dict[str, Tensor]:
    """Bring what outputs share, such as a physics that learns, to its most likely values.

    It stays there: sampling needs problems that are apart.
    """
    names = shared_parameters(model)
    if names:
        maximise(model, search)
        model.train()
    return {name: model.get_parameter(name).requires_grad_(False).detach() for name in names}


def _draw(
    target: LogPosterior,
    search: Search,
    num_draws: int,
    generator: torch.Generator,
    rival: Tensor | None = None,
) -> _Draws:
    """Draws of the hyper-parameters; an error if the likelihood is nowhere finite.

    Half of the particles begin around the optima, half with the prior, which has modes that no
    search came to. Of a model that is weighed against the log evidence of a ``rival``, the search
    takes fewer starts, and rough draws do where it is far behind.
    """
    n, starts = target.num_points, _STARTS if rival is None else _STARTS_OF_RIVAL
    around, rough = around_optima(target, search, starts)
    proposals: list[Proposal] = [around]
    if n <= MANY:  # of the prior all draws may have no density
        prior = LogPriors(target.model, target.parameters, of_logs=True)
        proposals.insert(0, Both(Normal(*prior.moments()), around))
    is_far = rival is not None and bool((rough < rival - _DECISIVE).all())
    # On the way, what the search has found may show only late.
    enough = rival - _DECISIVE if rival is not None and bool((rough < rival).all()) else None
    most = min(_MOST_PARTICLES, _COST_OF_PARTICLES / n)
    number = max(_LEAST_PARTICLES, 2 * round(0.5 * most * num_draws / _default_num_draws(n)))
    gradients = 0 if is_far or n > MANY else _GRADIENTS * number
    num_draws += num_draws % 2  # halves are by turns
    for proposal in proposals:
        with suppress(FloatingPointError):
            given = (target, proposal, num_draws, number, gradients, generator, enough)
            return _Draws(target, annealing.sample(*given), rough)
    raise RuntimeError(NOWHERE)
