"""Fitting a model's hyper-parameters by multi-start maximum likelihood."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models import ModelListGP
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from torch import Tensor

from gpadjust.inference.objective import Objective
from gpadjust.inference.search_space import SearchSpace

_TOLERANCE = 1e-8  # relative decrease of the objective below which L-BFGS stops
_SMALL_GRADIENT = 1e-2  # in unit coordinates, relative to the objective
_INFEASIBLE = 1e10  # what the optimiser sees where the likelihood cannot be evaluated


@dataclass(frozen=True)
class FitResult:
    """What a fit reached.

    Attributes:
        log_likelihood: The log marginal likelihood (plus log priors, if the model has any) of
            each output, in the units of the model's targets; ``batch_shape x (m)``.
        converged: Whether the optimiser converged, for each output, of the same shape.
    """

    log_likelihood: Tensor
    converged: Tensor


def fit(
    model: BatchedMultiOutputGPyTorchModel | ModelListGP,
    *,
    num_starts: int = 8,
    num_screened: int | None = None,
    max_iterations: int = 500,
    seed: int = 0,
) -> FitResult | list[FitResult]:
    """Fit a model's hyper-parameters by maximum marginal likelihood, in place.

    Random starts, each with the best overall scale of its variances, are screened in one batch
    beside the model's current parameters; L-BFGS then runs from the best of them, for all outputs
    in lockstep. Starts and bounds follow the data's scales,
    so that units of inputs, targets and physics make no difference. The result is never less
    likely than the parameters that the model came with. Priors registered on the model are
    honoured (maximum a posteriori); parameters with ``requires_grad=False`` stay.

    Args:
        model: Any model of this library, any BoTorch model with batched outputs such as
            ``SingleTaskGP``, or a ``ModelListGP`` of them.
        num_starts: Number of starts that L-BFGS is run from, for each output.
        num_screened: Number of random starts that are screened; 0 fits from the current
            parameters alone (a warm start). Default: 128, fewer for more than 100 points; 32 if
            the physics learns, which is evaluated at one setting after the other.
        max_iterations: Limit of L-BFGS iterations from each start.
        seed: Seed of the random starts. The global random state is left alone.

    Returns:
        The likelihood reached and whether the optimiser converged, a list of them for a
        ``ModelListGP``. The model is left in eval mode.

    Raises:
        TypeError: If the model is of another kind.
        ValueError: If an option is out of range, or no parameter is learnable.
        RuntimeError: If the likelihood cannot be evaluated anywhere; the model is left unchanged.

    Warns:
        OptimizationWarning: If the optimiser did not converge.
    """
    for name, value, least in (
        ("num_starts", num_starts, 1),
        ("num_screened", num_screened, 0),
        ("max_iterations", max_iterations, 1),
    ):
        if value is not None and value < least:
            raise ValueError(f"Expected {name} >= {least}, got {value}.")
    if isinstance(model, ModelListGP):
        results = []
        for part in model.models:
            result = fit(
                part,
                num_starts=num_starts,
                num_screened=num_screened,
                max_iterations=max_iterations,
                seed=seed,
            )
            results.extend(result if isinstance(result, list) else [result])
        return results
    if not isinstance(model, BatchedMultiOutputGPyTorchModel):
        raise TypeError(
            "Expected a model of gpadjust, another BoTorch model with batched outputs, or a "
            f"ModelListGP of them, got {type(model).__name__}."
        )
    objective = Objective(model)
    space = SearchSpace(objective)
    if num_screened is None:
        most = 128 if objective.is_batched else 32
        num_screened = max(16, min(most, 12_800 // model.train_targets.shape[-1]))
    starts = objective.current()
    if num_screened:
        generator = torch.Generator().manual_seed(seed)
        drawn = space.draw(num_screened, generator)
        factor = _in_chunks(objective, objective.best_scale, drawn)
        starts = torch.cat([starts, space.rescaled(drawn, factor)])
    starts, values = _best(objective, starts, num_starts)
    if not values[0].isfinite().all():
        model.eval()
        raise RuntimeError(
            "The marginal likelihood could not be evaluated at any start: the covariance has no "
            "Cholesky factor. Check for repeated inputs with different targets, or fix a larger "
            "noise through train_Yvar."
        )
    settings, values, converged = _optimise(objective, space, starts, max_iterations)
    best = values.argmin(0)
    problems = torch.arange(objective.num_problems)
    objective.assign(settings[best, problems])
    model.eval()
    converged = converged[best, problems].reshape(objective.batch_shape)
    if not converged.all():
        warnings.warn(
            f"L-BFGS did not converge for {int((~converged).sum())} of {objective.num_problems} "
            f"outputs within {max_iterations} iterations; the parameters are the best found. "
            "Raise max_iterations or num_starts.",
            OptimizationWarning,
            stacklevel=2,
        )
    log_likelihood = -values[best, problems].reshape(objective.batch_shape)
    return FitResult(log_likelihood, converged)


def _best(objective: Objective, starts: Tensor, num_starts: int) -> tuple[Tensor, Tensor]:
    """The best starts of each problem, best first, and their values."""
    values = _in_chunks(objective, objective, starts)
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
    with torch.no_grad():
        return torch.cat([function(part) for part in settings.split(chunk)])


def _converged(info: Any, space: SearchSpace) -> bool:
    """Whether L-BFGS converged: by its own account, or stuck in rounding errors at a minimum."""
    if info["success"]:
        return True
    lower, upper = np.asarray(space.unit_bounds).T
    x, gradient = info["x"], info["jac"]
    projected = x - np.clip(x - gradient, lower, upper)
    stuck: bool = "ABNORMAL" in info["message"]
    return stuck and bool(np.abs(projected).max() < _SMALL_GRADIENT * max(1.0, abs(info["fun"])))


def _optimise(
    objective: Objective, space: SearchSpace, starts: Tensor, max_iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Run L-BFGS from all starts of all problems; return settings, values and convergence."""
    num_starts, num_problems, num_parameters = starts.shape
    reached = starts.clone()

    def function(x: np.ndarray, batch_indices: list[int]) -> tuple[np.ndarray, np.ndarray]:
        # The objective takes whole rows of problems: evaluate those with an active one.
        rows, problems = np.divmod(np.asarray(batch_indices), num_problems)
        reached[rows, problems] = space.from_unit(torch.from_numpy(x).to(reached), problems)
        active = np.unique(rows)
        values, gradient = objective.value_and_gradient(reached[active])
        position = np.searchsorted(active, rows)
        f = values[position, problems].nan_to_num(posinf=_INFEASIBLE)
        g = (gradient[position, problems] * space.unit[problems]).nan_to_num()
        return f.cpu().numpy(), g.cpu().numpy()

    every = np.tile(np.arange(num_problems), num_starts)
    x, f, info = fmin_l_bfgs_b_batched(
        function,
        space.to_unit(starts.reshape(-1, num_parameters), every).cpu().numpy(),
        bounds=space.unit_bounds,
        maxiter=max_iterations,
        factr=_TOLERANCE / np.finfo(float).eps,
        pass_batch_indices=True,
    )
    shape = (num_starts, num_problems)
    converged = torch.tensor([_converged(each, space) for each in info]).reshape(shape)
    values = torch.from_numpy(np.asarray(f, dtype=np.float64)).reshape(shape)
    settings = space.from_unit(torch.from_numpy(x).to(starts), every)
    return settings.reshape(*shape, num_parameters), values, converged
