"""The loop of all learners with a model: real episodes, dynamics, improvement."""

from __future__ import annotations

import math
import time
import warnings
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from torch import Tensor

from gpadjust.control import Task
from gpadjust.control.search import random_sequences
from gpadjust.rl.callbacks import DynaCallback
from gpadjust.rl.foresight import foresight
from gpadjust.rl.options import ModelOptions
from gpadjust.rl.planned_episodes import PlannedEpisode, PlannedEpisodes
from gpadjust.rl.recorded_episodes import RecordedEpisodes
from gpadjust.rl.task_learner import TaskLearner

_MAX_HOLD = 5  # steps of a random action


class ModelLearner(TaskLearner):
    """A learner whose dynamics learn from each real episode, before it improves in them.

    After each real episode, ``train`` updates as the learner does by itself (``_update``), compares
    the task's rewards with those that were recorded, scores the dynamics on the new transitions,
    teaches them these, and improves (``_improve``), which is what subclasses say. Real episodes go
    by the policy, or by plans (``_plans``, ``_plan``).

    An error on the way (a wrong reward, a physics that fails, a fit that does not converge) loses
    nothing: the episodes are in the buffer, and the dynamics learn them after the next one.

    Args:
        task: What is known of the system.
        options: How the model is learnt.
        args: Further arguments of the learner.
        kwargs: Further arguments of the learner.

    Attributes:
        num_episodes: Real episodes that have ended and were learnt from.
        wall_time: Seconds spent on ``"fit"``, ``"rollout"``, ``"update"`` and ``"plan"``.
        promised_reward: What the model had promised of a step of the newest real episodes that were
            learnt from, or None, as of random actions.
        promise: What it promises of a step of the policy's next episodes, or None.
        promises: What it had promised of those that have ended and were not learnt from yet.
        planned: The real episodes under way that go by plans.
    """

    options_class: ClassVar[type[ModelOptions]] = ModelOptions

    def __init__(self, task: Task | None, options: ModelOptions, *args: Any, **kwargs: Any) -> None:
        self.options: Any = options
        self.num_episodes = 0
        self.planned = PlannedEpisodes()
        self.promised_reward: float | None = None
        self.promise: float | None = None
        self.promises: list[float | None] = []
        self.model_hooks: list[DynaCallback] = []
        super().__init__(task, *args, **kwargs)
        self.wall_time = dict.fromkeys(("fit", "rollout", "update", "plan"), 0.0)

    # One iteration

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update on what there is, learn the model, improve in it; SB3 calls this."""
        if not self.replay_buffer.size():
            return  # all steps failed
        serves = self.options.uses_model(self.num_episodes)
        new = self._new_episodes()
        if serves and new is not None and self.options.reward_tolerance is not None:
            new.check(self.ready_task(), self.options.reward_tolerance)
        with self.timed("update"):
            self._update(gradient_steps, batch_size)
        if new is None:
            return
        metrics = self._learn_dynamics(new) if serves else {}
        self._compare_promise(new, metrics.get("overrides", 0.0))
        num_ended = self.replay_buffer.num_ended
        self.replay_buffer.num_new = self.replay_buffer.num_ended = 0
        self.num_episodes += num_ended
        if serves:
            for hook in self.model_hooks:
                hook.on_model_fit(metrics)
            self._improve(num_ended, batch_size)
            total = sum(self.wall_time.values())
            for name, seconds in self.wall_time.items():
                self.logger.record(f"model/share_{name}", seconds / total)

    def _update(self, gradient_steps: int, batch_size: int) -> None:
        """The learner's own updates, on what there is."""
        super().train(gradient_steps, batch_size)

    def _improve(self, num_ended: int, batch_size: int) -> None:
        """What is done with the new model, after so many episodes have ended."""

    def _new_episodes(self) -> RecordedEpisodes | None:
        """The real steps that the dynamics have not learnt, if an episode has ended."""
        buffer, is_fitted = self.replay_buffer, self.ready_task().dynamics.is_fitted
        if not buffer.num_ended:
            return None
        new = self.recorded_episodes(newest=buffer.num_new if is_fitted else None)
        least = 1 if is_fitted else 2  # a first fit needs two
        return new if new.num_transitions >= least else None

    def _learn_dynamics(self, new: RecordedEpisodes) -> dict[str, float]:
        """Score the dynamics on new transitions, and teach them these; return what is logged."""
        task = self.model_task()
        metrics: dict[str, float] = {}
        start = time.perf_counter()
        with self.timed("fit"):
            transitions = new.learnable(task.dynamics)
            if task.dynamics.is_fitted:
                before = time.perf_counter()
                horizons = self.options.score_horizons
                metrics = foresight(task, transitions, self.recorded_episodes(), horizons)
                metrics["score_seconds"] = time.perf_counter() - before
            task.dynamics.update(*transitions)
        metrics["fit_seconds"] = time.perf_counter() - start - metrics.get("score_seconds", 0.0)
        # Dynamics without variances have no NLPD, short episodes no long trajectories.
        metrics = {name: value for name, value in metrics.items() if not math.isnan(value)}
        for name, value in metrics.items():
            self.logger.record(f"model/{name}", value)
        return metrics

    def _compare_promise(self, new: RecordedEpisodes, overrides: float) -> None:
        """Log what new episodes gave beside what was promised of them, and warn if it was less.

        There is a warning if the mean reward of a step is lower by more than a quarter of the range
        of all recorded rewards. It also says if data had overridden the physics in most of the
        predictions. (That alone is no fault: where a model has learnt without noise that its
        physics is a little off, they do so nearly everywhere.)
        """
        real = float(new.rewards.mean())
        self.logger.record("model/real_reward", real)
        promises, self.promises, self.promised_reward = self.promises, [], None
        kept = [each for each in promises if each is not None]
        if not kept or len(kept) < len(promises):
            return  # of actions that were random, say
        promised = self.promised_reward = sum(kept) / len(kept)
        self.logger.record("model/promised_reward", promised)
        recorded = self.recorded_episodes().rewards
        span = max(float(recorded.max()), promised) - float(recorded.min())
        if promised - real > span / 4:
            blame = (
                f"In {overrides:.0%} of its predictions data had overridden the physics; "
                "gpadjust.validation.trust tells where. "
            )
            warnings.warn(
                f"A step of the last real episode gave a reward of {real:.3g} on average, where "
                f"the model promised {promised:.3g}: do not trust what is done in it yet. "
                f"{blame if overrides > 0.5 else ''}More episodes, a careful objective "
                "(Return(quantile=0.2), with num_functions=16), or a better physics may help.",
                UserWarning,
                stacklevel=4,
            )

    # Real steps

    def _plans(self) -> bool:
        """Whether an episode that begins is to be planned."""
        return False

    def _plan(self, episode: PlannedEpisode, state: Tensor) -> Tensor:
        """The actions ahead, ``T x action_dim``, of an episode; random ones, unless overridden."""
        if len(episode.ahead):
            return episode.ahead
        num_steps = max(self.episode_length() - episode.steps_done, 1)
        return random_sequences(1, num_steps, self.action_bounds(), _MAX_HOLD)[0]

    def _policy_actions(
        self, learning_starts: int, action_noise: ActionNoise | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the policy would do in a real step, and as the buffer keeps it."""
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """The actions of a real step, and as the buffer keeps them; SB3 calls this."""
        actions, scaled = self._policy_actions(learning_starts, action_noise, n_envs)
        rows = zip(self.last_states(), torch.from_numpy(actions), strict=True)
        taken = [
            self.planned.act(i, state, action, self._plans, self._plan)
            for i, (state, action) in enumerate(rows)
        ]
        if not any(self.planned.is_planned(i) for i in range(n_envs)):
            return actions, scaled
        scaled = self.policy.scale_action(torch.stack(taken).numpy())
        return self.policy.unscale_action(scaled), scaled

    def action_bounds(self) -> Tensor:
        """Lower and upper bounds of the actions, ``2 x action_dim``."""
        bounds = np.stack([self.action_space.low, self.action_space.high])
        return torch.from_numpy(bounds.astype(np.float64))

    # What SB3 calls

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """As in SB3; it also notices where episodes end."""
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        for i in map(int, dones.nonzero()[0]):
            episode = self.planned.under_way.get(i)
            self.promises.append(self.promise if episode is None else episode.promise)
            self.planned.end(i)

    def environments_reset(self) -> None:
        """No plan holds any more."""
        super().environments_reset()
        self.planned.forget()

    def ready_task(self) -> Task:
        """The task, if the agent can learn with it; see :class:`TaskLearner`.

        Raises:
            TypeError: If options are of another kind.
        """
        task = super().ready_task()
        if not isinstance(self.options, self.options_class):
            name = self.options_class.__name__
            raise TypeError(f"options must be {name}(...); found {self.options!r}.")
        return task

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self.model_hooks = []  # callbacks that have some add themselves
        return super()._setup_learn(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "model_hooks"]
