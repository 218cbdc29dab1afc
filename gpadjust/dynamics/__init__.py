"""Distributions of the next state of a system, by the models of this library."""

from gpadjust.dynamics.base import Dynamics, FreeRun, TransitionFunctions
from gpadjust.dynamics.identified import IdentifiedDynamics
from gpadjust.dynamics.learned_dynamics import AngleInput, LearnedDynamics
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.trajectories import Trajectories, Windows
from gpadjust.states import StateSpec

__all__ = [
    "Dynamics",
    "IdentifiedDynamics",
    "LearnedDynamics",
    "PhysicsDynamics",
    "Trajectories",
]
