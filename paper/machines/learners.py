"""Learners of machines: from transitions or records to dynamics."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records import Records, smooth
from paper.machines import REAL_LEARNERS, UNTRAINED
from paper.machines.networks import NetworkDynamics
from paper.machines.pendulums import Machine


class Trained(NamedTuple):
    """The result of a learner.

    Args:
        dynamics: The dynamics.
        noise: Standard deviations of what is measured, ``state_dim``, if they learnt from states
            that were estimated: the noise that they learnt is then process noise.
        parameters: The posterior of f_p's parameters, if they were learnt.
    """

    dynamics: Dynamics
    noise: Tensor | None = None
    parameters: PhysicsParameters | None = None


def train(name: str, machine: Machine, data: Any, seed: int) -> Trained:
    """Learn from transitions of a machine, or from records of stretches.

    Args:
        name: Of ``REAL_LEARNERS``.
        machine: The machine.
        data: ``Trajectories``; ``Records`` for all their transitions, or states along them.
        seed: Of networks, and of the draw of the states.
    """
    known = REAL_LEARNERS[name]
    found: Any = None
    if known.states == "smoothed":
        found = smooth(data, machine.physics())
        data = found.draw(seed)
    data = data.trajectories() if isinstance(data, Records) else data
    dynamics = _dynamics(name, machine, data, seed)
    if name not in UNTRAINED:
        dynamics.update(*data)
    if found is not None:
        return Trained(dynamics, found.noise, found.physics_parameters)
    learnt = dynamics.model.physics_parameters if isinstance(dynamics, LearnedDynamics) else None
    return Trained(dynamics, parameters=learnt or None)


def _dynamics(name: str, machine: Machine, data: Any, seed: int) -> Dynamics:
    known = REAL_LEARNERS[name]
    physics: Any = None
    if known.physics == "fitted":
        fitted = PhysicsDynamics(machine.spec, machine.physics())
        if known.model is None:
            return fitted
        fitted.update(*data)
        found = fitted.physics_parameters
        physics = machine.physics(dict(zip(found, found.mean.tolist(), strict=True)))
    elif known.physics != "none":
        physics = machine.physics(known.physics)
    if known.model is None:
        return PhysicsDynamics(machine.spec, physics)
    if known.model == "network":
        return NetworkDynamics(machine.spec, physics, seed=seed)
    return LearnedDynamics(machine.spec, physics, model=known.make)
