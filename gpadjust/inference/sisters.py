"""Fitting a model with what others taught as its prior, as far as its own data agree."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from gpytorch.priors import LogNormalPrior
from torch import Tensor

from gpadjust.gp import AppendedPhysics, Term, Unit
from gpadjust.gp.kernels import Stationary
from gpadjust.gp.sister import Sister
from gpadjust.inference import bayes
from gpadjust.inference.optimise import FitResult, Search
from gpadjust.inference.priors import register_priors
from gpadjust.inference.representative import left_out, representative
from gpadjust.inference.targets import LogPosterior
from gpadjust.models import RRA, TermsGP
from gpadjust.models.hyperparameter_samples import adjusts, uses_physics
from gpadjust.models.parameters import Hyperparameter, hyperparameters

_HELPS = 0.1  # prior probability that other machines help: they must show it
_ODDS = math.log(_HELPS / (1 - _HELPS))
_MOST = 64  # points at which their functions are known
_WIDER = {"lengthscale": 0.7, "noise": 1.0}  # spread of logarithms between machines
# Variance in that of the term of others, of a difference and of a machine that is none of them:
_DIFFERENCE, _ALONE = (0.1, 3.0), (1.0, 1.5)  # median, and spread of the logarithm
_ON = "covar_module.sister.on"


class _Proper(LogPosterior):
    """A posterior in which trends cost what they do, for an evidence beside that of others."""

    vague_trends = False


def fit_with_prior(
    model: TermsGP,
    prior: Any,
    run: Callable[..., FitResult | bayes.SampleResult],
    search: Search,
    **own: Any,
) -> FitResult | bayes.SampleResult:
    """Fit a model beside others, see :func:`~gpadjust.fit`."""
    others = checked_prior(model, prior)
    plain, taught = deepcopy(model), deepcopy(model)
    result = run(plain, search, **own)
    model.covar_module.sister = None
    taught.covar_module.sister = sister_of(model, others)
    if isinstance(result, FitResult):
        found: Any = run(taught, search, **own)
        share = (found.log_likelihood + _ODDS > result.log_likelihood).to(model.train_targets)
        samples = _values(taught)
    else:
        share, samples = _sampled(taught, others, search, **own)
    held = _values(plain)
    (number,) = {len(values) for values in held.values()}
    kept = (number * share).round()
    if kept.any():
        model.covar_module.sister = taught.covar_module.sister
        ends = torch.arange(number + 1).reshape(-1, *[1] * share.dim()) * kept / number
        is_on = ends.floor().diff(dim=0) > 0  # spread evenly, as others are in an order
        held = {name: _where(is_on, samples[name], values) for name, values in held.items()}
        held[_ON] = is_on.unsqueeze(-1).to(model.train_targets)
    if plain.num_samples is not None:
        model.hold_samples(held)
    else:
        named = dict(model.named_parameters())
        with torch.no_grad():
            for name, values in held.items():
                named[name].copy_(values[0])
    if isinstance(result, FitResult):
        chosen = torch.where(share > 0, found.log_likelihood, result.log_likelihood)
        return replace(result, log_likelihood=chosen, sisters=share)
    return replace(result, sisters=share)


def _where(is_on: Tensor, ours: Tensor, others: Tensor) -> Tensor:
    return torch.where(is_on.reshape(*is_on.shape, *[1] * (ours.dim() - is_on.dim())), ours, others)


def _values(model: TermsGP) -> dict[str, Tensor]:
    """The raw parameters of each sample, ``S x`` their shape; of one without samples, 1 of each."""
    own = ("covar_module.", "likelihood.")
    every = {name: p.detach() for name, p in model.named_parameters() if name.startswith(own)}
    named = {name: values for name, values in every.items() if name != _ON}
    return named if model.num_samples is not None else {n: p[None] for n, p in named.items()}


def _sampled(
    model: TermsGP, others: Sequence[TermsGP], search: Search, **own: Any
) -> tuple[Tensor, dict[str, Tensor]]:
    """Posterior probability that others help, ``(m)``, and samples of a model if they do."""
    n, generator = model.train_targets.shape[-1], torch.Generator().manual_seed(search.seed)
    num_draws = own.get("num_draws") or bayes._default_num_draws(n)
    number = own.get("num_samples") or bayes.default_num_samples(n)
    alone = deepcopy(model)
    alone.covar_module.sister = None
    _register_priors(alone, others, _ALONE)
    without = bayes._draw(_Proper(alone), search, num_draws // 2, generator)
    _register_priors(model, others, _DIFFERENCE)
    target = LogPosterior(model)
    draws = bayes._draw(target, search, num_draws, generator)
    positions = draws.particles.positions
    odds = draws.log_evidence() - without.log_evidence() + _ODDS
    weights = torch.full_like(positions[..., 0], 1 / len(positions))
    rows = representative(left_out(target, positions), positions, weights, number)
    raw = draws.raw(rows)
    fixed = {
        name: values.expand(number, *values.shape[1:]) for name, values in _values(model).items()
    }
    return odds.sigmoid().reshape(model._aug_batch_shape), fixed | raw


@torch.no_grad()
def _register_priors(
    model: TermsGP, others: Sequence[TermsGP], variance: tuple[float, float]
) -> None:
    """Register priors by what others have, with a variance of functions in units of theirs."""
    rows = {row.name: row for row in hyperparameters(model) if row.is_log and row.raw.requires_grad}
    for name, row in rows.items():
        logs = [_logs(other, name, model) for other in others]
        means = torch.stack([each.mean(0) for each in logs])
        middle = means.mean(0)
        spread = means.std(0) if len(others) > 1 else torch.zeros_like(middle)
        inner = torch.stack([each.var(0, correction=int(len(each) > 1)) for each in logs]).mean(0)
        if row.kind in _WIDER:
            sd = (inner + spread.square() + _WIDER[row.kind] ** 2).sqrt()
        else:
            middle = middle + math.log(variance[0])
            sd = (inner + spread.square() + variance[1] ** 2).sqrt()
        _register(row, middle, sd)
    register_priors(model)


def _register(row: Hyperparameter, location: Tensor, sd: Tensor) -> None:
    owner, name = row.owner, row.leaf.removeprefix("raw_")
    read, write = getattr(owner, f"_{name}_param"), getattr(owner, f"_{name}_closure")
    prior = LogNormalPrior(location.expand_as(row.raw).clone(), sd.expand_as(row.raw).clone())
    owner.register_prior(f"{name}_prior", prior, read, write)


def _logs(other: TermsGP, name: str, model: TermsGP) -> Tensor:
    """Logarithms of another's hyper-parameter in the model's units, ``S x`` its shape."""
    row = next(row for row in hyperparameters(other) if row.name == name)
    raw = row.raw.detach()
    value = row.parameter(raw if other.num_samples is not None else raw[None])
    if other.num_samples is not None:
        value = _of_physics(other, value)
    if row.kind in ("outputscale", "noise"):
        ratio = (_scale(other) / _scale(model)).square()
        ratio = ratio.reshape((*ratio.shape, *[1] * (value.dim() - 1 - ratio.dim())))
        value = value * ratio
    return value.log()


def _scale(model: TermsGP, unit: Unit = Unit.TARGET) -> Tensor:
    """The scale of a unit in the user's, ``(m)``, the same for all samples."""
    scale = model.units(unit)[1].squeeze(-1)
    return scale[0] if scale.dim() > (model.num_outputs > 1) else scale


def _of_physics(model: TermsGP, values: Tensor) -> Tensor:
    """Values of samples, ``S x ...``; those without physics or functions have the others' mean."""
    used = uses_physics(model) & adjusts(model)
    used = used.reshape(*used.shape, *[1] * (values.dim() - used.dim())).to(values)
    used = torch.where(used.sum(0) > 0, used, adjusts(model).reshape(used.shape).to(used))
    middle = ((values.log() * used).sum(0) / used.sum(0)).exp()
    return torch.where(used > 0, values, middle)


class _Joint(NamedTuple):
    """Moments of the terms of a machine at points, in the user's units."""

    mean: Tensor  # (m) x T M
    covariance: Tensor


@torch.no_grad()
def sister_of(model: TermsGP, others: Sequence[TermsGP]) -> Sister:
    """What others taught of the terms of a model; of several with the spread between them."""
    points = torch.cat([data for other in others if (data := other.data()["train_X"]) is not None])
    points = _spread_out(points, _MOST)
    terms = [i for i, term in enumerate(model.terms) if term.kernel is not None]
    each = [_joint(other, terms, points) for other in others]
    mean = torch.stack([joint.mean for joint in each]).mean(0)
    covariance = torch.stack([joint.covariance for joint in each]).mean(0)
    if len(each) > 1:
        away = torch.stack([joint.mean - mean for joint in each], dim=-1)
        between = away @ away.mT / (len(each) - 1)
        covariance = covariance / len(each) + between * (1 + 1 / len(each))
    values, vectors = torch.linalg.eigh(covariance)
    root = vectors * values.clamp_min(0).sqrt().unsqueeze(-2)
    given = [
        [model.term_mean(model.terms[i].name, j) for i in terms] for j in range(model.num_outputs)
    ]
    own = mean.new_tensor(given).repeat_interleave(len(points), -1)
    mean = mean - own.reshape(mean.shape)
    lead = model._aug_batch_shape
    forms = [_form(others, i) for i in terms]
    length, size = (torch.stack(parts, dim=-1) for parts in zip(*forms, strict=True))
    return Sister(
        points=points.expand(*lead, *points.shape).clone(),
        lengthscale=length.mT.contiguous(),
        variance=size,
        mean=mean,
        root=root,
        scale=model.units()[1].expand(*lead, 1).clone(),
    )


def _form(others: Sequence[TermsGP], i: int) -> tuple[Tensor, Tensor]:
    """Middle lengthscales, ``(m) x d``, and variance in the user's units, ``(m)``, of a term."""
    lengths, sizes = [], []
    for other in others:
        term: Term = other.terms[i]
        form: Any = term.form
        d, scale = term.num_inputs, _scale(other, term.unit)
        length, size = form.lengthscale.squeeze(-2), form.scale * scale.square()
        length = length.expand(*length.shape[:-1], d)
        if other.num_samples is not None:
            length, size = _of_physics(other, length), _of_physics(other, size)
            length, size = length.log().mean(0).exp(), size.log().mean(0).exp()
        lengths.append(length.log())
        sizes.append(size.log())
    return torch.stack(lengths).mean(0).exp(), torch.stack(sizes).mean(0).exp()


def _joint(model: TermsGP, terms: Sequence[int], points: Tensor) -> _Joint:
    """Joint moments of the terms at points, of a mixture those of the whole."""
    inputs = model.model_inputs(points, with_basis=False)
    x, size = torch.cat([inputs] * len(terms), dim=-2), len(points)
    weights: dict[str, Tensor] = {}
    shifts = []
    for block, i in enumerate(terms):
        term = model.terms[i]
        found, (shift, scale) = model._at(term, inputs), model.units(term.unit)
        rows = torch.zeros(len(terms) * size).to(x)
        rows[block * size : (block + 1) * size] = 1
        for part, weight in found.parts:
            own = rows * scale if weight is None else rows * weight * scale
            weights[part.name] = weights.get(part.name, 0.0) + own
        shifts.append(rows * (found.shift * scale + shift))
    sought = model.covar_module.weighted(
        x, [(t, weights[t.name]) for t in model.terms if t.name in weights], sum(shifts)
    )
    mean, covariance = model.conditioning().joint(sought)
    if model.num_samples is not None:
        away = mean - mean.mean(0)
        covariance = covariance.mean(0) + (away.unsqueeze(-1) * away.unsqueeze(-2)).mean(0)
        mean = mean.mean(0)
    return _Joint(mean, covariance)


def _spread_out(points: Tensor, number: int) -> Tensor:
    """At most so many distinct points, far apart in units of the spread of each column."""
    spread = points.std(-2)
    scaled = points / spread.where(spread > 0, torch.ones_like(spread))
    chosen = [0]
    distance = (scaled - scaled[0]).square().sum(-1)
    while len(chosen) < min(number, len(points)) and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = distance.minimum((scaled - scaled[chosen[-1]]).square().sum(-1))
    return points[chosen]


def checked_prior(model: TermsGP, prior: Any) -> list[TermsGP]:
    """The other models; an error if they cannot teach this one."""
    others = [*prior] if isinstance(prior, list | tuple) else [prior]
    if not isinstance(model, TermsGP):
        raise TypeError(f"A {type(model).__name__} takes no prior of other models; a CKA does.")
    if not others:
        raise ValueError("Expected prior as a fitted model or several, got none.")
    _check_terms(model, "The model")
    for other in others:
        if type(other) is not type(model):
            raise TypeError(
                f"Expected prior as a fitted {type(model).__name__}, as the model itself, got "
                f"{type(other).__name__}."
            )
        if not other.is_fitted:
            raise ValueError("Expected prior as a fitted model: call fit(other) first.")
        for what in ("input_names", "output_names", "term_names"):
            ours, theirs = getattr(model, what), getattr(other, what)
            if ours != theirs:
                raise ValueError(
                    f"Expected prior with the {what.replace('_', ' ')} {', '.join(ours)}, as the "
                    f"model, got {', '.join(theirs)}."
                )
        _check_terms(other, "The model that is its prior")
    return others


def _check_terms(model: TermsGP, which: str) -> None:
    why = ""
    if isinstance(model, RRA):
        why = "is an RRA, whose random features cannot show another's functions: take a CKA"
    elif model.batch_shape and model.num_samples is None:
        why = "is of a batch of data sets"
    elif model.has_unknowns:
        why = (
            "has a physics with unknown parameters: give these priors by hand, Unknown(mean, "
            "sd=...), from `other.physics_parameters`"
        )
    elif model.rho_names and any(p.requires_grad for p in model.physics.parameters()):
        why = "has a physics that is trained: train it first, and stop its gradients"
    elif any(term.scaled_by for term in model.terms):
        why = "has a physics that is emulated: take its emulator as exact, FunctionPhysics(physics)"
    elif any(term.learns_mean for term in model.terms):
        why = "has unknown prior means: give them as numbers (rho_mean=1.0)"
    elif getattr(getattr(model, "input_transform", None), "base", None) is not None:
        why = "has an input_transform, so that lengthscales differ in their units: leave it out"
    elif not model.terms or any(
        t.kernel is not None and not isinstance(t.form, Stationary) for t in model.terms
    ):
        why = "has kernels that are neither RBF nor Matern"
    elif not any(t.kernel is not None for t in model.terms) or not all(
        t.basis is None or isinstance(t.basis, AppendedPhysics) for t in model.terms
    ):
        why = "has no functions rho and delta of the inputs alone"
    if why:
        raise ValueError(f"Cannot fit with a prior: {which[0].lower()}{which[1:]} {why}.")
