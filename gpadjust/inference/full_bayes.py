"""Full Bayes: sampling a model's hyper-parameters."""

from __future__ import annotations

import math
import warnings
from copy import deepcopy
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gpadjust.inference.calibrated_fit import (
    calibrate_roughly,
    draw_parameters,
    warn_of_parameters,
)
from gpadjust.inference.importance_sampling import Draws, Mixture
from gpadjust.inference.importance_sampling import sample as importance_sample
from gpadjust.inference.log_parameters import shared_parameters
from gpadjust.inference.map_fit import NOWHERE, Search, maximise, optima
from gpadjust.inference.objective import Objective
from gpadjust.inference.priors import register_priors
from gpadjust.models import ExactGPBase
from gpadjust.models.hyperparameters import constraint_of

_STEP = 0.1  # of differences, in logarithms
_WIDEST = 4.0  # standard deviation of Laplace's approximation, in logarithms
_DRAWS = (128, 1024)  # the least and the most by default
_COST = 5_120_000  # draws times observations squared
_SAMPLES = {40: 16, 100: 8, math.inf: 4}  # that a model holds, of up to so many observations
_SAMPLED_ALONE = 2_000_000  # samples times observations squared, of a physics without a GP
_SAMPLES_OF_PARAMETERS = 16  # at least, where a physics has unknown ones
_RETURNED = 256  # draws, at least
LEAST_POWER = 0.05  # of the weights, for draws that show the posterior


class SamplingWarning(UserWarning):
    """The draws of the hyper-parameters do not show their distribution."""


@dataclass(frozen=True)
class SampleResult:
    """What sampling the hyper-parameters has reached.

    Attributes:
        power: What the weights of importance sampling were raised to for enough draws to count, of
            each output, ``batch_shape x (m)``: 1 where they show the distribution as it is; near 0
            they are those of the approximation that they were drawn from.
        draws: Equally likely draws of each hyper-parameter, ``k x`` its shape, by its name: 256, or
            as many as the model holds, which are some of them. Of a centre that is learnt they are
            in standard deviations of f_p from its mean.
    """

    power: Tensor
    draws: dict[str, Tensor] = field(repr=False)


def sample(
    model: ExactGPBase,
    search: Search,
    num_samples: int | None = None,
    num_draws: int | None = None,
) -> SampleResult:
    """Sample a model's hyper-parameters and put the samples into it, see :func:`~gpadjust.fit`.

    The draws begin around the optima that the search finds; its seed is that of both.
    """
    model.check_can_be_sampled()
    target = deepcopy(model)
    settled = _settle_shared(target, search)
    calibrated = calibrate_roughly(target, search) if target.has_unknowns else None
    register_priors(target)
    shared = None if calibrated is None else calibrated.shared
    # A trend is what parameters explain, if there are any.
    is_vague = calibrated is None
    objective = Objective(target, marginal=True, of_logs=True, vague_trend=is_vague, shared=shared)
    n, parameters = objective.num_points, objective.parameters
    if num_draws is None:
        num_draws = max(_DRAWS[0], min(_DRAWS[1], _COST // n**2))
    if num_samples is None:
        num_samples = default_num_samples(n)
        if calibrated is not None:
            alone = all(term.is_known for term in model.terms)
            least = min(_RETURNED, _SAMPLED_ALONE // n**2) if alone else 0
            num_samples = max(num_samples, _SAMPLES_OF_PARAMETERS, least)
    generator = torch.Generator().manual_seed(search.seed)
    number = max(_RETURNED, num_samples)
    if parameters.names:
        draws = _draw(objective, search, num_draws, generator)
        vectors, power = draws.resampled(number, generator), draws.power
    else:  # all is known but the parameters of the physics
        vectors = parameters.current().expand(number, -1, -1)
        power = torch.ones(parameters.num_problems, dtype=torch.float64)
    if calibrated is not None:
        vectors, coordinates, lowest = draw_parameters(calibrated, parameters, vectors, generator)
        power = power.minimum(lowest)
    rows = torch.linspace(0, len(vectors) - 1, num_samples).round().long()
    if settled:
        model.train()  # its inputs are then transformed again, with what they are at now
    with torch.no_grad():
        for name, value in settled.items():
            model.get_parameter(name).copy_(value)
    held = parameters.to_raw(parameters.unflatten(vectors[rows]))
    named = _named(objective, vectors)
    if calibrated is not None:
        held["input_transform.coordinates"] = coordinates[rows]
        named |= model.input_transform.remember(coordinates)
    model.hold_samples(held)
    if calibrated is not None:
        calibrated.calibration.direct(model, coordinates[rows])
    result = SampleResult(power.reshape(parameters.batch_shape), named)
    if (result.power < LEAST_POWER).any():
        _warn(result)
    if calibrated is not None:
        warn_of_parameters(calibrated)
    return result


def default_num_samples(num_points: int) -> int:
    """How many samples a model of so many observations holds, if that is not said."""
    return next(number for most, number in _SAMPLES.items() if num_points <= most)


def _settle_shared(model: ExactGPBase, search: Search) -> dict[str, Tensor]:
    """Bring what outputs share, such as a physics that learns, to its most likely values.

    It stays there, as sampling needs problems that are apart.
    """
    names = shared_parameters(model)
    if not names:
        return {}
    maximise(model, search)
    model.train()
    return {name: model.get_parameter(name).requires_grad_(False).detach() for name in names}


def _draw(
    objective: Objective, search: Search, num_draws: int, generator: torch.Generator
) -> Draws:
    """Draws of the hyper-parameters; an error if the likelihood is nowhere finite."""
    centres, values = optima(objective, search)
    values, order = values.to(centres).sort(dim=0)
    centres = centres.gather(0, order.unsqueeze(-1).expand_as(centres))
    share = (-values).softmax(0)
    proposal = Mixture(centres, share, laplace_root(objective, centres[0]))
    parameters = objective.parameters

    def potential(vectors: Tensor) -> Tensor:
        value = objective(vectors)
        return value.where(parameters.is_allowed(vectors), torch.full_like(value, math.inf))

    try:
        return importance_sample(potential, proposal, num_draws, generator)
    except FloatingPointError:
        raise RuntimeError(NOWHERE) from None


def laplace_root(objective: Objective, optimum: Tensor) -> Tensor:
    """A root of the covariance of Laplace's approximation at an optimum ``B x p``.

    Lower triangular, ``B x p x p``.
    """
    p = optimum.shape[-1]
    step = _STEP * torch.eye(p).to(optimum).unsqueeze(1)
    _, gradient = objective.value_and_gradient(torch.cat([optimum + step, optimum - step]))
    hessian = (gradient[:p] - gradient[p:]).transpose(0, 1) / (2 * _STEP)
    values, vectors = torch.linalg.eigh(0.5 * (hessian + hessian.mT))
    root = vectors * values.clamp_min(_WIDEST**-2).rsqrt().unsqueeze(-2)
    return torch.linalg.qr(root.mT).R.mT


def _named(objective: Objective, vectors: Tensor) -> dict[str, Tensor]:
    """Draws ``k x B x p`` of the parameters as GPyTorch has them, by name."""
    parameters, named = objective.parameters, {}
    for name, raw in parameters.to_raw(parameters.unflatten(vectors)).items():
        constraint = constraint_of(objective.model, name)
        named[name.replace("raw_", "")] = raw if constraint is None else constraint.transform(raw)
    return named


def _warn(result: SampleResult) -> None:
    low = result.power < LEAST_POWER
    warnings.warn(
        f"The draws of {int(low.sum())} of {low.numel()} outputs are of the approximation that "
        "they begin with rather than of the posterior (weights to the power of "
        f"{result.power.min():.2g}). Raise num_draws, or give narrower priors, that of the noise "
        "above all.",
        SamplingWarning,
        stacklevel=4,
    )
