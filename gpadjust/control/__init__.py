"""Tasks, planning, policy search, and agents that control by them (the extra ``control``)."""

try:
    import gymnasium as _  # noqa: F401
except ImportError as error:
    raise ImportError(
        'gpadjust.control needs Gymnasium; run `pip install "gpadjust[control]"`.'
    ) from error

from gpadjust.control.action_rate import ActionRate
from gpadjust.control.agent import Agent, Callback
from gpadjust.control.agents import MPCAgent, PolicySearchAgent
from gpadjust.control.checkpoint import EpisodeCheckpoint, resume
from gpadjust.control.constraints import margins
from gpadjust.control.mpc import MPC, Planned
from gpadjust.control.planner import Plan, Planner
from gpadjust.control.policies import BoundedPolicy, mlp_policy
from gpadjust.control.policy_search import PolicySearch, SearchResult
from gpadjust.control.progress import print_progress
from gpadjust.control.rollouts import Objective, Return, Rollout, Rollouts
from gpadjust.control.search import CrossEntropy
from gpadjust.control.state_filter import Estimate, StateFilter
from gpadjust.control.step_guard import FailedStepWarning, StepGuard
from gpadjust.control.task import Constraints, InitialStates, Reward, Step, Task, Termination

__all__ = [
    "MPC",
    "ActionRate",
    "Agent",
    "BoundedPolicy",
    "Callback",
    "Constraints",
    "CrossEntropy",
    "EpisodeCheckpoint",
    "Estimate",
    "FailedStepWarning",
    "InitialStates",
    "MPCAgent",
    "Objective",
    "Plan",
    "Planned",
    "Planner",
    "PolicySearch",
    "PolicySearchAgent",
    "Return",
    "Reward",
    "Rollout",
    "Rollouts",
    "SearchResult",
    "StateFilter",
    "Step",
    "StepGuard",
    "Task",
    "Termination",
    "margins",
    "mlp_policy",
    "print_progress",
    "resume",
]
