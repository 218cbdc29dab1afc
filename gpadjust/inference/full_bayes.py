"""Full Bayes: sampling a model's hyper-parameters."""

from __future__ import annotations

import math
import warnings
from copy import deepcopy
from dataclasses import dataclass, field

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor
from tqdm import tqdm

from gpadjust.inference.hmc import Draws, Potential, hmc
from gpadjust.inference.map_fit import NOWHERE, Search, optima
from gpadjust.inference.objective import Objective
from gpadjust.inference.priors import register_priors
from gpadjust.models import ExactGPBase
from gpadjust.models.hyperparameters import constraint_of

_CHAINS = 16  # they share a batch
_STEP = 0.1  # of differences, in logarithms
_WIDEST = 4.0  # standard deviation of Laplace's approximation, in logarithms
_CANDIDATES = 8  # of a chain's start
_MOST_WEIGHT = 0.1  # of one of them
_ITERATIONS = (8, 40)  # the least and the most by default
_COST = 4000  # observations times iterations
_MOST_R_HAT = 1.5  # what counts is the mixture of all chains, not any one of them


class SamplingWarning(UserWarning):
    """The chains have not mixed."""


@dataclass(frozen=True)
class SampleResult:
    """What sampling the hyper-parameters has reached.

    Attributes:
        r_hat: The split R-hat of the log density along the chains, of each output, ``batch_shape x
            (m)``; near 1 for chains that are equally likely (Gelman et al. 2013, sec. 11.4), and
            coarse for few iterations.
        effective_sample_size: The smallest one of the hyper-parameters, of the same shape.
        acceptance: Mean acceptance rate of the proposals, of the same shape.
        draws: All draws of each hyper-parameter, ``iterations x chains x`` its shape, by its name;
            of a centre that is learnt, in standard deviations of f_p from its mean.
    """

    r_hat: Tensor
    effective_sample_size: Tensor
    acceptance: Tensor
    draws: dict[str, Tensor] = field(repr=False)


def sample(
    model: BatchedMultiOutputGPyTorchModel,
    search: Search,
    num_samples: int = 16,
    num_iterations: int | None = None,
    progress: bool = False,
) -> SampleResult:
    """Sample the hyper-parameters of a model and put the samples into it, see :func:`fit`.

    The chains start around the optima that the search finds; its seed is that of both. The first
    half of their iterations is thrown away.
    """
    if not isinstance(model, ExactGPBase):
        raise TypeError(
            f"Sampling needs a model of gpadjust, got {type(model).__name__}; ZeroMeanGP is the "
            "plain Gaussian process."
        )
    model.check_can_hold_samples()
    target = deepcopy(model)
    register_priors(target)
    objective = Objective(target, marginal=True, of_logs=True, vague_trend=True)
    parameters = objective.parameters
    if not parameters.is_batched:
        raise ValueError(
            "Sampling needs hyper-parameters of each output's own: this model shares some, or its "
            "physics learns. Freeze the physics' parameters with `requires_grad_(False)`."
        )
    generator = torch.Generator().manual_seed(search.seed)
    centres, values = optima(objective, search)
    best = values.argmin(0), torch.arange(parameters.num_problems)
    root = laplace_root(objective, centres[best])
    start = _starts(objective, centres, values, root, _CHAINS, generator)
    if num_iterations is None:
        least, most = _ITERATIONS
        num_iterations = max(least, min(most, _COST // objective.num_points))
    num_warmup = num_iterations // 2
    num_kept = max(num_iterations - num_warmup, -(-num_samples // _CHAINS))
    with tqdm(total=num_warmup + num_kept, disable=not progress, unit="iteration") as bar:
        draws = hmc(
            potential_of(objective),
            start,
            num_warmup,
            num_kept,
            generator,
            bar.update,
            centres[best],
            root,
        )
    result = _diagnose(objective, draws)
    # From all chains, and from all along them.
    rows = torch.linspace(num_kept - 1, 0, num_samples).round().long().flip(0)
    vectors = draws.positions[rows, torch.arange(num_samples) % _CHAINS]
    model.hold_samples(parameters.to_raw(parameters.unflatten(vectors)))
    if not (result.r_hat <= _MOST_R_HAT).all():
        _warn(result)
    return result


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


def _starts(
    objective: Objective,
    centres: Tensor,
    values: Tensor,
    root: Tensor,
    num_chains: int,
    generator: torch.Generator,
) -> Tensor:
    """Starts of chains, drawn from Gaussians around the optima by importance resampling.

    Args:
        objective: What is sampled.
        centres: Optima, ``k x B x p``.
        values: The objective there, ``k x B``.
        root: Of the Gaussians' covariance, ``B x p x p``.
        num_chains: The number ``C`` of starts.
        generator: Source of randomness.

    Returns:
        ``C x B x p``.
    """
    problems, p = centres.shape[1:]
    number = _CANDIDATES * num_chains
    values = values.to(centres)
    share = (values.amin(0) - values).exp().mT  # B x k
    which = torch.multinomial(share.cpu(), number, replacement=True, generator=generator).mT
    which = which.to(centres.device)
    white = torch.randn(number, problems, p, generator=generator, dtype=root.dtype).to(root)
    middle = centres.gather(0, which.unsqueeze(-1).expand(-1, -1, p))
    drawn = middle + (root @ white.unsqueeze(-1)).squeeze(-1)
    drawn[0] = centres.gather(0, values.argmin(0)[None, :, None].expand(1, -1, p))[0]
    bound = objective.parameters.is_constrained
    drawn = objective.parameters.clipped(drawn).where(bound, drawn)
    value = objective(drawn).where(objective.parameters.is_allowed(drawn), math.inf)
    away = drawn.unsqueeze(1) - centres
    square = torch.linalg.solve(root, away.unsqueeze(-1)).squeeze(-1).square().sum(-1)
    log_q = (share.log().mT - 0.5 * square).logsumexp(1)
    weight = (-value - log_q).softmax(0).clamp_max(_MOST_WEIGHT)
    weight = weight.masked_fill(value.isinf(), 0.0)
    if not (weight.sum(0) > 0).all():
        raise RuntimeError(NOWHERE)
    enough = bool(((weight > 0).sum(0) >= num_chains).all())
    chosen = torch.multinomial(
        weight.mT.cpu(), num_chains, replacement=not enough, generator=generator
    )
    chosen = chosen.mT.unsqueeze(-1).to(drawn.device)
    return drawn.gather(0, chosen.expand(-1, -1, p))


def potential_of(objective: Objective) -> Potential:
    """The objective, infinite beyond the user's constraints and below the least noise."""

    def potential(vectors: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = objective.value_and_gradient(vectors)
        allowed = objective.parameters.is_allowed(vectors)
        gradient = gradient.where(allowed.unsqueeze(-1), torch.zeros_like(gradient))
        return value.where(allowed, torch.full_like(value, math.inf)), gradient

    return potential


def _diagnose(objective: Objective, found: Draws) -> SampleResult:
    positions, parameters = found.positions, objective.parameters
    moving = positions[..., positions.std((0, 1)).amin(0) > 0]
    size = found.values.new_ones(positions.shape[2])
    if moving.shape[-1]:
        size = effective_sample_size(moving, chain_dim=1, sample_dim=0).amin(-1)
    r_hat = split_gelman_rubin(found.values, chain_dim=1, sample_dim=0)
    shape = parameters.batch_shape
    raw = parameters.to_raw(parameters.unflatten(positions.flatten(0, 1)))
    draws = {}
    for name, values in raw.items():
        constraint = constraint_of(objective.model, name)
        values = values if constraint is None else constraint.transform(values)
        draws[name.replace("raw_", "")] = values.unflatten(0, positions.shape[:2])
    return SampleResult(
        r_hat.reshape(shape), size.reshape(shape), found.acceptance.reshape(shape), draws
    )


def _warn(result: SampleResult) -> None:
    bad = ~(result.r_hat <= _MOST_R_HAT)
    warnings.warn(
        f"The chains of {int(bad.sum())} of {bad.numel()} outputs have not mixed: R-hat of the log "
        f"density is {result.r_hat.max():.2f} (below {_MOST_R_HAT} is good). The mixture may give "
        "its modes wrong weights. Raise num_iterations, or give narrower priors, that of the noise "
        "above all.",
        SamplingWarning,
        stacklevel=4,
    )
