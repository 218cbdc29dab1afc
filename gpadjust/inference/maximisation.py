"""Bringing a model's hyper-parameters to an optimum by multi-start L-BFGS."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from torch import Tensor

from gpadjust.inference.objective import Objective
from gpadjust.inference.search_space import SearchSpace

_TOLERANCE = 1e-8  # relative decrease of the objective below which L-BFGS stops
_RESTARTS = 3  # of runs that ended without convergence
_STUCK = 1e-4  # relative decrease below which a restart has found nothing new
_INFEASIBLE = 1e10  # what the optimiser sees where the likelihood cannot be evaluated


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


def maximise(
    objective: Objective,
    num_starts: int | None,
    num_screened: int | None,
    max_iterations: int,
    seed: int,
) -> FitResult:
    """Bring the model of an objective to its optimum, see :func:`fit`."""
    model = objective.model
    space = SearchSpace(objective)
    if num_screened is None:
        most = 256 if objective.is_batched else 32
        num_screened = max(16, min(most, 25_600 // model.train_targets.shape[-1]))
    if num_starts is None:
        num_starts = 16 if objective.is_batched else 8
    starts = space.to_coordinates(objective.current())
    if num_screened:
        generator = torch.Generator().manual_seed(seed)
        drawn = space.draw(num_screened, generator)
        if not objective.concentrated:
            factor = _in_chunks(objective, objective.best_scale, space.to_settings(drawn))
            drawn = space.rescaled(drawn, factor)
        starts = torch.cat([starts, drawn])
    starts, values = _best(objective, space, starts, num_starts)
    if not values[0].isfinite().all():
        model.eval()
        raise RuntimeError(
            "The marginal likelihood could not be evaluated at any start: the covariance has no "
            "Cholesky factor. Check for repeated inputs with different targets, or fix a larger "
            "noise through train_Yvar."
        )
    reached, values, converged = _optimise(objective, space, starts, max_iterations)
    best = values.argmin(0)
    problems = torch.arange(objective.num_problems)
    objective.assign(space.to_settings(reached)[best, problems])
    model.eval()
    converged = converged[best, problems].reshape(objective.batch_shape)
    if not converged.all():
        warnings.warn(
            f"L-BFGS did not converge for {int((~converged).sum())} of {objective.num_problems} "
            f"outputs within {max_iterations} iterations; the parameters are the best found. "
            "Raise max_iterations or num_starts.",
            OptimizationWarning,
            stacklevel=3,
        )
    log_likelihood = -values[best, problems].reshape(objective.batch_shape)
    return FitResult(log_likelihood, converged)


def _best(
    objective: Objective, space: SearchSpace, starts: Tensor, num_starts: int
) -> tuple[Tensor, Tensor]:
    """The best starts of each problem, best first, and their values."""
    values = _in_chunks(objective, objective, space.to_settings(starts))
    if space.learns_noise and num_starts > 1 and len(starts) > 2:
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
    if num_starts > 1 and not objective.is_batched and not (order == 0).any():
        order[-1] = 0  # the user's guess of the physics' parameters is worth a start of its own
    index = order.unsqueeze(-1).expand(-1, -1, starts.shape[-1])
    return starts.gather(0, index), values.gather(0, order)


def _in_chunks(
    objective: Objective, function: Callable[[Tensor], Tensor], settings: Tensor
) -> Tensor:
    """Evaluate a function of settings without gradients, in chunks that fit in memory."""
    n = objective.model.train_targets.shape[-1]
    chunk = max(1, int(4e6 / (objective.num_problems * n * n)))
    return torch.cat([function(part) for part in settings.split(chunk)])


def _optimise(
    objective: Objective, space: SearchSpace, starts: Tensor, max_iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Run L-BFGS from all starts of all problems; return where it got, values, convergence."""
    num_starts, num_problems, num_parameters = starts.shape
    reached = space.to_unit(starts)

    def function(x: np.ndarray, batch_indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The objective takes whole rows of problems: evaluate those with an active one.
        rows, problems = np.divmod(batch_indices, num_problems)
        reached[rows, problems] = torch.from_numpy(x).to(reached)
        active = np.unique(rows)
        coordinates = space.from_unit(reached[active])
        values, gradient = objective.value_and_gradient(space.to_settings(coordinates))
        gradient = space.pull_back(coordinates, gradient) * space.unit
        position = np.searchsorted(active, rows)
        f = values[position, problems].nan_to_num(posinf=_INFEASIBLE)
        g = gradient[position, problems].nan_to_num()
        return f.cpu().numpy(), g.cpu().numpy()

    def run(start: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, ...]:
        x, f, info = fmin_l_bfgs_b_batched(
            lambda x, batch_indices: function(x, which[batch_indices]),
            start,
            bounds=space.unit_bounds,
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
    unit = torch.from_numpy(x).to(starts).reshape(starts.shape)
    shape = (num_starts, num_problems)
    return (
        space.from_unit(unit),
        torch.from_numpy(f).reshape(shape),
        torch.from_numpy(converged).reshape(shape),
    )
