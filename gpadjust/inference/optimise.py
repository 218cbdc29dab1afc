"""Bringing a model's hyper-parameters to an optimum by multi-start L-BFGS."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from botorch.optim.batched_lbfgs_b import fmin_l_bfgs_b_batched
from torch import Tensor

from gpadjust.gp import AppendedPhysics
from gpadjust.inference.distributions import MarginalizedParameters
from gpadjust.inference.targets import LogLikelihood, Target
from gpadjust.inference.vectors import Parameters, magnitude

_TOLERANCE = 1e-8  # relative decrease of the target below which L-BFGS stops
_RESTARTS = 3  # of runs that ended without convergence
_STUCK = 1e-4  # relative decrease below which a restart has found nothing new
_INFEASIBLE = 1e10  # what the optimiser sees where the likelihood cannot be evaluated
MANY = 150  # observations; a search is made on some of more
_SEARCHED = 96  # of them, which tell what optima there are
_ROUGH = 1e-5  # tolerance of that search
_COMPARED = 6  # of its optima that are compared on all observations
_REFINED = 2  # of these that the search goes on from
_APART = 0.3  # by which these differ in some logarithm
NOWHERE = (
    "The marginal likelihood could not be evaluated at any start: the covariance has no Cholesky "
    "factor. Check for repeated inputs with different targets, or fix a larger noise through "
    "train_Yvar."
)


class Search(NamedTuple):
    """The options of a search, see :func:`~gpadjust.fit`; None for the default."""

    num_starts: int | None = None
    num_screened: int | None = None
    max_iterations: int = 500
    seed: int = 0


@dataclass(frozen=True)
class FitResult:
    """Result of a fit.

    Attributes:
        log_likelihood: The log marginal likelihood (plus log priors, if the model has any) of
            each output, in the units of the model's targets; ``batch_shape x (m)``. Unknown
            constant means are at their least squares estimates, not integrated out. Of a
            :class:`~gpadjust.VariationalCKA` the evidence lower bound of all observations.
        converged: Whether the optimiser converged, for each output, of the same shape; of a
            VariationalCKA, whose last search stops after 15 iterations, it seldom has.
    """

    log_likelihood: Tensor
    converged: Tensor


class Differentiable(Protocol):
    """A function that L-BFGS minimises."""

    @property
    def parameters(self) -> Parameters:
        """The vectors and their bounds."""
        ...

    def value_and_gradient(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Values ``k x B`` and gradients ``k x B x p`` at vectors ``k x B x p``."""
        ...


def maximise(
    model: BatchedMultiOutputGPyTorchModel,
    search: Search,
    marginalized: MarginalizedParameters | None = None,
) -> FitResult:
    """Bring a model to its most likely hyper-parameters, see :func:`~gpadjust.fit`.

    With many observations the search is made on some of them. What unknown parameters of a physics
    add to the targets' distribution is ``marginalized``.
    """
    with centers_at_rest(model):
        target = LogLikelihood(model, marginalized=marginalized)
        parameters = target.parameters
        if not parameters.names:  # all is known but the parameters of the physics
            value = target(parameters.current())[0].reshape(parameters.batch_shape)
            model.eval()
            return FitResult(-value, torch.ones_like(value, dtype=torch.bool))
        starts = _starts(target, search)
        reached, values, converged = optimise(target, starts, search.max_iterations)
        best = values.argmin(0), torch.arange(parameters.num_problems)
        target.assign(reached[best])
    model.eval()
    converged = converged[best].reshape(parameters.batch_shape)
    if not converged.all():
        warnings.warn(
            f"L-BFGS did not converge for {int((~converged).sum())} of {parameters.num_problems} "
            f"outputs within {search.max_iterations} iterations; the parameters are the best "
            "found. Raise max_iterations or num_starts.",
            OptimizationWarning,
            stacklevel=3,
        )
    return FitResult(-values[best].reshape(parameters.batch_shape), converged)


@contextmanager
def centers_at_rest(model: BatchedMultiOutputGPyTorchModel) -> Iterator[None]:
    """Let centers rest: the most likely ones are found far out, where intervals are too narrow."""
    bases = [b for b in model.covar_module.modules() if isinstance(b, AppendedPhysics)]
    learnt = [basis.learnt for basis in bases if basis.learnt is not None]
    for center in learnt:
        center.requires_grad_(False)
    try:
        yield
    finally:
        for center in learnt:
            center.requires_grad_(True)


def optima(target: Target, search: Search) -> tuple[Tensor, Tensor]:
    """Rough optima, not assigned to the model: ``k x B x p`` and their values ``k x B``."""
    starts = _starts(target, search)
    reached, values, _ = optimise(target, starts, min(search.max_iterations, 60), _ROUGH)
    return reached, values


def _starts(target: Target, search: Search) -> Tensor:
    """Return the starts of L-BFGS, ``k x B x p``; an error if the target is finite nowhere."""
    parameters = target.parameters
    starts = parameters.clipped(parameters.current())
    if search.num_screened != 0:
        if parameters.is_batched and target.num_points > MANY:
            found = _best(target, torch.cat([starts, _optima_of_some(target, search)]))
            # Few may show nothing but noise, an optimum of all that is better than other starts.
            starts = torch.cat([found, starts])
        else:
            starts = _screened(target, search)
    if not target(starts).amin(0).isfinite().all():
        raise RuntimeError(NOWHERE)
    return starts


def _optima_of_some(target: Target, search: Search) -> Tensor:
    """Optima on some of the observations, ``k x B x p``; of each the best first."""
    generator = torch.Generator().manual_seed(search.seed)
    rows = torch.randperm(target.num_points, generator=generator)[:_SEARCHED].sort().values
    part = target.of_rows(rows)
    # A search should not take longer than what follows it.
    few = 8 if target.num_points < 4 * _SEARCHED else 16
    starts = _screened(
        part,
        search._replace(
            num_starts=search.num_starts or few, num_screened=search.num_screened or _SEARCHED
        ),
    )
    reached, values, _ = optimise(part, starts, min(search.max_iterations, 40), _ROUGH)
    if part.concentrated:
        reached, values = part.at_best_scale(reached)
    return _rows(reached, values.argsort(dim=0)[:_COMPARED])


def _best(target: Target, candidates: Tensor) -> Tensor:
    """The best candidates of each problem that are apart from each other, ``k x B x p``."""
    kept = []
    for problem, order in enumerate(target(candidates).argsort(dim=0).mT):
        ranked = candidates[order, problem]
        apart = (ranked - ranked[0]).abs().amax(-1) > _APART
        others = apart.nonzero().flatten()[: _REFINED - 1].tolist()
        kept.append(ranked[[0, *others, *[0] * (_REFINED - 1 - len(others))]])
    return torch.stack(kept, dim=1)


def _screened(target: Target, search: Search) -> Tensor:
    """The best of random vectors and the model's own, ``num_starts x B x p``, best first."""
    parameters = target.parameters
    num_screened, num_starts = search.num_screened, search.num_starts
    if num_screened is None:
        most = 256 if parameters.is_batched else 32
        num_screened = max(16, min(most, 25_600 // target.num_points))
    if num_starts is None:
        num_starts = 16 if parameters.is_batched else 8
    generator = torch.Generator().manual_seed(search.seed)
    drawn, values = target.at_best_scale(parameters.draw(num_screened, generator))
    current = parameters.clipped(parameters.current())
    starts, values = torch.cat([current, drawn]), torch.cat([target(current), values])
    if parameters.noise.any() and num_starts > 1 and len(starts) > 2:
        # Optima with and without noise are apart, and without it a random start looks bad.
        clean = torch.zeros_like(values, dtype=torch.bool)
        clean[1 : 1 + len(starts) // 2] = True
        noisy = values.masked_fill(clean, math.inf).argsort(dim=0)[: (num_starts + 1) // 2]
        noiseless = values.masked_fill(~clean, math.inf).argsort(dim=0)[: num_starts // 2]
        order = torch.cat([noisy, noiseless])
        order = order.gather(0, values.gather(0, order).argsort(dim=0))
    else:
        order = values.argsort(dim=0)[:num_starts]
    if num_starts > 1 and not parameters.is_batched and not (order == 0).any():
        order[-1] = 0  # the user's guess of the physics' parameters is worth a start of its own
    return _rows(starts, order)


def _rows(vectors: Tensor, numbers: Tensor) -> Tensor:
    """Return the vectors ``k x B x p`` of the numbers ``k' x B``, for each problem."""
    numbers = numbers.to(vectors.device)
    return vectors.gather(0, numbers.unsqueeze(-1).expand(-1, -1, vectors.shape[-1]))


def optimise(
    target: Differentiable, starts: Tensor, max_iterations: int, tolerance: float = _TOLERANCE
) -> tuple[Tensor, Tensor, Tensor]:
    """Run L-BFGS from all starts of all problems; return where it got, values, convergence.

    The optimiser has one box for all problems: it sees vectors less their lower bounds. Its first
    step is of length one, a factor of e in logarithms: a longer one may end in noise so small that
    the nugget hides it, where no gradient points back.
    """
    num_starts, num_problems, num_parameters = starts.shape
    parameters = target.parameters
    width = parameters.upper - parameters.lower
    bounded = width.isfinite() & (width > 0)
    zero = torch.where(bounded, parameters.lower, torch.zeros_like(width))
    unit = torch.where(bounded, torch.ones_like(width), magnitude(parameters.current()[0]))
    low = ((parameters.lower - zero) / unit).amin(0).tolist()
    high = ((parameters.upper - zero) / unit).amax(0).tolist()
    reached = (starts - zero) / unit

    def function(x: np.ndarray, batch_indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The target takes whole rows of problems: evaluate those with an active one.
        rows, problems = np.divmod(batch_indices, num_problems)
        reached[rows, problems] = torch.from_numpy(x).to(reached)
        active = np.unique(rows)
        values, gradient = target.value_and_gradient(zero + reached[active] * unit)
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
            factr=tolerance / np.finfo(float).eps,
            pass_batch_indices=True,
        )
        flags = np.array([each["status"] for each in info])
        return x, np.asarray(f, dtype=np.float64), flags == 0, flags == 1

    flat = reached.reshape(-1, num_parameters).cpu().numpy()
    x, f, converged, spent = run(flat, np.arange(len(flat)))
    best = f.reshape(num_starts, num_problems).argmin(0) * num_problems + np.arange(num_problems)
    for _ in range(_RESTARTS if tolerance == _TOLERANCE else 0):
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
