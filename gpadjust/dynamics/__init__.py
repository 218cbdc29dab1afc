"""Distributions of the next state of a system, over the models of this library."""

from gpadjust.dynamics.angle_input import AngleInput
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.free_run import FreeRun
from gpadjust.dynamics.free_run_scores import FreeRunScores
from gpadjust.dynamics.learned_dynamics import LearnedDynamics
from gpadjust.dynamics.physics_dynamics import PhysicsDynamics
from gpadjust.dynamics.record import Record
from gpadjust.dynamics.records import Records, Windows
from gpadjust.dynamics.smoothed_records import SmoothedRecords, smooth
from gpadjust.dynamics.smoothing import SmoothingWarning
from gpadjust.dynamics.trajectory_scores import TrajectoryScores
from gpadjust.dynamics.transition_scores import TransitionScores
from gpadjust.dynamics.transitions import Transitions
from gpadjust.states import StateSpec

__all__ = [
    "AngleInput",
    "Dynamics",
    "FreeRun",
    "FreeRunScores",
    "LearnedDynamics",
    "PhysicsDynamics",
    "Record",
    "Records",
    "SmoothedRecords",
    "SmoothingWarning",
    "StateSpec",
    "TrajectoryScores",
    "TransitionFunctions",
    "TransitionScores",
    "Transitions",
    "Windows",
    "smooth",
]
