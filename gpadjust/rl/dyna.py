"""Learners of Stable-Baselines3 that also train inside a dynamics model."""

from __future__ import annotations

import io
import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from gpadjust.control import Task
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.model_learner import ModelLearner
from gpadjust.rl.model_vec_env import ModelVecEnv
from gpadjust.rl.options import DynaOptions


class Dyna(ModelLearner):
    r"""What an off-policy learner needs to learn from real episodes and from those in a model.

    After each real episode it updates on what it has, as the learner does; teaches the real
    transitions to the dynamics of its task; and runs ``model_episodes`` episodes of particles in
    the model, with ``updates_per_model_step`` gradient steps for each step of each particle. Real
    and model experience lie in one :class:`MixedReplayBuffer` (Sutton 1990; Wannawas and Faisal
    2023, sec. 2.3). Model steps do not count as time steps. All else is the learner's: callbacks,
    ``VecNormalize``, schedules, ``predict``, and ``save`` and ``load``, which keep the data and
    parameters of the dynamics, but not the task: pass it to ``load``, or get an agent that can only
    predict. (Files of ``save`` are Stable-Baselines3's, which hold pickles: open those you trust.)

    An error on the way (a wrong reward, a physics that fails, a fit that does not converge) loses
    nothing: the episodes are in the buffer, and the dynamics learn them after the next one. Mend
    what is wrong, set ``agent.task`` to a task with other functions or dynamics, for example, and
    call ``learn`` again; dynamics that know nothing learn all that is in the buffer. (Where the
    environment was wrong, ``agent.replay_buffer.reset()`` forgets what it said.) Transitions at
    which the physics fails are left out of what the dynamics learn, with a warning.

    A step that did not happen is no data: environments tell of one, as where a simulator failed, by
    a true ``info["step_failed"]``.

    A learner of Stable-Baselines3 becomes one of this family as
    ``class DynaTD3(Dyna, TD3): ...``, if its ``train`` samples from ``replay_buffer``.

    Args:
        policy: As in the learner.
        env: The real environment; observations are those of the spec of the dynamics.
        task: What is known of the system; the rewards and terminations are compared with those of
            each real episode before the agent learns from it.
        options: How the model is used.
        buffer_size: Real transitions that are kept.
        learning_starts: As in the learner. Default: the untrained policy acts in the first episode.
        train_freq: As in the learner. Default: after each episode; with several environments give a
            number of steps. The model is fitted after updates at which an episode has ended.
        gradient_steps: As in the learner. Default: one for each real step.
        kwargs: Further arguments of the learner.

    Attributes:
        num_episodes: Real episodes that have ended and were learnt from.
        wall_time: Seconds spent on ``"fit"``, ``"rollout"`` and ``"update"``.
        notes: What you want to keep with the agent, in plain values; saved and resumed with it.

    Raises:
        ValueError: If there is no task, observations or actions are not boxes of the spec's
            entries, n-step returns are asked for, or a number is out of range; when learning
            starts, if the task's functions do not return what they should; after a real episode,
            if its rewards or terminations are not those of the task.
        TypeError: If task or options are of another kind.
        AssertionError: By Stable-Baselines3, if the actions are no box.
    """

    options_class = DynaOptions

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        task: Task | None = None,
        options: DynaOptions | None = None,
        *,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        train_freq: int | tuple[int, str] = (1, "episode"),
        gradient_steps: int = -1,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("n_steps", 1) != 1:
            raise ValueError(
                f"{type(self).__name__} has no n-step returns; found n_steps={kwargs['n_steps']}: "
                "model transitions do not lie in the order of a trajectory."
            )
        if gradient_steps == 0:
            raise ValueError(
                "gradient_steps must not be 0: without updates on real episodes Stable-Baselines3 "
                "does not call train(), and the model would never learn. Pass 1 or more, or -1."
            )
        buffer_class = kwargs.pop("replay_buffer_class", None) or MixedReplayBuffer
        if not issubclass(buffer_class, MixedReplayBuffer):
            raise ValueError(
                "replay_buffer_class must be MixedReplayBuffer or a subclass of it; found "
                f"{buffer_class.__name__}."
            )
        misplaced = {entry.name for entry in fields(DynaOptions)} & {*kwargs}
        if misplaced:
            name = min(misplaced)
            raise TypeError(
                f"{name} is an option of the model: pass DynaOptions({name}={kwargs[name]!r}) as "
                "options."
            )
        self.owed_updates = 0.0
        super().__init__(
            task,
            DynaOptions() if options is None else options,
            policy,
            env,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=buffer_class,
            **kwargs,
        )

    # One iteration

    def _update(self, gradient_steps: int, batch_size: int) -> None:
        """The learner's own updates, on what there is."""
        serves = self.options.uses_model(self.num_episodes)
        self.replay_buffer.mix = self.options.keep_model_data or serves
        super()._update(gradient_steps, batch_size)

    def _improve(self, num_ended: int, batch_size: int) -> None:
        """Train in the model."""
        self._train_in_model(self.options.model_episodes * num_ended, batch_size)

    def _train_in_model(self, num_episodes: int, batch_size: int) -> None:
        """Run model episodes, side by side, with updates at each step."""
        if not num_episodes:
            return
        at_once = self.options.num_particles or num_episodes
        all_returns, num_left, num_steps = [], 0, 0
        for start in range(0, num_episodes, at_once):
            env = self.model_env(min(num_episodes - start, at_once))
            noise = self._model_noise(env.num_envs)
            with self.timed("rollout"):
                if start == 0 and self.options.refresh_model_data:
                    env.refresh(self.replay_buffer.model_buffer)
                obs = env.reset()
            returns = np.zeros(env.num_envs)
            running = np.ones(env.num_envs, dtype=bool)
            while running.any():
                with self.timed("rollout"):
                    ahead = env.steps_ahead()
                    actions = self.act_in_model(obs, noise)
                    step = env.transition(actions)
                    rows = (obs, step.observations, self.policy.scale_action(actions), step.rewards)
                    ends = (step.terminated | step.truncated, step.truncated)
                    kept = (values[running] for values in (*rows, *ends))
                    self.replay_buffer.model_buffer.add_rows(*kept)
                    # Of an episode that left the bounds the rest counts as the worst that was seen.
                    lost = np.minimum(env.worst_reward * ahead, env.worst_reward)
                    returns += np.where(step.left_bounds, lost, step.rewards) * running
                    num_left += int((step.left_bounds & running).sum())
                    made = int(running.sum())
                    running &= ~ends[0]
                    obs = step.observations
                num_steps += made
                self._update_in_model(made, batch_size)
            all_returns.append(returns)
            for hook in self.model_hooks:
                hook.on_model_episodes(returns)
        self.logger.record("model/ep_rew_mean", float(np.concatenate(all_returns).mean()))
        self.logger.record("model/left_bounds", num_left)
        if num_steps == num_left == self.replay_buffer.model_buffer.size():
            warnings.warn(
                "All model episodes left the bounds of the states at once, so the agent has learnt "
                "nothing of use from the model. Check the task's initial_states, or pass "
                "state_bounds.",
                UserWarning,
                stacklevel=2,
            )

    def _update_in_model(self, num_steps: int, batch_size: int) -> None:
        """The gradient steps of so many steps in the model, and those that were left over."""
        self.owed_updates += self.options.updates_per_model_step * num_steps
        # SB3 counts the updates between two of the target networks from each call of train().
        together = getattr(self, "target_update_interval", 1)
        updates = int(self.owed_updates + 1e-9) // together * together  # ten times 0.3 are three
        self.owed_updates -= updates
        if updates:
            with self.timed("update"):
                super()._update(updates, batch_size)

    # The model

    def model_env(self, num_envs: int) -> ModelVecEnv:
        """The dynamics, as they stand, as an environment of ``num_envs`` particles.

        Raises:
            ValueError: If there are neither real episodes nor ``initial_states``, or nobody says
                how long an episode is.
        """
        task, recorded = self.model_task(), self.recorded_episodes()
        if task.initial_states is None:
            raise ValueError(
                "There are no real episodes yet that particles could start from; give the task "
                "initial_states, or call learn() first."
            )
        return ModelVecEnv(
            task,
            num_envs,
            self.observation_space,
            self.action_space,
            sampling=self.options.sampling,
            worst_reward=float(recorded.rewards.min()) if recorded.num_transitions else np.inf,
        )

    def act_in_model(
        self, observations: np.ndarray, noise: ActionNoise | None = None
    ) -> np.ndarray:
        """Sample the policy's actions at observations of model episodes, which are not normalised.

        Args:
            observations: ``N x observation_dim``.
            noise: Added to the actions, in their scale of [-1, 1]. Default: none.
        """
        self.policy.set_training_mode(False)
        normalizer = self._vec_normalize_env
        seen = observations if normalizer is None else normalizer.normalize_obs(observations)
        actions = self.predict(seen, deterministic=False)[0]
        if noise is None:
            return actions
        scaled = np.clip(self.policy.scale_action(actions) + noise(), -1, 1)
        return self.policy.unscale_action(scaled).astype(actions.dtype)

    def _model_noise(self, num_envs: int) -> ActionNoise | None:
        """Action noise as the real steps have it, begun anew for each particle."""
        noise = self.action_noise
        if noise is None:
            return None
        base = noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise
        vectorised = VectorizedActionNoise(base, num_envs)
        vectorised.reset()
        return vectorised

    def _setup_model(self) -> None:
        self.replay_buffer_kwargs |= {
            "real_fraction": self.options.real_fraction,
            "model_buffer_size": self.options.model_buffer_size,
        }
        super()._setup_model()

    def load_replay_buffer(
        self, path: str | Path | io.BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """As in SB3, for both buffers; the file is a pickle: open only one that you trust."""
        super().load_replay_buffer(path, truncate_last_traj)
        self.replay_buffer.model_buffer.device = self.device
