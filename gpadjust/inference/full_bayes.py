"""Full Bayes: sampling a model's hyper-parameters."""

from __future__ import annotations

import math
import warnings
from copy import deepcopy
from dataclasses import dataclass, field

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor
from tqdm import tqdm

from gpadjust.inference.hmc import Potential, hmc
from gpadjust.inference.map_fit import Search, maximise
from gpadjust.inference.objective import Objective
from gpadjust.inference.priors import register_priors
from gpadjust.models import ExactGPBase
from gpadjust.models.hyperparameters import constraint_of

_CHAINS = 16  # they share a batch
_SPREAD = 0.3  # standard deviation of the chains' starts around the optimum, in logarithms
_MOST_R_HAT = 1.2  # what counts is the mixture of all chains, not any one of them
_LEAST_EFFECTIVE = 0.5  # of the samples that the model is to hold


class SamplingWarning(UserWarning):
    """The chains have not mixed."""


@dataclass(frozen=True)
class SampleResult:
    """What sampling the hyper-parameters has reached.

    Attributes:
        r_hat: The largest split R-hat of the hyper-parameters of each output, ``batch_shape x
            (m)``; near 1 for chains that have mixed (Gelman et al. 2013, sec. 11.4).
        effective_sample_size: The smallest one of the hyper-parameters, of the same shape.
        acceptance: Mean acceptance rate of the proposals, of the same shape.
        draws: All draws of each hyper-parameter, ``iterations x chains x`` its shape, by its name.
    """

    r_hat: Tensor
    effective_sample_size: Tensor
    acceptance: Tensor
    draws: dict[str, Tensor] = field(repr=False)


def sample(
    model: BatchedMultiOutputGPyTorchModel,
    search: Search,
    num_samples: int = 64,
    num_warmup: int = 40,
    progress: bool = False,
) -> SampleResult:
    """Sample the hyper-parameters of a model and put the samples into it, see :func:`fit`.

    The chains start around the optimum that the search finds; its seed is that of both.
    """
    if not isinstance(model, ExactGPBase):
        raise TypeError(
            f"Sampling needs a model of gpadjust, got {type(model).__name__}; ZeroMeanGP is the "
            "plain Gaussian process."
        )
    model.check_can_hold_samples()
    target = deepcopy(model)
    register_priors(target)
    objective = Objective(target, marginal=True, of_logs=True)
    parameters = objective.parameters
    if not parameters.is_batched:
        raise ValueError(
            "Sampling needs hyper-parameters of each output's own: this model shares some, or its "
            "physics learns. Freeze the physics' parameters with `requires_grad_(False)`."
        )
    with warnings.catch_warnings():
        # The optimum is only where the chains start.
        warnings.simplefilter("ignore", OptimizationWarning)
        maximise(objective, search)
    generator = torch.Generator().manual_seed(search.seed)
    optimum = parameters.current().expand(_CHAINS, -1, -1)
    noise = torch.randn(optimum.shape, generator=generator, dtype=optimum.dtype).to(optimum)
    start = parameters.clipped(optimum + _SPREAD * noise)
    num_iterations = max(40, -(-4 * num_samples // _CHAINS))
    with tqdm(total=num_warmup + num_iterations, disable=not progress, unit="iteration") as bar:
        positions, acceptance = hmc(
            potential_of(objective), start, num_warmup, num_iterations, generator, bar.update
        )
    result = _diagnose(objective, positions, acceptance)
    draws = positions.flatten(0, 1)
    index = torch.linspace(len(draws) - 1, 0, num_samples).round().long().flip(0)
    model.hold_samples(parameters.to_raw(parameters.unflatten(draws[index])))
    _warn(result, num_samples)
    return result


def potential_of(objective: Objective) -> Potential:
    """The objective, infinite beyond the user's constraints and below the least noise."""

    def potential(vectors: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = objective.value_and_gradient(vectors)
        allowed = objective.parameters.is_allowed(vectors)
        gradient = gradient.where(allowed.unsqueeze(-1), torch.zeros_like(gradient))
        return value.where(allowed, torch.full_like(value, math.inf)), gradient

    return potential


def _diagnose(objective: Objective, positions: Tensor, acceptance: Tensor) -> SampleResult:
    moving = positions[..., positions.std((0, 1)).amin(0) > 0]
    r_hat = split_gelman_rubin(moving, chain_dim=1, sample_dim=0).amax(-1)
    size = effective_sample_size(moving, chain_dim=1, sample_dim=0).amin(-1)
    parameters, shape = objective.parameters, objective.parameters.batch_shape
    raw = parameters.to_raw(parameters.unflatten(positions.flatten(0, 1)))
    draws = {}
    for name, values in raw.items():
        constraint = constraint_of(objective.model, name)
        values = values if constraint is None else constraint.transform(values)
        draws[name.replace("raw_", "")] = values.unflatten(0, positions.shape[:2])
    return SampleResult(r_hat.reshape(shape), size.reshape(shape), acceptance.reshape(shape), draws)


def _warn(result: SampleResult, num_samples: int) -> None:
    few = result.effective_sample_size < _LEAST_EFFECTIVE * num_samples
    bad = few | (result.r_hat > _MOST_R_HAT)
    if bad.any():
        warnings.warn(
            f"The chains of {int(bad.sum())} of {bad.numel()} outputs have not mixed: R-hat "
            f"{result.r_hat.max():.3f} (below {_MOST_R_HAT} is good), effective sample size "
            f"{result.effective_sample_size.min():.0f} (expected at least half of {num_samples}). "
            "The mixture may give its modes wrong weights. Narrower priors help most, that of the "
            "noise above all; then more warm-up and samples.",
            SamplingWarning,
            stacklevel=4,
        )
