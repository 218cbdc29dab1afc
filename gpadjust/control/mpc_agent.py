"""An agent that plans each step of its real episodes."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpadjust.control.agent import Agent
from gpadjust.control.mpc import MPC, PlanState, check_planner
from gpadjust.control.planner import Planner
from gpadjust.control.task import Task


class MPCAgent(Agent):
    """Model predictive control in dynamics that learn from each real episode.

    There is no policy to be trained: real steps are those of :class:`MPC`, which plans them in the
    newest model. Before the first episode it plans in the physics.

    Args:
        env: As of :class:`Agent`.
        task: As of :class:`Agent`.
        each_step: Plans at each step but the first, see :class:`MPC`.
        first: Plans when an episode begins, see :class:`MPC`.
        tolerance: How much a plan may disappoint, see :class:`MPC`.
        options: Further arguments of :class:`Agent`.

    Raises:
        TypeError: As :class:`Agent`, or if a planner is none.
        ValueError: As :class:`Agent`.

    Example:
        >>> import gymnasium
        >>> from gpadjust.control import CrossEntropy, MPCAgent, Planner, Task
        >>> from gpadjust.dynamics import LearnedDynamics
        >>> from gpadjust.envs import CART_POLE_SPEC, cart_pole_reward, random_cart_pole_physics
        >>> env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
        >>> task = Task(
        ...     LearnedDynamics(CART_POLE_SPEC, random_cart_pole_physics(0)), cart_pole_reward
        ... )
        >>> quick = Planner(search=CrossEntropy(1), horizon=3, num_random=16)  # or leave it out
        >>> agent = MPCAgent(env, task, quick, first=quick, seed=0)
        >>> agent.learn(total_timesteps=2 * 25)
        MPCAgent(CartPoleSwingUpEnv, LearnedDynamics, 2 episodes learnt, 50 steps)
    """

    def __init__(
        self,
        env: Any,
        task: Task,
        each_step: Planner | None = None,
        *,
        first: Planner | None = None,
        tolerance: float | None = 0.25,
        **options: Any,
    ) -> None:
        for name, planner in (("each_step", each_step), ("first", first)):
            if planner is not None:
                check_planner(name, planner)
        self.each_step = each_step
        self.first = first
        self.tolerance = tolerance
        super().__init__(env, task, **options)

    @property
    def mpc(self) -> MPC:
        """The policy in the newest model, or the physics.

        Raises:
            RuntimeError: If there is neither a physics nor a real episode to plan with.
        """
        task = self.known_task() if self.model is None else self.model
        if task is None:
            raise RuntimeError(
                f"{type(self).__name__} knows nothing of the system yet; call `learn`, or give the "
                "dynamics a physics."
            )
        how: dict[str, Any] = {"first": self.first, "tolerance": self.tolerance}
        return MPC(task, self.action_bounds(), self.each_step, **how)

    def predict(
        self,
        observation: NDArray[Any],
        state: PlanState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], PlanState]:
        """Plan actions; see :meth:`MPC.predict`.

        Raises:
            RuntimeError: If there is neither a physics nor a real episode to plan with.
        """
        return self.mpc.predict(observation, state, episode_start, deterministic)

    def promise(self, state: PlanState) -> dict[str, float]:
        """What the plan of an episode promises of a step, if it is of the whole episode."""
        (plan,) = state
        if plan.left_bounds > 0.1:
            warnings.warn(
                f"The best plan of an episode leaves the bounds of the states in "
                f"{plan.left_bounds:.0%} of the functions that it was followed through, so it "
                "is not to be trusted there. Penalise such states in the reward, widen "
                "state_bounds of the task, or search longer (MPCAgent(first=...)).",
                UserWarning,
                stacklevel=2,
            )
        whole = len(plan.promised) >= self.episode_length()
        return {"left_bounds": plan.left_bounds} | (
            {"promised_reward": plan.reward} if whole else {}
        )
