"""Fitting a model with inducing points."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.utils.inducing_point_allocators import GreedyVarianceReduction
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood
from torch import Size, Tensor

from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.calibrated_fit import calibrate
from gpadjust.inference.collapsed_bound import (
    CollapsedBound,
    Observations,
    noise_of_weight_one,
    observations,
)
from gpadjust.inference.log_parameters import LogParameters
from gpadjust.inference.map_fit import FitResult, Search, centers_at_rest, maximise, optimise
from gpadjust.inference.unexplained import unexplained
from gpadjust.models import VariationalCKA
from gpadjust.models.variational_cka import NOTHING

_REFINED = 20_000  # observations by which hyper-parameters are refined
_ROUNDS = 2  # of inducing points and hyper-parameters by turns
_ITERATIONS = 15  # of L-BFGS in each
_ROUGH = 1e-6  # relative decrease of the bound below which it stops
_CANDIDATES = 4  # for each inducing point
_AT_ONCE = 4096  # predictions


def fit_variational(model: VariationalCKA, search: Search) -> FitResult:
    """Fit a model with inducing points; what an error leaves is the model as it was.

    1. An exact model of some observations is brought to its most likely hyper-parameters, unknown
       parameters of the physics among them, which then stay.
    2. By turns, inducing points are placed where the prior variance that those before them leave is
       largest (Burt et al. 2020), and L-BFGS raises the evidence lower bound of up to 20,000
       observations, at the best distribution of inducing values for each hyper-parameters.
    3. All observations make the distribution, in closed form.
    4. Its residuals are split into noise and what the inducing points cannot show, the ``rest``.
    """
    if model.start is None:
        raise ValueError("Expected a whole model: a subset of a model's outputs is not fitted.")
    before = deepcopy(model.state_dict())
    try:
        with threads_for(model.model.inducing_points.shape[-2], others=True):
            return _fit(model, search)
    except BaseException:
        model.load_state_dict(before)
        raise
    finally:
        model.eval()


def _fit(model: VariationalCKA, search: Search) -> FitResult:
    start = model.start
    searches = search.num_screened != 0
    physics_learns = start.has_unknowns or bool(_learnt_of_physics(model))
    if searches or physics_learns:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizationWarning)  # what follows goes on
            if start.has_unknowns:
                calibrate(start, search)
            else:
                maximise(start, search)
        if physics_learns:
            model.ask_physics()
    data = observations(start, model.train_inputs[0], model.train_targets, _known_noise(model))
    generator = torch.Generator().manual_seed(search.seed)
    order = torch.randperm(len(data.inputs), generator=generator).to(data.inputs.device)
    some = data.rows(order[:_REFINED])
    iterations = min(search.max_iterations, _ITERATIONS)
    converged = torch.ones_like(noise_of_weight_one(start), dtype=torch.bool)
    with centers_at_rest(start), _physics_at_rest(model):
        for _ in range(_ROUNDS if searches else 1):
            model.model.place(_places(model, data, order))
            bound = CollapsedBound(start, some, model.model.inducing_points)
            if not bound.parameters.names:
                break
            reached, _, converged = optimise(
                bound, bound.parameters.clipped(bound.parameters.current()), iterations, _ROUGH
            )
            bound.parameters.assign(reached[0])
        model.model.place(_places(model, data, order))  # where they are best for what was found
        whole = CollapsedBound(start, data, model.model.inducing_points)
        found = whole.optimum()
    start.eval()
    model.model.hold(found.mean, found.root)
    model.evidence = found.bound.detach()
    _split(model, data, search.seed)
    return FitResult(model.evidence, converged.reshape(model.evidence.shape))


@torch.no_grad()
def _places(model: VariationalCKA, data: Observations, order: Tensor) -> Tensor:
    """Inducing points among the observations, ``(m) x M x (d + k)``."""
    kernel, number = model.covar_module, model.model.inducing_points.shape[-2]
    batch: Size = kernel.batch_shape
    each = []
    for j in range(batch.numel()):
        seen = order[data.weight.reshape(-1, len(order))[j, order] > 0]
        candidates = data.inputs[seen[: _CANDIDATES * number]]
        greedy = GreedyVarianceReduction().allocate_inducing_points(
            inputs=candidates,
            covar_module=kernel[j] if batch else kernel,
            num_inducing=min(number, len(candidates)),
            input_batch_shape=Size(),
        )
        # It stops where nothing is left to be explained; others fill up, anywhere.
        more = data.inputs[seen.flip(0)[: number - len(greedy)]]
        each.append(torch.cat([greedy.detach(), more, greedy[: number - len(greedy) - len(more)]]))
    return torch.stack(each).reshape(*batch, number, -1)


@torch.no_grad()
def _split(model: VariationalCKA, data: Observations, seed: int) -> None:
    """Give the model's rest and noise their sizes."""
    strategy, parts = model.strategy(), []
    terms = [*model.covar_module.terms]
    for x in data.inputs.split(_AT_ONCE):
        x = x.expand(*model.covar_module.batch_shape, *x.shape[-2:])
        cross = strategy.cross_covariance(x, [(term, term.weights(x)) for term in terms])
        parts.append((cross @ strategy.mean_cache.unsqueeze(-1)).squeeze(-1))
    residuals = data.residual - torch.cat(parts, dim=-1)
    residuals = residuals.masked_fill(data.weight == 0, torch.nan)
    d, likelihood = model.rest.num_inputs, model.likelihood
    learns_noise = any(parameter.requires_grad for parameter in likelihood.parameters())
    known = None if learns_noise else likelihood.noise.expand_as(residuals)
    with torch.enable_grad():
        found = unexplained(data.inputs[:, :d], residuals, known, seed)
    kernel: Any = model.rest.kernel
    kernel.base_kernel.raw_lengthscale.copy_(found.lengthscales.log())
    none = torch.full_like(found.variance, NOTHING)
    there = found.variance > 0
    kernel.raw_outputscale.copy_(found.variance.log().where(there, none))
    if learns_noise:
        # Without a rest that of the bound stands, which counts what was fitted to the noise.
        noise = found.noise.where(there, likelihood.noise.squeeze(-1)).unsqueeze(-1)
        parameters = LogParameters(model.start)
        values = parameters.unflatten(parameters.current())
        values["likelihood.noise_covar.raw_noise"] = noise.log().unsqueeze(0)
        parameters.assign(parameters.clipped(parameters.flatten(values))[0])
    model.forget()


def _known_noise(model: VariationalCKA) -> Tensor | None:
    likelihood = model.likelihood
    return likelihood.noise if isinstance(likelihood, FixedNoiseGaussianLikelihood) else None


def _learnt_of_physics(model: VariationalCKA) -> list[torch.nn.Parameter]:
    return [p for p in model.input_transform.parameters() if p.requires_grad]


@contextmanager
def _physics_at_rest(model: VariationalCKA) -> Iterator[None]:
    """Let the parameters of a physics that learns rest, where some observations brought them."""
    learnt = _learnt_of_physics(model)
    for parameter in learnt:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learnt:
            parameter.requires_grad_(True)
