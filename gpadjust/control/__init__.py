"""Tasks, planning, policy search, and agents that control by them.

Only agents and :class:`StepGuard` need Gymnasium (the extra ``control``).
"""

from typing import Any

from gpadjust.control.constraints import margins
from gpadjust.control.mpc import MPC
from gpadjust.control.planner import Plan, Planner
from gpadjust.control.policy_search import BoundedPolicy, PolicySearch, SearchResult
from gpadjust.control.rollouts import Objective, Return, Rollouts
from gpadjust.control.state_filter import Estimate, StateFilter
from gpadjust.control.task import ActionRate, Moment, Steps, Task

__all__ = [
    "MPC",
    "ActionRate",
    "Agent",
    "EpisodeCheckpoint",
    "FailedStepWarning",
    "MPCAgent",
    "Planner",
    "PolicySearch",
    "PolicySearchAgent",
    "Return",
    "StateFilter",
    "StepGuard",
    "Task",
    "margins",
    "print_progress",
    "resume",
]

try:
    from gpadjust.control.agent import Agent, Callback, print_progress
    from gpadjust.control.agents import MPCAgent, PolicySearchAgent
    from gpadjust.control.checkpoint import EpisodeCheckpoint, resume
    from gpadjust.control.step_guard import FailedStepWarning, StepGuard
except ImportError as error:
    if (error.name or "").startswith("gpadjust"):
        raise
    _missing = error

    def __getattr__(name: str) -> Any:
        """Raise an error with the command that installs what a missing name needs."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        raise ImportError(
            f'{__name__}.{name} needs Gymnasium; run `pip install "gpadjust[control]"`.'
        ) from _missing
