"""A policy that plans at every step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.control.planner import Plan, Planner
from gpadjust.control.search import CrossEntropy
from gpadjust.control.task import Task
from gpadjust.models.sampled_functions import seeded

PlanState = tuple[NDArray[np.float64], NDArray[np.int64]]
"""What is planned for each episode, ``n_envs x T x action_dim``, and how many steps it has made."""

EACH_STEP = Planner(
    search=CrossEntropy(1, num_elites=12, correlation=0.5), horizon=10, num_random=256, num_policy=0
)
"""The default plan of a step: two looks at 256 sequences of ten steps."""

FIRST = Planner(
    search=CrossEntropy(12, num_elites=12, correlation=0.5),
    num_random=128,
    num_policy=0,
    restarts=3,
)
"""The default plan of an episode that begins: the whole of it, in some seconds."""


class MPC:
    """Model predictive control: at each step the steps ahead are planned, and the first is made.

    It has the ``predict`` of Stable-Baselines3's policies, so that ``evaluate_policy`` and
    ``record_video`` take it; what it returns as state is the plan, which the next call improves.

    Args:
        task: The task; its dynamics must be fitted.
        action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        each_step: Plans at each step but the first.
        first: Plans when an episode begins. Default: with three searches of the whole episode, or
            as far as ``each_step`` looks if the task does not say how long it is.
        seed: Of the searches of deterministic actions, which are the same for the same observation
            and plan.

    Raises:
        ValueError: If there is neither an episode length nor a horizon.

    Example:
        >>> import numpy as np
        >>> import torch
        >>> from gpadjust.control import MPC, Task
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> near = lambda states, actions, next_states: -next_states[:, 0].abs()
        >>> task = Task(point, near, episode_length=4)
        >>> mpc = MPC(task, torch.tensor([[-1.0], [1.0]]))
        >>> action, plan = mpc.predict(np.array([0.5]))
        >>> bool(abs(action + 0.5) < 0.2)
        True
    """

    def __init__(
        self,
        task: Task,
        action_bounds: Tensor,
        each_step: Planner = EACH_STEP,
        *,
        first: Planner | None = None,
        seed: int = 0,
    ) -> None:
        if task.episode_length is None and each_step.horizon is None:
            raise ValueError(
                "Nobody says how far to plan; give the task an episode_length, or the planner a "
                "horizon."
            )
        self.task = task
        self.action_bounds = torch.as_tensor(action_bounds, dtype=torch.float64)
        self.each_step = each_step
        if first is None:
            horizon = each_step.horizon if task.episode_length is None else None
            first = replace(FIRST, objective=each_step.objective, horizon=horizon)
        self.first = first
        self.seed = seed

    def predict(
        self,
        observation: NDArray[Any],
        state: PlanState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PlanState]:
        """Plan actions.

        Args:
            observation: ``observation_dim`` of the spec, or ``n x observation_dim``.
            state: What the last call returned; None at the start.
            episode_start: Which episodes begin, ``n``. Default: all without ``state``, none with.
            deterministic: Whether the search is always the same.

        Returns:
            Actions, ``action_dim`` or ``n x action_dim``, and the state for the next call.
        """
        spec = self.task.dynamics.spec
        rows = torch.as_tensor(np.atleast_2d(observation), dtype=torch.float64)
        states = spec.decode(rows)
        n = len(states)
        begins = np.ones(n, dtype=bool) if state is None else np.zeros(n, dtype=bool)
        if episode_start is not None:
            begins = begins | np.atleast_1d(episode_start).astype(bool)
        known = [torch.empty(0, spec.action_dim, dtype=torch.float64)] * n
        done = np.zeros(n, dtype=np.int64)
        if state is not None:
            known = [torch.from_numpy(plan[~np.isnan(plan).any(-1)]) for plan in state[0]]
            done = np.where(begins, 0, state[1])
        plans = []
        with seeded(self.seed if deterministic else None):
            for i in range(n):
                earlier = None if begins[i] else known[i]
                plans.append(self.plan(states[i], earlier, int(done[i])).actions)
        actions = torch.stack([plan[0] for plan in plans])
        length = max(len(plan) for plan in plans)
        ahead = np.full((n, max(length - 1, 1), spec.action_dim), np.nan)
        for i, plan in enumerate(plans):
            ahead[i, : len(plan) - 1] = plan[1:].numpy()
        found = actions.numpy().astype(np.float32)
        return (found if np.ndim(observation) > 1 else found[0]), (ahead, done + 1)

    def plan(self, state: Tensor, known: Tensor | None, steps_done: int) -> Plan:
        """Plan the steps ahead of an episode that is at a state.

        Args:
            state: Where it is, ``state_dim``.
            known: What was planned; None at the start.
            steps_done: How many steps it has made.
        """
        length = self.task.episode_length
        left = None if length is None else max(length - steps_done, 1)
        planner = self.first if known is None or not len(known) else self.each_step
        return planner.plan(self.task, state, self.action_bounds, left, known=known)
