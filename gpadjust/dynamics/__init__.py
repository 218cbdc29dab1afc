"""Distributions of the next state of a system, over the models of this library."""

from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.learned_dynamics import LearnedDynamics
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.trajectory_information import TrajectoryInformation
from gpadjust.dynamics.trajectory_scores import TrajectoryScores
from gpadjust.dynamics.transition_scores import TransitionScores
from gpadjust.states import StateSpec

__all__ = [
    "AngleInput",
    "Dynamics",
    "LearnedDynamics",
    "PhysicsDynamics",
    "StateSpec",
    "TrajectoryInformation",
    "TrajectoryScores",
    "TransitionFunctions",
    "TransitionScores",
]
