"""Distributions of the next state of a system, over the models of this library."""

from gpadjust.dynamics.adjusted_dynamics import (
    BiasDynamics,
    CKADynamics,
    GPDynamics,
    PhysicsMeanDynamics,
    RRADynamics,
    ScaleDynamics,
)
from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.learned_dynamics import LearnedDynamics
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.state_spec import StateSpec
from gpadjust.dynamics.trajectory_information import TrajectoryInformation
from gpadjust.dynamics.transition_scores import TransitionScores

__all__ = [
    "AngleInput",
    "BiasDynamics",
    "CKADynamics",
    "Dynamics",
    "GPDynamics",
    "LearnedDynamics",
    "PhysicsDynamics",
    "PhysicsMeanDynamics",
    "RRADynamics",
    "ScaleDynamics",
    "StateSpec",
    "TrajectoryInformation",
    "TransitionFunctions",
    "TransitionScores",
]
