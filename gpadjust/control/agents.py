"""The agents of the library: one plans each step, one improves a policy."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import check_kind
from gpadjust.control.agent import MAX_HOLD, Agent
from gpadjust.control.faults import check_observation
from gpadjust.control.mpc import MPC, Plan, Planner, going_on
from gpadjust.control.policy_search import BoundedPolicy, PolicySearch
from gpadjust.control.rollouts import Rollouts, random_sequences
from gpadjust.control.task import Task
from gpadjust.progress import long_work
from gpadjust.states import StateSpec

_EPISODES = 128  # of random actions, by which the policy's inputs are scaled


class MPCAgent(Agent):
    """Model predictive control in dynamics that learn from each real episode.

    There is no policy to be trained: real steps are those of :class:`MPC`, which plans them in the
    newest model. Before the first episode it plans in the physics.

    Args:
        env: As of :class:`Agent`.
        task: As of :class:`Agent`.
        each_step: Plans at each step but the first, see :class:`MPC`; so for the next two.
        first: Plans when an episode begins.
        tolerance: How much a plan may disappoint.
        options: Further arguments of :class:`Agent`, which has the errors, too.

    Example:
        >>> from gpadjust.control import MPCAgent, Planner
        >>> from gpadjust.systems import cart_pole
        >>> system = cart_pole()
        >>> quick = Planner(rounds=1, horizon=0.3, num_random=16)  # or leave it out
        >>> agent = MPCAgent(system.make(), system.task(), quick, first=quick, seed=0)
        >>> agent.learn(total_timesteps=25)
        MPCAgent(CartPoleSwingUpEnv, LearnedDynamics, 1 episodes learnt, 25 steps, last reward ...)
    """

    not_saved = ("_mpc",)
    _mpc: tuple[tuple[Any, ...], MPC] | None = None

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
            check_kind(name, planner, Planner | None, "a Planner(...)")
        self.each_step = each_step
        self.first = first
        self.tolerance = tolerance
        super().__init__(env, task, **options)

    @property
    def mpc(self) -> MPC:
        """The policy in the newest model, or the physics; made once for each.

        Raises:
            RuntimeError: If there is neither a physics nor a real episode to plan with.
        """
        made_of = self.newest_model, self.each_step, self.first, self.tolerance, self.filter
        if self._mpc is None or any(map(operator.is_not, made_of, self._mpc[0])):
            task, each_step, first, tolerance, known = made_of
            how: dict[str, Any] = {"first": first, "tolerance": tolerance, "state_filter": known}
            self._mpc = made_of, MPC(task, self.action_bounds(), each_step, **how)
        return self._mpc[1]

    def predict(
        self,
        observation: NDArray[Any],
        state: Sequence[Plan] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[Plan, ...]]:
        """Plan actions; see :meth:`MPC.predict`."""
        return self.mpc.predict(observation, state, episode_start, deterministic)

    def promise(self, state: Sequence[Plan]) -> dict[str, float]:
        """Return the promised reward of a step by the plan of a whole episode."""
        (plan,) = state
        promises = {"left_bounds": plan.left_bounds}
        if self.task.constraints is not None:
            promises["violation"] = plan.violation
        if len(plan.promised) >= self.episode_length():
            promises["promised_reward"] = plan.reward
        if plan.violation > 0:
            warnings.warn(
                f"No plan of an episode was found that holds the constraints with their margins: "
                f"the best one violates them by {plan.violation:.3g}, in the worst step. A lower "
                "probability of the task has smaller margins; so have a better physics, or more "
                "data.",
                UserWarning,
                stacklevel=2,
            )
        self.warn_of_bounds(plan.left_bounds, "the functions along the best plan of an episode")
        return promises


class PolicySearchAgent(Agent):
    """Policy search in dynamics that learn from each real episode.

    The policy is trained in the physics before the first real episode, and after each one in the
    newest model, by :class:`PolicySearch`, from where it was. If the task does not say where
    episodes start, the first episode's actions are random. Beside the events of :class:`Agent`
    there are ``"update"``, ten times in a search, with its number and value, and ``"search"``, with
    ``reward`` of a step, ``left_bounds`` and ``seconds``.

    Args:
        env: As of :class:`Agent`.
        task: What is known of the system, in PyTorch's functions, as gradients flow through them.
        policy: Makes the policy of a spec and the bounds of the actions: :class:`BoundedPolicy`,
            or a function of yours, such as ``functools.partial(BoundedPolicy, net_arch=(32,))``.
        search: How the policy is improved.
        options: Further arguments of :class:`Agent`, which has the errors, too.

    Attributes:
        policy: The policy.

    Example:
        >>> from dataclasses import replace
        >>> import torch
        >>> from gpadjust.control import PolicySearch, PolicySearchAgent
        >>> from gpadjust.systems import cart_pole
        >>> wide = torch.tensor([[-50.0] * 4, [50.0] * 4])  # far beyond what is ever seen
        >>> system = replace(cart_pole(), state_bounds=wide)
        >>> search = PolicySearch(updates=2, num_starts=8)
        >>> agent = PolicySearchAgent(system.make(), system.task(), search=search, seed=0)
        >>> agent.learn(total_timesteps=25)
        PolicySearchAgent(CartPoleSwingUpEnv, LearnedDynamics, 1 episodes learnt, 25 steps, ...)
    """

    def __init__(
        self,
        env: Any,
        task: Task,
        policy: Callable[[StateSpec, Tensor], BoundedPolicy] = BoundedPolicy,
        search: PolicySearch | None = None,
        **options: Any,
    ) -> None:
        self.search = PolicySearch() if search is None else search
        check_kind("search", self.search, PolicySearch, "a PolicySearch(...)")
        super().__init__(env, task, **options)
        made = policy(task.dynamics.spec, self.action_bounds()) if callable(policy) else policy
        expected = "a function that makes a BoundedPolicy of a spec and bounds, as the class does"
        check_kind("policy", made, BoundedPolicy, expected)
        self.policy = made
        self.is_trained = False
        self._reward = math.nan  # of a step, as the last search foresaw it

    def _check(self) -> None:
        self.search.check_task(self.task)
        super()._check()

    def improve(self, task: Task) -> bool:
        """Improve the policy, if it is known where episodes start."""
        if task.initial_states is None:
            return False
        if not self.is_trained:
            length, bounds = self.episode_length(), self.action_bounds()
            sequences = random_sequences(_EPISODES, length, bounds, MAX_HOLD)
            with torch.no_grad():
                starts = task.draw_initial_states(_EPISODES)
                run = Rollouts(task, None).follow(starts, sequences)
            self.policy.look_at(torch.cat([starts, run.next_states[run.made]]))
        last = self.search.updates
        tenth = max(1, last // 10)

        def progress(update: int, value: float) -> None:
            if update % tenth == 0 or update == last:
                self.tell("update", {"number": update, "value": value})

        with long_work("search", "updates", total=last):
            result = self.search.improve(self.policy, task, progress=progress)
        self.is_trained, self._reward = True, result.reward
        names = ("reward", "left_bounds", "seconds")
        self.tell("search", {name: getattr(result, name) for name in names})
        self.warn_of_bounds(result.left_bounds, "the episodes of the policy")
        return True

    def promise(self, state: Any) -> dict[str, float]:
        """Return the reward of a step that the last search found in the model."""
        return {"promised_reward": self._reward}

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return the policy's actions, always the same at an observation; see :class:`Agent`.

        With sensors the state is an :class:`Estimate` of each episode, at whose mean they are.
        """
        check_observation(observation)
        seen, estimates = torch.as_tensor(np.asarray(observation)).double(), []
        if self.filter is not None:
            rows = torch.atleast_2d(seen)
            earlier = going_on(state, episode_start, len(rows))
            estimates = self.filter.follow(self.newest_model, rows, earlier)
            means = self.task.dynamics.spec.observe(torch.stack([e.mean for e in estimates]))
            seen = means.reshape(*seen.shape[:-1], -1)
        with torch.no_grad():
            actions = self.policy.act(seen)
        if estimates:
            pairs = zip(estimates, torch.atleast_2d(actions), strict=True)
            state = tuple(estimate._replace(action=action) for estimate, action in pairs)
        return actions.numpy().astype(np.float32), state
