"""Bringing a model's hyper-parameters to an optimum by multi-start L-BFGS."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from torch import Tensor

from gpadjust.inference.log_parameters import magnitude
from gpadjust.inference.objective import Objective

_TOLERANCE = 1e-8  # relative decrease of the objective below which L-BFGS stops
_RESTARTS = 3  # of runs that ended without convergence
_STUCK = 1e-4  # relative decrease below which a restart has found nothing new
_INFEASIBLE = 1e10  # what the optimiser sees where the likelihood cannot be evaluated
_SEARCHED = 128  # observations that a search is made on; more would tell the same, and take longer
_REFINED = 2  # optima of a search on some rows that are carried over to all of them
_APART = 0.1  # nats by which optima differ at least


class Search(NamedTuple):
    """The options of a search, see :func:`~gpadjust.fit`; None for the default."""

    num_starts: int | None = None
    num_screened: int | None = None
    max_iterations: int = 500
    seed: int = 0


@dataclass(frozen=True)
class FitResult:
    """What a fit reached.

    Attributes:
        log_likelihood: The log marginal likelihood (plus log priors, if the model has any) of
            each output, in the units of the model's targets; ``batch_shape x (m)``. Unknown
            constant means are at their least squares estimates, not integrated out.
        converged: Whether the optimiser converged, for each output, of the same shape.
    """

    log_likelihood: Tensor
    converged: Tensor


def maximise(objective: Objective, search: Search) -> FitResult:
    """Bring the model of an objective to its optimum, see :func:`~gpadjust.fit`.

    With many observations the search is made on some of them, and its best optima are refined on
    all.
    """
    model, parameters = objective.model, objective.parameters
    starts = parameters.current()
    searches = search.num_screened != 0
    if searches and parameters.is_batched and objective.num_points > 1.2 * _SEARCHED:
        part = _part(objective, search.seed)
        starts = torch.cat([starts, _search(part, search)])
        starts = _distinct(objective, starts)
    elif searches:
        starts = _screened(objective, search)
    values = objective(starts)
    if not values.amin(0).isfinite().all():
        model.eval()
        raise RuntimeError(
            "The marginal likelihood could not be evaluated at any start: the covariance has no "
            "Cholesky factor. Check for repeated inputs with different targets, or fix a larger "
            "noise through train_Yvar."
        )
    reached, values, converged = _optimise(objective, starts, search.max_iterations)
    best = values.argmin(0)
    problems = torch.arange(parameters.num_problems)
    objective.assign(reached[best, problems])
    model.eval()
    converged = converged[best, problems].reshape(parameters.batch_shape)
    if not converged.all():
        warnings.warn(
            f"L-BFGS did not converge for {int((~converged).sum())} of {parameters.num_problems} "
            f"outputs within {search.max_iterations} iterations; the parameters are the best "
            "found. Raise max_iterations or num_starts.",
            OptimizationWarning,
            stacklevel=4,
        )
    return FitResult(-values[best, problems].reshape(parameters.batch_shape), converged)


def _part(objective: Objective, seed: int) -> Objective:
    """The objective of some of the observations."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randperm(objective.num_points, generator=generator)[:_SEARCHED].sort().values
    return Objective(objective.model, rows=rows)


def _search(objective: Objective, search: Search) -> Tensor:
    """Optima of an objective, ``k x B x p``, best first."""
    starts = _screened(objective, search)
    reached, values, _ = _optimise(objective, starts, search.max_iterations)
    if objective.concentrated:
        shift = objective.best_scale(reached).log().unsqueeze(-1)
        reached = reached + objective.parameters.variances * shift
    order = values.argsort(dim=0)
    return reached.gather(0, order.unsqueeze(-1).expand_as(reached))


def _distinct(objective: Objective, candidates: Tensor) -> Tensor:
    """The best few of candidates, ``k x B x p``, that are apart from each other."""
    # Candidates come best first, so that the next best is often the same optimum once more.
    values = objective(candidates[: 2 + 3 * _REFINED])
    kept = []
    for problem in range(values.shape[1]):
        chosen: list[int] = []
        for i in values[:, problem].argsort().tolist():
            value = values[i, problem]
            if all(abs(float(value - values[j, problem])) > _APART for j in chosen):
                chosen.append(i)
        chosen = (chosen + [chosen[0]] * _REFINED)[:_REFINED]
        kept.append(candidates[chosen, problem])
    return torch.stack(kept, dim=1)


def _screened(objective: Objective, search: Search) -> Tensor:
    """The best of random vectors and the model's own, ``num_starts x B x p``, best first."""
    parameters = objective.parameters
    num_screened, num_starts = search.num_screened, search.num_starts
    if num_screened is None:
        most = 256 if parameters.is_batched else 32
        num_screened = max(16, min(most, 25_600 // objective.num_points))
    if num_starts is None:
        num_starts = 16 if parameters.is_batched else 8
    generator = torch.Generator().manual_seed(search.seed)
    drawn = parameters.draw(num_screened, generator)
    factor = objective.best_scale(drawn)
    usable = factor.isfinite() & (factor > 0)
    shift = factor.where(usable, torch.ones_like(factor)).log().unsqueeze(-1)
    drawn = parameters.clipped(drawn + parameters.variances * shift)
    starts = torch.cat([parameters.current(), drawn])
    values = objective(starts)
    if parameters.noise.any() and num_starts > 1 and len(starts) > 2:
        # Optima with and without noise are apart, and without it a random start looks bad.
        clean = torch.zeros(len(starts), 1, dtype=torch.bool, device=starts.device)
        clean[1 : 1 + len(starts) // 2] = True
        worst = torch.full_like(values, math.inf)
        parts = [
            values.where(stratum, worst).argsort(dim=0)[:number]
            for stratum, number in (
                (~clean, num_starts - num_starts // 2),
                (clean, num_starts // 2),
            )
        ]
        order = torch.cat(parts)
        order = order.gather(0, values.gather(0, order).argsort(dim=0))
    else:
        order = values.argsort(dim=0)[:num_starts]
    if num_starts > 1 and not parameters.is_batched and not (order == 0).any():
        order[-1] = 0  # the user's guess of the physics' parameters is worth a start of its own
    return starts.gather(0, order.unsqueeze(-1).expand(-1, -1, starts.shape[-1]))


def _optimise(
    objective: Objective, starts: Tensor, max_iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Run L-BFGS from all starts of all problems; return where it got, values, convergence.

    The optimiser has one box for all problems: it sees vectors in shares of their bounds.
    """
    num_starts, num_problems, num_parameters = starts.shape
    parameters = objective.parameters
    width = parameters.upper - parameters.lower
    bounded = width.isfinite() & (width > 0)
    zero = torch.where(bounded, parameters.lower, torch.zeros_like(width))
    unit = torch.where(bounded, width, magnitude(parameters.current()[0]))
    low = ((parameters.lower - zero) / unit).amin(0).tolist()
    high = ((parameters.upper - zero) / unit).amax(0).tolist()
    reached = (starts - zero) / unit

    def function(x: np.ndarray, batch_indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The objective takes whole rows of problems: evaluate those with an active one.
        rows, problems = np.divmod(batch_indices, num_problems)
        reached[rows, problems] = torch.from_numpy(x).to(reached)
        active = np.unique(rows)
        values, gradient = objective.value_and_gradient(zero + reached[active] * unit)
        position = np.searchsorted(active, rows)
        f = values[position, problems].nan_to_num(posinf=_INFEASIBLE)
        g = (gradient * unit)[position, problems].nan_to_num()
        return f.cpu().numpy(), g.cpu().numpy()

    def run(start: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, ...]:
        x, f, info = fmin_l_bfgs_b_batched(
            lambda x, batch_indices: function(x, which[batch_indices]),
            start,
            bounds=list(zip(low, high, strict=True)),
            maxiter=max_iterations,
            factr=_TOLERANCE / np.finfo(float).eps,
            pass_batch_indices=True,
        )
        flags = np.array([each["status"] for each in info])
        return x, np.asarray(f, dtype=np.float64), flags == 0, flags == 1

    flat = reached.reshape(-1, num_parameters).cpu().numpy()
    x, f, converged, spent = run(flat, np.arange(len(flat)))
    best = f.reshape(num_starts, num_problems).argmin(0) * num_problems + np.arange(num_problems)
    for _ in range(_RESTARTS):
        stuck = best[~converged[best] & ~spent[best]]
        if not stuck.size:
            break
        # The line search may have failed in rounding errors at the optimum: another run tells.
        again, value, success, spent[stuck] = run(x[stuck], stuck)
        converged[stuck] = success | (f[stuck] - value < _STUCK * np.maximum(1, np.abs(value)))
        better = value < f[stuck]
        x[stuck[better]], f[stuck[better]] = again[better], value[better]
    shape = (num_starts, num_problems)
    return (
        zero + torch.from_numpy(x).to(starts).reshape(starts.shape) * unit,
        torch.from_numpy(f).reshape(shape),
        torch.from_numpy(converged).reshape(shape),
    )
