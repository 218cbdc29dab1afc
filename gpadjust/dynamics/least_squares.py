"""Unknown parameters of a physics by least squares of its steps, for any number of transitions."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from scipy.optimize import least_squares
from torch import Tensor

from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import Physics, PhysicsWarning
from gpadjust.physics.parameters import even_normal
from gpadjust.physics.unknown import Unknowns
from gpadjust.states import StateSpec

_SEARCHED = 512  # transitions of the search; all transitions refine the best result
_GUESSES = 512  # draws from the prior
_STARTS = 6  # best of the draws, from which searches start
_ROUNDS = 30  # of least squares and variances by turns
_CALLS = 6  # of the physics in each round
_ROUGH = 0.1  # change of the log of variances below which a search ends
_SETTLED = 1e-4  # change below which the refinement ends
_SILENT = 1e-14  # smallest mean square of errors, relative to that of the changes
_STEP = 1e-4  # of differences, in standard deviations of the prior
_FLAT = 0.15  # precision of a direction that the transitions do not determine
_TAKES_PART = 0.3  # cosine of a parameter with such directions
_FAR = 3.0  # standard deviations of the prior


@torch.no_grad()
def most_likely(
    physics: Physics, spec: StateSpec, data: Trajectories
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the most likely parameters of a physics by transitions.

    Returns:
        Coordinates ``p``; their precision by the transitions, ``p x p``, without the prior; and
        mean squares of the errors, ``state_dim``, 0 for states that do not move.
    """
    unknowns = physics.unknowns
    errors = StepErrors(physics, spec, data)
    guess = unknowns.to_coordinates(unknowns.guess)
    if not errors.evaluate(guess).isfinite().all():
        physics(errors.inputs)  # raises an error that says where it fails
    # Search: from the best draws of the prior, by some of the transitions.
    number = min(len(data), _SEARCHED)
    rows = torch.linspace(0, len(data) - 1, number, dtype=torch.float64).round().long()
    some = StepErrors(physics, spec, data.subset(rows))
    starts = torch.cat([guess.unsqueeze(0), even_normal(_GUESSES, len(guess), seed=0)])
    best = some.loss(starts).nan_to_num(nan=torch.inf).argsort()[:_STARTS]
    ends = [some.descend(z, _ROUGH) for z in starts[best] if some.loss(z).isfinite()]
    # Refinement: by all of them.
    point = errors.descend(min([*ends, guess], key=errors.loss))
    r = errors.evaluate(point)
    # Gauss-Newton precision: sum_ij (dr_ij/dz) (dr_ij/dz)^T / sigma_i^2
    weighted = errors.slopes(point) / errors.variances(r).sqrt().unsqueeze(-1)
    precision = torch.einsum("pmn,qmn->pq", weighted, weighted)
    # The fit takes p degrees of freedom from the errors.
    freedom = errors.count.sum() / (errors.count.sum() - len(unknowns)).clamp_min(1)
    noise = torch.zeros(spec.state_dim, dtype=torch.float64)
    noise[spec.moving] = r.square().sum(-1) / errors.count.clamp_min(1) * freedom
    _warn_of_parameters(unknowns, precision, point)
    return point, precision, noise


class StepErrors:
    """Errors of a physics in one step, by the coordinates of its unknown parameters."""

    def __init__(self, physics: Physics, spec: StateSpec, data: Trajectories) -> None:
        self.physics, self.spec, self.data = physics, spec, data
        self.inputs = spec.physics_inputs(data.states, data.actions)
        changes = spec.change(data.states, data.next_states)[:, spec.moving].mT
        self.observed = ~changes.isnan()
        self.count = self.observed.sum(-1).double()  # n_i
        size = changes.square().nanmean(-1).nan_to_num()
        self.least = _SILENT * size + torch.finfo(changes.dtype).tiny

    def evaluate(self, z: Tensor) -> Tensor:
        """Return next states less those of the physics, ``... x m x n``; infinite if it fails."""
        following = self.physics.or_nan(self.inputs, self.physics.unknowns.to_values(z))
        predicted = self.data.states.expand(*following.shape[:-1], -1).clone()
        predicted[..., self.spec.moving] = following
        # r_ij = s'_ij - f_p(s_j, a_j)_i, with angles the shortest way round
        errors = self.spec.change(predicted, self.data.next_states)[..., self.spec.moving].mT
        return errors.masked_fill(~self.observed, 0.0).nan_to_num(nan=torch.inf)

    def slopes(self, z: Tensor) -> Tensor:
        """Return derivatives of the errors at ``p`` coordinates, ``p x m x n``."""
        steps = _STEP * torch.eye(len(z)).to(z)
        up, down = self.evaluate(torch.cat([z + steps, z - steps])).chunk(2)
        # central differences; 0 next to parameters at which the physics fails
        return ((up - down) / (2 * _STEP)).nan_to_num(0.0, 0.0, 0.0)

    def variances(self, errors: Tensor) -> Tensor:
        """Return mean squares of the errors, ``... x m``."""
        return (errors.square().sum(-1) / self.count.clamp_min(1)).maximum(self.least)

    def loss(self, z: Tensor) -> Tensor:
        """Return the minimised function, at coordinates ``... x p``."""
        # sum_i n_i / 2 log sigma_i^2 + |z|^2 / 2
        logs = self.variances(self.evaluate(z)).log()
        return (0.5 * self.count * logs).sum(-1) + 0.5 * z.square().sum(-1)

    def descend(self, z: Tensor, settled: float = _SETTLED) -> Tensor:
        """Return a minimum by least squares from coordinates ``p`` at which the physics works."""
        variances = self.variances(self.evaluate(z))
        for _ in range(_ROUNDS):
            # Least squares for fixed variances, then the variances of the new errors.
            sd = variances.sqrt().unsqueeze(-1)

            def residuals(point: Any, sd: Tensor = sd) -> Any:
                errors = self.evaluate(torch.from_numpy(point)) / sd
                return torch.cat([errors.flatten(), torch.from_numpy(point)]).numpy()

            def jacobian(point: Any, sd: Tensor = sd) -> Any:
                slopes = (self.slopes(torch.from_numpy(point)) / sd).flatten(1).mT
                return torch.cat([slopes, torch.eye(len(point)).double()]).numpy()

            z = torch.from_numpy(least_squares(residuals, z.numpy(), jacobian, max_nfev=_CALLS).x)
            old_variances = variances
            variances = self.variances(self.evaluate(z))
            if ((variances / old_variances).log().abs() < settled).all():
                break
        return z


def _warn_of_parameters(unknowns: Unknowns, precision: Tensor, point: Tensor) -> None:
    """Warn of parameters that transitions do not determine, or that contradict their prior.

    The former take part in directions with hardly any precision by the transitions, ``p x p``,
    compared with the prior; the latter have coordinates far from its middle. Some values of an
    unknown function always have hardly any precision.
    """
    values, vectors = torch.linalg.eigh(precision)
    is_number = torch.tensor([not unknown.function_of for unknown in unknowns.values()])
    is_flat = (vectors[:, values < _FLAT].norm(dim=-1) > _TAKES_PART) & is_number
    for mask, message in (
        (is_flat, "Transitions barely constrain {} of the physics: give narrower priors."),
        (point.abs() > _FAR, "Transitions and prior disagree about {} of the physics: check both."),
    ):
        listed = ", ".join(name for name, is_one in zip(unknowns, mask, strict=True) if is_one)
        if listed:
            warnings.warn(message.format(listed), PhysicsWarning, stacklevel=5)
