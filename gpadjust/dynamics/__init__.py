"""Distributions of the next state of a system, over the models of this library."""

from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.state_spec import StateSpec

__all__ = ["Dynamics", "PhysicsDynamics", "StateSpec", "TransitionFunctions"]
