"""Full Bayes: sampling a model's hyper-parameters."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from botorch.exceptions.warnings import OptimizationWarning
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor
from tqdm import tqdm

from gpadjust.inference.hmc import Potential, hmc
from gpadjust.inference.objective import Objective
from gpadjust.inference.priors import register_priors
from gpadjust.inference.search_space import SearchSpace
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.parameter_scales import constraint_of

Sampler = Literal["hmc", "nuts"]

_CHAINS = 16  # of "hmc"; they share a batch
_NUTS_CHAINS = 2
_SPREAD = 0.3  # standard deviation of the chains' starts around the optimum, in logarithms
_INFINITE = 1e8
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
        acceptance: Mean acceptance rate of the proposals, of the same shape; NaN for ``"nuts"``.
        draws: All draws of each hyper-parameter, ``iterations x chains x`` its shape, by its name.
    """

    r_hat: Tensor
    effective_sample_size: Tensor
    acceptance: Tensor
    draws: dict[str, Tensor] = field(repr=False)


def sample(
    model: MultiOutputGP,
    method: Sampler,
    maximise: Callable[[Objective], Any],
    num_samples: int,
    num_warmup: int,
    seed: int,
    progress: bool,
) -> SampleResult:
    """Sample the hyper-parameters of a model and put the samples into it, see :func:`fit`.

    Args:
        model: The model.
        method: The sampler.
        maximise: Brings a model to the maximum of an objective, where the chains start.
        num_samples: Number of samples that the model is to hold.
        num_warmup: Number of iterations that adapt the sampler.
        seed: Seed of the sampler.
        progress: Whether to show a progress bar.
    """
    if not isinstance(model, MultiOutputGP):
        raise TypeError(
            f"Sampling needs a model of gpadjust, got {type(model).__name__}; ZeroMeanGP is the "
            "plain Gaussian process."
        )
    model.check_can_hold_samples()
    target = deepcopy(model)
    register_priors(target)
    objective = Objective(target, marginal=True, of_settings=True)
    if not objective.is_batched:
        raise ValueError(
            "Sampling needs hyper-parameters of each output's own: this model shares some, or its "
            "physics learns. Freeze the physics' parameters with `requires_grad_(False)`."
        )
    with warnings.catch_warnings():
        # The optimum is only where the chains start.
        warnings.simplefilter("ignore", OptimizationWarning)
        maximise(objective)
    draw = _hmc if method == "hmc" else _nuts
    positions, acceptance = draw(objective, num_samples, num_warmup, seed, progress)
    result = _diagnose(objective, positions, acceptance)
    length, chains = positions.shape[:2]
    index = torch.linspace(length * chains - 1, 0, num_samples).round().long().flip(0)
    chosen = positions.reshape(-1, *positions.shape[2:])[index]
    scale = objective.scale
    model.hold_samples(scale.to_raw(objective.unflatten(chosen)))
    _warn(result, num_samples)
    return result


def potential_of(objective: Objective, space: SearchSpace) -> Potential:
    """The objective, infinite beyond constraints and where rounding errors would decide."""

    def potential(settings: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = objective.value_and_gradient(settings)
        sound = space.is_sound(settings)
        gradient = gradient.where(sound.unsqueeze(-1), torch.zeros_like(gradient))
        return value.where(sound, torch.full_like(value, math.inf)), gradient

    return potential


def _hmc(
    objective: Objective, num_samples: int, num_warmup: int, seed: int, progress: bool
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    optimum = objective.current()
    shape = (_CHAINS, *optimum.shape[1:])
    noise = torch.randn(shape, generator=generator, dtype=optimum.dtype).to(optimum)
    space = SearchSpace(objective)
    start = space.within(optimum + _SPREAD * noise)
    num_iterations = max(40, -(-4 * num_samples // _CHAINS))
    with tqdm(total=num_warmup + num_iterations, disable=not progress, unit="iteration") as bar:
        return hmc(
            potential_of(objective, space),
            start,
            num_warmup,
            num_iterations,
            generator,
            lambda: bar.update() and None,
        )


def _nuts(
    objective: Objective, num_samples: int, num_warmup: int, seed: int, progress: bool
) -> tuple[Tensor, Tensor]:
    space = SearchSpace(objective)
    potential = potential_of(objective, space)

    class Energy(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, settings: Tensor) -> Tensor:
            value, gradient = potential(settings.unsqueeze(0))
            ctx.save_for_backward(gradient.squeeze(0))
            return value.nan_to_num(posinf=_INFINITE).sum()  # Pyro takes no infinite energies

        @staticmethod
        def backward(ctx: Any, outer: Tensor) -> Tensor:
            (gradient,) = ctx.saved_tensors
            return outer * gradient

    chains = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(_NUTS_CHAINS):
            optimum = objective.current()
            start = space.within(optimum + _SPREAD * torch.randn_like(optimum))[0]
            kernel = NUTS(potential_fn=lambda parameters: Energy.apply(parameters["settings"]))
            mcmc = MCMC(
                kernel,
                num_samples=max(num_samples, 4),
                warmup_steps=num_warmup,
                initial_params={"settings": start},
                disable_progbar=not progress,
            )
            mcmc.run()
            chains.append(mcmc.get_samples()["settings"])
    positions = torch.stack(chains, dim=1)
    return positions, torch.full_like(positions[0, 0, :, 0], torch.nan)


def _diagnose(objective: Objective, positions: Tensor, acceptance: Tensor) -> SampleResult:
    flat = positions[:, :, :, _learnt(positions)]
    r_hat = split_gelman_rubin(flat, chain_dim=1, sample_dim=0).amax(-1)
    size = effective_sample_size(flat, chain_dim=1, sample_dim=0).amin(-1)
    shape = objective.batch_shape
    length, chains = positions.shape[:2]
    raw = objective.scale.to_raw(objective.unflatten(positions.flatten(0, 1)))
    draws = {}
    for name, values in raw.items():
        constraint = constraint_of(objective.model, name)
        values = values if constraint is None else constraint.transform(values)
        draws[name.replace("raw_", "")] = values.unflatten(0, (length, chains))
    return SampleResult(r_hat.reshape(shape), size.reshape(shape), acceptance.reshape(shape), draws)


def _learnt(positions: Tensor) -> Tensor:
    """Which parameters move at all."""
    return positions.std((0, 1)).amin(0) > 0


def _warn(result: SampleResult, num_samples: int) -> None:
    bad = (result.r_hat > _MOST_R_HAT) | (
        result.effective_sample_size < _LEAST_EFFECTIVE * num_samples
    )
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
