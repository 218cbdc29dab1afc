"""Unknown parameters of a physics by least squares of its steps, of however many transitions."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from scipy.optimize import least_squares
from torch import Tensor

from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import Physics, PhysicsWarning
from gpadjust.physics.unknown import Unknowns
from gpadjust.states import StateSpec

_SEARCHED = 512  # transitions by which parameters are searched for; all of them refine the best
_GUESSES, _STARTS = 512, 6  # draws from the prior, and how many of the best are started from
_ROUNDS, _CALLS = 30, 6  # of least squares and variances by turns, and of the physics in each
_ROUGH, _SETTLED = 0.1, 1e-4  # changes of the log of variances, below which a search ends
_SILENT = 1e-14  # the mean square of errors, relative to that of the changes, that is none
_STEP = 1e-4  # of differences, in standard deviations of the prior
_UNTOLD, _TAKES_PART = 0.15, 0.3  # precision next to nothing; cosine of a parameter with it
_FAR = 3.0  # standard deviations of the prior


@torch.no_grad()
def most_likely(
    physics: Physics, spec: StateSpec, data: Trajectories
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the most likely parameters of a physics by transitions.

    Returns:
        Coordinates ``p``; the precision of these by the transitions, ``p x p``, without the prior;
        and mean squares of the errors, ``state_dim``, 0 of states that do not move.
    """
    unknowns, whole = physics.unknowns, StepErrors(physics, spec, data)
    guess = unknowns.coordinates(unknowns.guess)
    if not whole.at(guess).isfinite().all():
        physics(whole.inputs)  # which says where it fails
    number = min(len(data), _SEARCHED)
    rows = torch.linspace(0, len(data) - 1, number, dtype=torch.float64).round().long()
    some = StepErrors(physics, spec, data.some(rows))
    starts = torch.cat([guess.unsqueeze(0), even_normal(_GUESSES, len(guess), seed=0)])
    best = some.loss(starts).nan_to_num(nan=torch.inf).argsort()[:_STARTS]
    ends = [some.descend(z, _ROUGH) for z in starts[best] if some.loss(z).isfinite()]
    point = whole.descend(min([*ends, guess], key=whole.loss))
    errors = whole.at(point)
    weighted = whole.slopes(point) / whole.variances(errors).sqrt().unsqueeze(-1)
    precision = torch.einsum("pmn,qmn->pq", weighted, weighted)
    freedom = whole.count.sum() / (whole.count.sum() - len(unknowns)).clamp_min(1)
    noise = torch.zeros(spec.state_dim, dtype=torch.float64)
    noise[spec.moving] = errors.square().sum(-1) / whole.count.clamp_min(1) * freedom
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

    def at(self, z: Tensor) -> Tensor:
        """Return next states less those of the physics, ``... x m x n``; infinite if it fails."""
        following = self.physics.or_nan(self.inputs, self.physics.unknowns.at(z))
        predicted = self.data.states.expand(*following.shape[:-1], -1).clone()
        predicted[..., self.spec.moving] = following
        errors = self.spec.change(predicted, self.data.next_states)[..., self.spec.moving].mT
        return errors.masked_fill(~self.observed, 0.0).nan_to_num(nan=torch.inf)

    def slopes(self, z: Tensor) -> Tensor:
        """Return derivatives of the errors at ``p`` coordinates, ``p x m x n``."""
        steps = _STEP * torch.eye(len(z)).to(z)
        up, down = self.at(torch.cat([z + steps, z - steps])).chunk(2)
        return ((up - down) / (2 * _STEP)).nan_to_num(0.0, 0.0, 0.0)

    def variances(self, errors: Tensor) -> Tensor:
        """Return mean squares of the errors, ``... x m``."""
        return (errors.square().sum(-1) / self.count.clamp_min(1)).maximum(self.least)

    def loss(self, z: Tensor) -> Tensor:
        """Return what is minimised, at coordinates ``... x p``."""
        logs = self.variances(self.at(z)).log()
        return (0.5 * self.count * logs).sum(-1) + 0.5 * z.square().sum(-1)

    def descend(self, z: Tensor, settled: float = _SETTLED) -> Tensor:
        """Return where least squares leads from coordinates ``p`` at which the physics works."""
        variances = self.variances(self.at(z))
        for _ in range(_ROUNDS):
            sd = variances.sqrt().unsqueeze(-1)

            def residuals(point: Any, sd: Tensor = sd) -> Any:
                errors = self.at(torch.from_numpy(point)) / sd
                return torch.cat([errors.flatten(), torch.from_numpy(point)]).numpy()

            def jacobian(point: Any, sd: Tensor = sd) -> Any:
                slopes = (self.slopes(torch.from_numpy(point)) / sd).flatten(1).mT
                return torch.cat([slopes, torch.eye(len(point)).double()]).numpy()

            found = least_squares(residuals, z.numpy(), jacobian, max_nfev=_CALLS)
            z, before = torch.from_numpy(found.x), variances
            variances = self.variances(self.at(z))
            if ((variances / before).log().abs() < settled).all():
                break
        return z


def _warn_of_parameters(unknowns: Unknowns, precision: Tensor, point: Tensor) -> None:
    """Warn of parameters of which transitions tell next to nothing, or that contradict a prior.

    The first take part in directions in which the transitions have next to none of the prior's
    precision, ``p x p``; the second are at coordinates far from its middle. Of some values of a
    function there is always next to nothing.
    """
    values, vectors = torch.linalg.eigh(precision)
    is_number = torch.tensor([not unknown.function_of for unknown in unknowns.values()])
    silent = (vectors[:, values < _UNTOLD].norm(dim=-1) > _TAKES_PART) & is_number
    for which, message in (
        (silent, "Transitions say next to nothing of {} of the physics: give narrower priors."),
        (point.abs() > _FAR, "Transitions and prior disagree about {} of the physics: look at it."),
    ):
        told = ", ".join(name for name, is_one in zip(unknowns, which, strict=True) if is_one)
        if told:
            warnings.warn(message.format(told), PhysicsWarning, stacklevel=5)


def even_normal(number: int, p: int, seed: int) -> Tensor:
    """Return standard normal draws ``number x p`` that fill space evenly (Sobol)."""
    engine = torch.quasirandom.SobolEngine(p, scramble=True, seed=seed)
    shares = engine.draw(number, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
    return torch.special.ndtri(shares)
