"""Who learns: a row for each learner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, Transitions
from gpadjust.models import (
    CKA,
    RRA,
    CalibratedPhysics,
    PhysicsMeanGP,
    ZeroMeanGP,
    orthogonal_rbf,
)
from gpadjust.physics import Physics
from paper.real.least_squares import LeastSquares
from paper.real.machines import Machine
from paper.real.networks import NetworkDynamics

Known = Literal["crude", "identified"]
Maker = Callable[[Machine, Transitions, int], Dynamics]


def learnt(learner: str, machine: Machine, data: Transitions, seed: int) -> Dynamics:
    """What a learner makes of transitions of a machine; networks are drawn by the seed."""
    return MAKERS[learner](machine, data, seed)


def _alone(known: Known) -> Maker:
    """f_p, of which nothing is learnt."""

    def make(machine: Machine, data: Transitions, seed: int) -> Dynamics:
        return PhysicsDynamics(machine.spec, machine.physics(machine.known[known]))

    return make


def _adjusted(model: Any, known: Known | None) -> Maker:
    """The library's dynamics by their defaults."""

    def make(machine: Machine, data: Transitions, seed: int) -> Dynamics:
        physics = None if known is None else machine.physics(machine.known[known])
        return _taught(LearnedDynamics(machine.spec, physics, model=model), data)

    return make


def _calibrated(model: Any, **options: Any) -> Maker:
    """The same with a physics whose parameters are learnt with all else."""

    def make(machine: Machine, data: Transitions, seed: int) -> Dynamics:
        physics = machine.calibrated()
        learnt = LearnedDynamics(machine.spec, physics, model=model, model_options=options)
        return _taught(learnt, data)

    return make


def _least_squares(machine: Machine, data: Transitions, seed: int) -> Dynamics:
    return _taught(LeastSquares(machine, machine.known["crude"]), data)


def _adjusted_least_squares(machine: Machine, data: Transitions, seed: int) -> Dynamics:
    """One after the other, from the same transitions."""
    fitted = LeastSquares(machine, machine.known["crude"])
    physics: Physics = _taught(fitted, data).physics
    return _taught(LearnedDynamics(machine.spec, physics, model=PhysicsMeanGP), data)


def _networks(known: Known | None) -> Maker:
    def make(machine: Machine, data: Transitions, seed: int) -> Dynamics:
        physics = None if known is None else machine.physics(machine.known[known])
        return _taught(NetworkDynamics(machine.spec, physics, seed=seed), data)

    return make


def _taught(dynamics: Any, data: Transitions) -> Any:
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
    "network": _networks(None),
    "residual": _networks("crude"),
}
