"""Tasks, and planning in dynamics models; Stable-Baselines3 is not needed."""

from gpadjust.control.mpc import MPC, Planned
from gpadjust.control.objectives import Objective, Return
from gpadjust.control.planner import Plan, Planner
from gpadjust.control.policies import BoundedPolicy, linear_policy, mlp_policy, rbf_policy
from gpadjust.control.policy_search import PolicySearch, SearchResult, imitate
from gpadjust.control.rollouts import Rollout, Rollouts
from gpadjust.control.search import CrossEntropy, PathIntegral, Search
from gpadjust.control.task import InitialStates, Reward, Step, Task, Termination

__all__ = [
    "MPC",
    "BoundedPolicy",
    "CrossEntropy",
    "InitialStates",
    "Objective",
    "PathIntegral",
    "Plan",
    "Planned",
    "Planner",
    "PolicySearch",
    "Return",
    "Reward",
    "Rollout",
    "Rollouts",
    "Search",
    "SearchResult",
    "Step",
    "Task",
    "Termination",
    "imitate",
    "linear_policy",
    "mlp_policy",
    "rbf_policy",
]
