"""Tasks, and planning in dynamics models; Stable-Baselines3 is not needed."""

from gpadjust.control.objectives import Information, Objective, Return
from gpadjust.control.planner import CrossEntropyPlanner, Plan
from gpadjust.control.rollouts import Rollout, Rollouts
from gpadjust.control.task import InitialStates, Reward, Step, Task, Termination

__all__ = [
    "CrossEntropyPlanner",
    "Information",
    "InitialStates",
    "Objective",
    "Plan",
    "Return",
    "Reward",
    "Rollout",
    "Rollouts",
    "Step",
    "Task",
    "Termination",
]
