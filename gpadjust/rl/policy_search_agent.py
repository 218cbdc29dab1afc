"""An agent whose policy is improved by gradients through the model."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor

from gpadjust.control import (
    BoundedPolicy,
    PolicySearch,
    Rollouts,
    Task,
    linear_policy,
    mlp_policy,
    rbf_policy,
)
from gpadjust.control.search import random_sequences
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.episode_loop import EpisodeLoop
from gpadjust.rl.model_learner import ModelLearner
from gpadjust.rl.options import ModelOptions
from gpadjust.states import StateSpec

PolicyKind = Literal["mlp", "linear", "rbf"]
_KINDS: dict[str, Callable[..., BoundedPolicy]] = {
    "mlp": mlp_policy,
    "linear": linear_policy,
    "rbf": rbf_policy,
}
_EPISODES, _MAX_HOLD = 128, 5  # of random actions, by which the policy's inputs are scaled


class PolicySearchAgent(ModelLearner, EpisodeLoop):
    """Policy search in dynamics that learn from each real episode.

    The policy is trained in the physics before the first real episode, and after each one in the
    newest model, by :class:`~gpadjust.control.PolicySearch`, from where it was. Without a physics,
    with several, or if the task does not say where episodes start, the first episode's actions are
    random. Callbacks, loggers, ``save`` and ``load``, checkpoints, and what errors leave are as of
    :class:`Dyna`.

    Args:
        policy: ``"mlp"``, ``"linear"`` or ``"rbf"``.
        env: The real environment; observations are those of the spec of the dynamics.
        task: What is known of the system, in PyTorch's functions, as gradients flow through them.
        search: How the policy is improved.
        options: How the model is learnt.
        buffer_size: Real transitions that are kept.
        train_freq: As in SB3. Default: after each episode; with several environments give a number
            of steps.
        random_steps: Episodes that begin before so many real steps have random actions, held for
            up to five steps; the policy is then trained after them. Default: it is trained in the
            physics before the first one.
        policy_kwargs: Further arguments of the policy, such as ``net_arch``.
        kwargs: Further arguments of ``OffPolicyAlgorithm``, such as ``action_noise``.

    Raises:
        ValueError: As :class:`Dyna`, or if there is no such policy.
        TypeError: As :class:`Dyna`.

    Example:
        >>> import gymnasium
        >>> import torch
        >>> from gpadjust.control import PolicySearch, Task
        >>> from gpadjust.dynamics import LearnedDynamics
        >>> from gpadjust.systems import cart_pole
        >>> from gpadjust.systems.cart_pole import CART_POLE_SPEC, cart_pole_reward
        >>> from gpadjust.systems.cart_pole import cart_pole_start
        >>> from gpadjust.rl import PolicySearchAgent
        >>> env = gymnasium.make("gpadjust/CartPoleSwingUp-v0")
        >>> dynamics = LearnedDynamics(CART_POLE_SPEC, cart_pole(0).physics)
        >>> bounds = torch.tensor([[-50.0] * 4, [50.0] * 4])  # far beyond what is ever seen
        >>> task = Task(
        ...     dynamics, cart_pole_reward, initial_states=cart_pole_start, state_bounds=bounds
        ... )
        >>> search = PolicySearch(updates=2, num_starts=4, num_functions=2)
        >>> agent = PolicySearchAgent("linear", env, task, search, seed=0)
        >>> agent.learn(total_timesteps=25).num_episodes
        1
    """

    policy: SearchedPolicy

    def __init__(
        self,
        policy: PolicyKind | type[BasePolicy],
        env: GymEnv | str | None,
        task: Task | None = None,
        search: PolicySearch | None = None,
        options: ModelOptions | None = None,
        *,
        buffer_size: int = 100_000,
        train_freq: int | tuple[int, str] = (1, "episode"),
        random_steps: int = 0,
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if isinstance(policy, str) and policy not in _KINDS:
            raise ValueError(f"There is no policy {policy!r}, but there are {', '.join(_KINDS)}.")
        self.search = PolicySearch() if search is None else search
        if not isinstance(self.search, PolicySearch):
            raise TypeError(f"search must be a PolicySearch(...); found {search!r}.")
        if not isinstance(policy, str | type):
            raise TypeError(
                f"policy must be one of {', '.join(map(repr, _KINDS))}; found a "
                f"{type(policy).__name__}. A module of your own is improved by "
                "PolicySearch(...).improve(module, task)."
            )
        self.is_trained = False
        if task is not None and isinstance(policy, str):
            spec = task.dynamics.spec
            policy_kwargs = {"kind": policy, "spec": spec, **(policy_kwargs or {})}
        super().__init__(
            task,
            ModelOptions() if options is None else options,
            SearchedPolicy if isinstance(policy, str) else policy,
            env,
            buffer_size=buffer_size,
            train_freq=train_freq,
            random_steps=random_steps,
            policy_kwargs=policy_kwargs,
            replay_buffer_class=MixedReplayBuffer,
            **kwargs,
        )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        """Train in what is known before the first real episode."""
        result = super()._setup_learn(*args, **kwargs)
        task = self.model_task()
        known = task.dynamics.before_data()
        waits = self.is_trained or self.begins_at_random()
        if not waits and known is not None and task.initial_states is not None:
            self._search(replace(task, dynamics=known))
        return result

    def _plans(self) -> bool:
        return not self.is_trained or self.begins_at_random()  # actions are random

    def _improve(self, num_ended: int, batch_size: int) -> None:
        if not self.begins_at_random():
            self._search(self.model_task())

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The policy's actions, as in SB3; the policy sees what ``VecNormalize`` was given."""
        normalizer = self._vec_normalize_env
        seen: Any = observation if normalizer is None else normalizer.unnormalize_obs(observation)
        return super().predict(seen, state, episode_start, deterministic)

    def _search(self, task: Task) -> None:
        """Improve the policy in a model."""
        module = self.policy.module
        if not self.is_trained:
            module.look_at(self._random_states(task))
        with self.timed("update"):
            result = self.search.improve(
                module, task, guided=not self.is_trained, progress=self._report
            )
        self.is_trained = True
        self.promise = result.reward
        self.logger.record("model/search_left_bounds", result.left_bounds)
        self.logger.record("model/search_seconds", result.seconds)
        if result.left_bounds > 0.1:
            warnings.warn(
                f"{result.left_bounds:.0%} of the episodes of the policy left the bounds of the "
                "states in the model, so it is not to be trusted there. Penalise such states in "
                "the reward, widen state_bounds of the task, or take more updates.",
                UserWarning,
                stacklevel=2,
            )

    def _report(self, update: int, value: float) -> None:
        """Say how far a search is, ten times, where SB3 prints its log."""
        updates = self.search.updates
        if update % max(1, updates // 10) == 0 or update == updates:
            self.logger.info(f"policy search: update {update} of {updates}, value {value:.4g}")

    def _random_states(self, task: Task) -> Tensor:
        """States ``N x state_dim`` of episodes of random actions in a model."""
        length = task.episode_length
        assert length is not None, "asked before"
        steps = random_sequences(_EPISODES, length, self.action_bounds(), _MAX_HOLD).unbind(1)
        taken = iter(steps)
        with torch.no_grad():
            starts = task.draw_initial_states(_EPISODES)
            rollout = Rollouts(task, None).act(starts, lambda states: next(taken), length)
        return torch.cat([starts, rollout.next_states[rollout.made]])


class SearchedPolicy(BasePolicy):
    """A policy of :mod:`gpadjust.control` as Stable-Baselines3 has them.

    Args:
        observation_space: The observations of the spec.
        action_space: A box.
        lr_schedule: Not used.
        kind: ``"mlp"``, ``"linear"`` or ``"rbf"``.
        spec: What the entries of states and actions are.
        kwargs: Further arguments of the policy.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Any = None,
        *,
        kind: PolicyKind = "mlp",
        spec: StateSpec,
        **kwargs: Any,
    ) -> None:
        for name in ("use_sde", "normalize_images"):  # SB3 gives them to all
            kwargs.pop(name, None)
        super().__init__(observation_space, action_space)
        self._made_of = {"kind": kind, "spec": spec, **kwargs}
        bounds = torch.stack([torch.as_tensor(b) for b in (action_space.low, action_space.high)])
        self.module = _KINDS[kind](spec, bounds, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._made_of}

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        """The actions, ``n x action_dim``."""
        return self.module.act(torch.as_tensor(observation).double()).float()
