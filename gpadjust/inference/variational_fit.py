"""Fitting a model with inducing points."""

from __future__ import annotations

import warnings
from copy import deepcopy
from typing import Any

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.utils.inducing_point_allocators import GreedyVarianceReduction
from torch import Size, Tensor

from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.calibrate import calibrate
from gpadjust.inference.collapsed_bound import CollapsedBound, Observations
from gpadjust.inference.optimise import FitResult, Search, centers_at_rest, maximise, optimise
from gpadjust.inference.unexplained import unexplained
from gpadjust.inference.vectors import Parameters
from gpadjust.models import TermsGP, VariationalCKA
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
    before = deepcopy(model.state_dict())
    try:
        with threads_for(model.inducing_points.shape[-2]):
            return _fit(model, search)
    except BaseException:
        model.load_state_dict(before)
        raise
    finally:
        model.eval()


def _fit(model: VariationalCKA, search: Search) -> FitResult:
    searches = search.num_screened != 0
    learns_physics = any(p.requires_grad for p in model.input_transform.parameters())
    learns_physics = learns_physics or model.has_unknowns
    if searches or learns_physics:
        some = model.exact(learns_physics)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizationWarning)  # what follows goes on
            if model.has_unknowns:
                calibrate(some, search)
            else:
                maximise(some, search)
    if learns_physics:
        model.ask_physics()
    exact, data = model.exact(), Observations.of(model)
    generator = torch.Generator().manual_seed(search.seed)
    order = torch.randperm(len(data.inputs), generator=generator).to(data.inputs.device)
    iterations = min(search.max_iterations, _ITERATIONS)
    converged = torch.ones_like(model.evidence, dtype=torch.bool)
    with centers_at_rest(exact):
        # All may be known but parameters of the physics, which rest where they were brought.
        learns = not model.has_unknowns or any(p.requires_grad for p in exact.parameters())
        for _ in range((_ROUNDS if searches else 1) * learns):
            bound = CollapsedBound(exact, data.rows(order[:_REFINED]), _places(model, data, order))
            start = bound.parameters.clipped(bound.parameters.current())
            reached, _, converged = optimise(bound, start, iterations, _ROUGH)
            bound.parameters.assign(reached[0])
        points = _places(model, data, order)  # where they are best for what was found
        model.evidence, mean, root = CollapsedBound(exact, data, points).optimum()
    model.inducing_points, model.inducing_mean, model.inducing_root = points, mean, root
    model.eval()
    _split(model, exact, data, search.seed)
    return FitResult(model.evidence, converged.reshape(model.evidence.shape))


@torch.no_grad()
def _places(model: VariationalCKA, data: Observations, order: Tensor) -> Tensor:
    """Inducing points among the observations, ``(m) x M x (d + k)``."""
    kernel, number = model.covar_module, model.inducing_points.shape[-2]
    batch, each = kernel.batch_shape, []
    for j in range(batch.numel()):
        seen = order[data.weight.reshape(-1, len(order))[j, order] > 0]
        candidates = data.inputs[seen[: _CANDIDATES * number]]
        greedy = GreedyVarianceReduction().allocate_inducing_points(
            inputs=candidates,
            covar_module=kernel[j],
            num_inducing=min(number, len(candidates)),
            input_batch_shape=Size(),
        )
        # It stops where nothing is left to be explained; others fill up, anywhere.
        more = data.inputs[seen.flip(0)[: number - len(greedy)]]
        each.append(torch.cat([greedy.detach(), more, greedy[: number - len(greedy) - len(more)]]))
    return torch.stack(each).reshape(*batch, number, -1)


@torch.no_grad()
def _split(model: VariationalCKA, exact: TermsGP, data: Observations, seed: int) -> None:
    """Give the model's rest and noise their sizes."""
    known, sums = model.conditioning(), map(model.covar_module.at, data.inputs.split(_AT_ONCE))
    residuals = model.train_targets - torch.cat([known.mean(f) for f in sums], dim=-1)
    learns_noise = any(parameter.requires_grad for parameter in model.likelihood.parameters())
    noise = model.noise.at(data.inputs).expand_as(residuals)
    inputs = data.inputs[:, : model.rest.num_inputs]
    found = unexplained(inputs, residuals, None if learns_noise else noise, seed)
    kernel: Any = model.rest.kernel
    kernel.base_kernel.raw_lengthscale.copy_(found.lengthscales.log())
    kernel.raw_outputscale.copy_(found.variance.log().clamp_min(NOTHING))
    # Without a rest the noise of the bound stands, which counts what was fitted to the noise.
    log_noise = found.noise.where(found.variance > 0, noise[..., 0]).unsqueeze(-1).log()
    for row in Parameters(exact).rows if learns_noise else ():
        if row.kind == "noise":
            row.raw.copy_(row.to_raw(log_noise.clamp(*row.limits())))
    model.forget()
