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
from gpadjust.control.episodes import check_observation
from gpadjust.control.mpc import MPC, continued
from gpadjust.control.planner import Plan, Planner
from gpadjust.control.policy_search import BoundedPolicy, PolicySearch
from gpadjust.control.rollouts import Rollouts, random_sequences
from gpadjust.control.task import Task
from gpadjust.progress import long_work
from gpadjust.states import StateSpec

_EPISODES = 128  # episodes of random actions, for the scale of the policy's inputs


class MPCAgent(Agent):
    """Model predictive control in dynamics that learn from each real episode.

    There is no policy to train: :class:`MPC` plans each real step in the newest model, before the
    first episode in the physics.

    Args:
        env: As of :class:`Agent`.
        task: As of :class:`Agent`.
        each_step: As of :class:`MPC`, as the next two.
        first: Plans when an episode begins.
        tolerance: Largest loss of a plan.
        options: Further arguments of :class:`Agent`, which also has the errors.

    Example:
        >>> from gpadjust.systems import cart_pole
        >>> system = cart_pole()
        >>> quick = Planner(rounds=1, horizon=0.3, num_random=16)  # or leave it out
        >>> agent = MPCAgent(system.make(), system.task(), quick, first=quick, seed=0)
        >>> agent.learn(total_timesteps=25)
        MPCAgent(CartPoleSwingUpEnv, LearnedDynamics, 1 episodes learnt, 25 steps, last reward ...)
    """

    not_saved = ("_mpc",)
    _mpc: tuple[tuple[Any, ...], MPC] | None = None  # with its arguments

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
        check_kind("each_step", each_step, Planner | None, "a Planner(...)")
        check_kind("first", first, Planner | None, "a Planner(...)")
        self.each_step = each_step
        self.first = first
        self.tolerance = tolerance
        super().__init__(env, task, **options)

    @property
    def mpc(self) -> MPC:
        """The controller in the newest model or the physics; an error if there is neither."""
        parts = self.newest_model, self.each_step, self.first, self.tolerance, self.filter
        # A controller of other parts is made again.
        if self._mpc is None or any(map(operator.is_not, parts, self._mpc[0])):
            task, each_step, first, tolerance, state_filter = parts
            bounds = self.action_bounds()
            controller = MPC(
                task, bounds, each_step, first=first, tolerance=tolerance, state_filter=state_filter
            )
            self._mpc = parts, controller
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
        """Return the promised reward of a step by the plan of a complete episode."""
        (plan,) = state
        promises = {"left_bounds": plan.left_bounds}
        if self.task.constraints is not None:
            promises["violation"] = plan.violation
        if len(plan.promised) >= self.episode_length():
            promises["promised_reward"] = plan.reward
        if plan.violation > 0:
            message = (
                "No plan of an episode keeps the constraints with their margins: the best violates "
                f"them by {plan.violation:.3g} in the worst step. A lower probability of the task, "
                "a better physics or more data make the margins smaller."
            )
            warnings.warn(message, UserWarning, stacklevel=2)
        self.warn_of_bounds(plan.left_bounds, "the functions along the best plan of an episode")
        return promises


class PolicySearchAgent(Agent):
    """Policy search in dynamics that learn from each real episode.

    :class:`PolicySearch` improves the policy in the physics before the first real episode, and
    after each in the newest model. If the task has no starts of episodes, the first episode's
    actions are random. Callbacks get the event ``"search"``, with ``reward`` of a step,
    ``left_bounds`` and ``seconds``.

    Args:
        env: As of :class:`Agent`.
        task: As of :class:`Agent`, in PyTorch's functions, for gradients.
        policy: Makes the policy of a spec and the bounds of the actions: :class:`BoundedPolicy`,
            or a function of yours, such as ``functools.partial(BoundedPolicy, net_arch=(32,))``.
        search: The search.
        options: Further arguments of :class:`Agent`, which also has the errors.

    Attributes:
        policy: The policy.

    Example:
        >>> from dataclasses import replace
        >>> from gpadjust.systems import cart_pole
        >>> wide = torch.tensor([[-50.0] * 4, [50.0] * 4])  # for two quick updates
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
        self.search = search or PolicySearch()
        check_kind("search", self.search, PolicySearch, "a PolicySearch(...)")
        super().__init__(env, task, **options)
        made = policy(task.dynamics.spec, self.action_bounds()) if callable(policy) else policy
        expected = "a function that makes a BoundedPolicy of a spec and bounds, as the class does"
        check_kind("policy", made, BoundedPolicy, expected)
        self.policy = made
        self.is_trained = False
        self._reward = math.nan  # of a step in the model, by the last search

    def _check(self) -> None:
        self.search.check_task(self.task)
        super()._check()

    def improve(self, task: Task) -> bool:
        """Improve the policy, if starts of episodes are known."""
        if task.initial_states is None:
            return False
        if not self.is_trained:
            # The scale of the observations, by random actions in the model.
            sequences = random_sequences(
                _EPISODES, self.episode_length(), self.action_bounds(), MAX_HOLD
            )
            with torch.no_grad():
                starts = task.draw_initial_states(_EPISODES)
                run = Rollouts(task, None).follow(starts, sequences)
            self.policy.look_at(torch.cat([starts, run.next_states[run.made]]))
        with long_work("search", "updates", total=self.search.updates):
            result = self.search.improve(self.policy, task)
        self.is_trained = True
        self._reward = result.reward
        names = ("reward", "left_bounds", "seconds")
        self.tell("search", {name: getattr(result, name) for name in names})
        self.warn_of_bounds(result.left_bounds, "the episodes of the policy")
        return True

    def promise(self, state: Any) -> dict[str, float]:
        """Return the reward of a step in the model, by the last search."""
        return {"promised_reward": self._reward}

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return the policy's actions, which are deterministic; see :class:`Agent`.

        With sensors the state is an :class:`Estimate` of each episode, and the policy acts at its
        mean.
        """
        check_observation(observation)
        inputs = torch.as_tensor(np.asarray(observation)).double()
        estimates = []
        if self.filter is not None:
            rows = torch.atleast_2d(inputs)
            earlier = continued(state, episode_start, len(rows))
            estimates = self.filter.follow(self.newest_model, rows, earlier)
            means = torch.stack([estimate.mean for estimate in estimates])
            inputs = self.task.dynamics.spec.observe(means).reshape(*inputs.shape[:-1], -1)
        with torch.no_grad():
            actions = self.policy.act(inputs)
        if estimates:
            pairs = zip(estimates, torch.atleast_2d(actions), strict=True)
            state = tuple(estimate._replace(action=action) for estimate, action in pairs)
        return actions.numpy().astype(np.float32), state
