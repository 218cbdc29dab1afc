"""Who learns: a row for each learner."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

from torch import Tensor

from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, Trajectories
from gpadjust.models import (
    CKA,
    RRA,
    CalibratedPhysics,
    PhysicsMeanGP,
    PhysicsParameters,
    ZeroMeanGP,
    orthogonal_rbf,
)
from gpadjust.physics import Physics
from gpadjust.records import Records, smooth
from paper.real import SMOOTHED
from paper.real.least_squares import LeastSquares
from paper.real.machines import Machine
from paper.real.networks import NetworkDynamics

Known = Literal["crude", "identified"]
Maker = Callable[[Machine, Trajectories, int], Dynamics]


class Learnt(NamedTuple):
    """What a learner made.

    Args:
        dynamics: The dynamics.
        noise: Standard deviations of what is measured, ``state_dim``, if they learnt from states
            that were estimated: the noise that they learnt is then process noise.
        parameters: The posterior of f_p's parameters, if they were learnt.
    """

    dynamics: Dynamics
    noise: Tensor | None = None
    parameters: PhysicsParameters | None = None


def learnt(learner: str, machine: Machine, data: Trajectories, seed: int) -> Learnt:
    """What a learner makes of transitions of a machine; networks are drawn by the seed."""
    dynamics = MAKERS[learner](machine, data, seed)
    if not isinstance(dynamics, LearnedDynamics) or not dynamics.model.has_unknowns:
        return Learnt(dynamics)
    return Learnt(dynamics, parameters=dynamics.model.physics_parameters)


def learnt_of_stretches(learner: str, machine: Machine, records: Records, seed: int) -> Learnt:
    """The same of stretches: of all their transitions, or those of a draw of the states."""
    if learner not in SMOOTHED:
        return learnt(learner, machine, records.trajectories(), seed)
    found = smooth(records, machine.calibrated())
    dynamics = learnt(learner, machine, found.draw(seed).trajectories(), seed).dynamics
    return Learnt(dynamics, found.noise, found.physics_parameters)


def _alone(known: Known) -> Maker:
    """f_p, of which nothing is learnt."""

    def make(machine: Machine, data: Trajectories, seed: int) -> Dynamics:
        return PhysicsDynamics(machine.spec, machine.physics(machine.known[known]))

    return make


def _adjusted(model: Any, known: Known | None) -> Maker:
    """The library's dynamics by their defaults."""

    def make(machine: Machine, data: Trajectories, seed: int) -> Dynamics:
        physics = None if known is None else machine.physics(machine.known[known])
        return _taught(LearnedDynamics(machine.spec, physics, model=model), data)

    return make


def _calibrated(model: Any, **options: Any) -> Maker:
    """The same with a physics whose parameters are learnt with all else."""

    def make(machine: Machine, data: Trajectories, seed: int) -> Dynamics:
        physics = machine.calibrated()
        learnt = LearnedDynamics(machine.spec, physics, model=partial(model, **options))
        return _taught(learnt, data)

    return make


def _least_squares(machine: Machine, data: Trajectories, seed: int) -> Dynamics:
    return _taught(LeastSquares(machine, machine.known["crude"]), data)


def _adjusted_least_squares(machine: Machine, data: Trajectories, seed: int) -> Dynamics:
    """One after the other, from the same transitions."""
    fitted = LeastSquares(machine, machine.known["crude"])
    physics: Physics = _taught(fitted, data).physics
    return _taught(LearnedDynamics(machine.spec, physics, model=PhysicsMeanGP), data)


def _networks(known: Known | None) -> Maker:
    def make(machine: Machine, data: Trajectories, seed: int) -> Dynamics:
        physics = None if known is None else machine.physics(machine.known[known])
        return _taught(NetworkDynamics(machine.spec, physics, seed=seed), data)

    return make


def _taught(dynamics: Any, data: Trajectories) -> Any:
    dynamics.update(*data)
    return dynamics


MAKERS: dict[str, Maker] = {
    "phy": _alone("crude"),
    "phy-identified": _alone("identified"),
    "fitted": _least_squares,
    "gp": _adjusted(ZeroMeanGP, None),
    "phymean": _adjusted(PhysicsMeanGP, "crude"),
    "phymean-identified": _adjusted(PhysicsMeanGP, "identified"),
    "phymean-fitted": _adjusted_least_squares,
    "cka": _adjusted(CKA, "crude"),
    "cka-identified": _adjusted(CKA, "identified"),
    "rra": _adjusted(RRA, "crude"),
    "rra-identified": _adjusted(RRA, "identified"),
    "calibrated": _calibrated(CalibratedPhysics),
    "calibrated-delta": _calibrated(PhysicsMeanGP),
    "calibrated-orthogonal": _calibrated(PhysicsMeanGP, covar_module=orthogonal_rbf),
    "calibrated-cka": _calibrated(CKA),
    "stretches-delta": _calibrated(PhysicsMeanGP),
    "smoothed": _calibrated(CalibratedPhysics),
    "smoothed-delta": _calibrated(PhysicsMeanGP),
    "smoothed-cka": _calibrated(CKA),
    "network": _networks(None),
    "residual": _networks("crude"),
}
