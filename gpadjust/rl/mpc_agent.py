"""An agent that plans each step of its real episodes."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor

from gpadjust.control import MPC, Planner, Task
from gpadjust.control.mpc import PlanState, check_planner
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.episode_loop import EpisodeLoop
from gpadjust.rl.model_learner import ModelLearner
from gpadjust.rl.options import ModelOptions
from gpadjust.rl.planned_episodes import PlannedEpisode


class MPCAgent(ModelLearner, EpisodeLoop):
    """Model predictive control in dynamics that learn from each real episode.

    There is no policy to be trained: real steps are those of :class:`~gpadjust.control.MPC`, which
    plans them in the newest model. Before the first episode it plans in the physics; without one,
    or with several, that episode's actions are random. Callbacks, loggers, ``save`` and ``load``,
    checkpoints, and what errors leave are as of :class:`Dyna`; ``predict`` serves
    ``evaluate_policy``.

    Args:
        env: The real environment; observations are those of the spec of the dynamics.
        task: What is known of the system; the rewards and terminations are compared with those of
            each real episode.
        each_step: Plans at each step but the first, see :class:`~gpadjust.control.MPC`.
        first: Plans when an episode begins, see :class:`~gpadjust.control.MPC`.
        tolerance: How much a plan may disappoint, see :class:`~gpadjust.control.MPC`.
        options: How the model is learnt.
        action_noise: As in SB3: what is added to the planned actions of real episodes.
        buffer_size: Real transitions that are kept.
        train_freq: As in SB3. Default: after each episode; with several environments give a number
            of steps.
        random_steps: Episodes that begin before so many real steps have random actions, held for
            up to five steps. Default: the first one is planned in the physics.
        kwargs: Further arguments of ``OffPolicyAlgorithm``.

    Raises:
        ValueError: As :class:`Dyna`.
        TypeError: As :class:`Dyna`.

    Example:
        >>> import gymnasium
        >>> from gpadjust.control import CrossEntropy, Planner, Task
        >>> from gpadjust.dynamics import LearnedDynamics
        >>> from gpadjust.systems import cart_pole
        >>> from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward
        >>> from gpadjust.rl import MPCAgent
        >>> env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
        >>> task = Task(
        ...     LearnedDynamics(CART_POLE_SPEC, cart_pole(0).physics), cart_pole_reward
        ... )
        >>> quick = Planner(search=CrossEntropy(1), horizon=3, num_random=16)  # or leave it out
        >>> agent = MPCAgent(env, task, quick, first=quick, seed=0)
        >>> agent.learn(total_timesteps=2 * 25).num_episodes
        2
    """

    def __init__(
        self,
        env: GymEnv | str | None,
        task: Task | None = None,
        each_step: Planner | None = None,
        *,
        first: Planner | None = None,
        tolerance: float | None = 0.25,
        options: ModelOptions | None = None,
        action_noise: ActionNoise | None = None,
        buffer_size: int = 100_000,
        train_freq: int | tuple[int, str] = (1, "episode"),
        random_steps: int = 0,
        policy: type[BasePolicy] | None = None,
        **kwargs: Any,
    ) -> None:
        for name, planner in (("each_step", each_step), ("first", first)):
            if planner is not None:
                check_planner(name, planner)
        self.each_step = each_step
        self.first = first
        self.tolerance = tolerance
        self._mpc: tuple[Task, tuple[Any, ...], MPC | None] | None = None
        super().__init__(
            task,
            ModelOptions() if options is None else options,
            Unmoved if policy is None else policy,
            env,
            buffer_size=buffer_size,
            train_freq=train_freq,
            random_steps=random_steps,
            action_noise=action_noise,
            replay_buffer_class=MixedReplayBuffer,
            **kwargs,
        )

    @property
    def mpc(self) -> MPC | None:
        """The policy, in the newest model, or the physics; None if nothing is known yet.

        It is made again where an episode has ended, or the agent was given something else.
        """
        task, num_ended = self.ready_task(), self.num_episodes + self.replay_buffer.num_ended
        made_of = (num_ended, task.dynamics.is_fitted, self.each_step, self.first, self.tolerance)
        if self._mpc is None or (task, made_of) != self._mpc[:2]:
            self._mpc = (task, made_of, self._new_mpc())
        return self._mpc[2]

    def _new_mpc(self) -> MPC | None:
        task = self.model_task()
        dynamics = task.dynamics.before_data()
        if dynamics is None:
            return None
        known = replace(task, dynamics=dynamics)
        return MPC(
            known, self.action_bounds(), self.each_step, first=self.first, tolerance=self.tolerance
        )

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: PlanState | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, PlanState | None]:
        """Plan actions; see :meth:`gpadjust.control.MPC.predict`.

        Raises:
            RuntimeError: If there is neither a physics nor a real episode to plan with.
        """
        mpc = self.mpc
        if mpc is None:
            raise RuntimeError(
                f"{type(self).__name__} knows nothing of the system yet; call `learn`, or give the "
                "dynamics a physics."
            )
        normalizer = self._vec_normalize_env
        seen: Any = observation if normalizer is None else normalizer.unnormalize_obs(observation)
        with self.timed("plan"):
            return mpc.predict(seen, state, episode_start, deterministic)

    def _plans(self) -> bool:
        return True

    def _plan(self, episode: PlannedEpisode, state: Tensor) -> Tensor:
        """Plan the steps ahead, or draw them, if nothing is known."""
        mpc, steps_done = self.mpc, episode.steps_done
        begins = not steps_done
        at_random = self.begins_at_random() if begins else episode.planned is None
        if mpc is None or at_random:
            return super()._plan(episode, state)
        earlier = episode.planned
        if earlier is not None:
            earlier = earlier._replace(actions=episode.ahead, steps_done=steps_done)
        with self.timed("plan"):
            plan = episode.planned = mpc.plan(state, earlier)
        if begins:
            whole = len(plan.promised) >= self.episode_length()
            episode.promise = plan.reward if whole else None
            self.logger.record("model/plan_left_bounds", plan.left_bounds)
            if plan.left_bounds > 0.1:
                warnings.warn(
                    f"The best plan of an episode leaves the bounds of the states in "
                    f"{plan.left_bounds:.0%} of the functions that it was followed through, so it "
                    "is not to be trusted there. Penalise such states in the reward, widen "
                    "state_bounds of the task, or search longer (MPCAgent(first=...)).",
                    UserWarning,
                    stacklevel=2,
                )
        actions = plan.actions.clone()
        if self.action_noise is not None:
            low, high = self.action_bounds()
            drawn = np.atleast_2d(self.action_noise())  # SB3 makes one for each environment
            noise = torch.from_numpy(drawn[episode.environment % len(drawn)]).double()
            actions[0] = torch.clamp(actions[0] + noise * (high - low) / 2, low, high)
        return actions

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_mpc"]

    def _policy_actions(
        self, learning_starts: int, action_noise: ActionNoise | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        middle = self._middle_action().numpy().astype(self.action_space.dtype)
        actions = np.tile(middle, (n_envs, 1))
        return actions, self.policy.scale_action(actions)


class Unmoved(BasePolicy):
    """A policy without parameters, in the place of one that is trained."""

    def __init__(
        self, observation_space: Any, action_space: Any, *args: Any, **kwargs: Any
    ) -> None:
        super().__init__(observation_space, action_space)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        """The middle of the actions, ``n x action_dim``."""
        space = self.action_space
        assert isinstance(space, spaces.Box), "checked when the agent was made"
        return torch.as_tensor((space.low + space.high) / 2).expand(len(observation), -1)
