"""Learners of Stable-Baselines3 that also train inside a dynamics model."""

from __future__ import annotations

import io
import json
import warnings
from copy import deepcopy
from dataclasses import fields
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import (
    GymEnv,
    RolloutReturn,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gpadjust.checks import check_kind
from gpadjust.control import EpisodeCheckpoint, Task
from gpadjust.control.agent import TaskAgent
from gpadjust.control.checkpoint import locked
from gpadjust.control.episodes import check_functions, learn_dynamics
from gpadjust.control.faults import check_observation
from gpadjust.dynamics import Trajectories
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.callbacks import AgentCallback, DynaCallback
from gpadjust.rl.environments import environment_state, guarded, restore_environment
from gpadjust.rl.model_vec_env import ModelVecEnv
from gpadjust.rl.options import DynaOptions


class Dyna(TaskAgent, OffPolicyAlgorithm):
    r"""A base for off-policy learners, which then train on real episodes and in a model.

    After each real episode it updates on what it has, as the learner does; teaches the real
    transitions to the dynamics of its task; and runs ``model_episodes`` episodes of particles in
    the model, with ``updates_per_model_step`` gradient steps for each step of each particle. Real
    and model experience lie in one :class:`MixedReplayBuffer` (Sutton 1990; Wannawas and Faisal
    2023, sec. 2.3). Model steps do not count as time steps. All else is the learner's: callbacks,
    ``VecNormalize``, schedules, ``predict``, and ``save`` and ``load``, which keep the data and
    parameters of the dynamics, but not the task: pass it to ``load``, or get an agent that can only
    predict. (Files of ``save`` are Stable-Baselines3's, which hold pickles: open those you trust.)

    An error on the way loses nothing, and steps that fail are no data, as of
    :class:`gpadjust.control.Agent`: mend what is wrong, set ``agent.task``, for example, and call
    ``learn`` again. Dynamics that know nothing learn all that is in the buffer. (Where the
    environment was wrong, ``agent.replay_buffer.reset()`` forgets what it said.)

    A learner of Stable-Baselines3 becomes one of this family as
    ``class DynaTD3(Dyna, TD3): ...``, if it is off-policy and its ``train`` samples from
    ``replay_buffer``. Other bases are a TypeError where the class is defined.

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
        task: The task; to change a part of it, set another one.
        wall_time: Seconds spent on ``"fit"``, ``"rollout"`` and ``"update"``.
        notes: As of :class:`gpadjust.control.Agent`.

    Raises:
        ValueError: As :class:`gpadjust.control.Agent`, and if there is no task, or n-step returns
            are asked for.
        TypeError: If task or options are of another kind.
        AssertionError: By Stable-Baselines3, if the actions are no box.
    """

    replay_buffer: MixedReplayBuffer
    observation_space: spaces.Box
    action_space: spaces.Box

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
        self.task = task
        self.options: Any = DynaOptions() if options is None else options
        self.num_episodes = 0
        self.owed_updates = 0.0  # of steps in the model
        self.wall_time = dict.fromkeys(("fit", "rollout", "update"), 0.0)
        self.notes: dict[str, Any] = {}
        self.model_hooks: list[DynaCallback] = []
        self.learnt_before: dict[str, Any] = {}  # of a file, as long as there is no task
        if kwargs.get("_init_setup_model", True):
            self.ready_task()
        super().__init__(
            policy,
            env,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=buffer_class,
            **kwargs,
        )

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse a class that is made of other bases than Dyna and an off-policy learner."""
        super().__init_subclass__(**options)
        lines = cls.__mro__
        for base in lines:
            if not issubclass(base, BaseAlgorithm) or issubclass(OffPolicyAlgorithm, base):
                continue
            if not issubclass(base, OffPolicyAlgorithm):
                raise TypeError(
                    f"{cls.__name__} needs an off-policy learner, such as SAC, beside Dyna; found "
                    f"{base.__name__}, which can learn in a ModelVecEnv of fitted dynamics."
                )
            if not issubclass(base, Dyna) and lines.index(base) < lines.index(Dyna):
                raise TypeError(
                    f"Dyna comes first among the bases of {cls.__name__}; found {base.__name__} "
                    f"before it. Write class {cls.__name__}(Dyna, {base.__name__})."
                )

    # One iteration

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update on what there is, learn the model, train in it; SB3 calls this."""
        if not self.replay_buffer.size():
            return  # all steps failed
        serves = self.options.uses_model(self.num_episodes)
        new, num_ended = self._new_episodes()
        if serves and new is not None and self.options.reward_tolerance is not None:
            check_functions(self.ready_task(), new, self.options.reward_tolerance)
        self.replay_buffer.mix = serves
        with self.timed("update"):
            super().train(gradient_steps, batch_size)
        if new is None:
            return
        metrics: dict[str, float] = {}
        if serves:
            with self.timed("fit"):
                known = (self.recorded_episodes(), self.options.score_horizons)
                metrics = learn_dynamics(self.model_task(), new, *known)
        assert new.rewards is not None, "of real episodes"
        for name, value in {**metrics, "real_reward": float(new.rewards.mean())}.items():
            self.logger.record(f"model/{name}", value)
        self.replay_buffer.learnt |= self.replay_buffer.whole
        self.num_episodes += num_ended
        if serves:
            for hook in self.model_hooks:
                hook.on_model_fit(metrics)
            self._train_in_model(self.options.model_episodes * num_ended, batch_size)
            total = sum(self.wall_time.values())
            for name, seconds in self.wall_time.items():
                self.logger.record(f"model/share_{name}", seconds / total)

    def _new_episodes(self) -> tuple[Trajectories | None, int]:
        """The real steps that the dynamics have not learnt, if an episode has ended; how many."""
        buffer, dynamics = self.replay_buffer, self.ready_task().dynamics
        num_ended = int((buffer.dones.astype(bool) & ~buffer.failed & ~buffer.learnt).sum())
        if not num_ended:
            return None, 0
        new = self._recorded(~buffer.learnt if dynamics.has_learnt else None)
        least = 1 if dynamics.is_fitted else 2  # a first fit needs two
        return (new if len(new) >= least else None), num_ended

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
                super().train(updates, batch_size)

    # Real episodes

    def learn(self, total_timesteps: int, callback: Any = None, *args: Any, **kwargs: Any) -> Self:
        """Learn; callbacks may be, or hold, an ``EpisodeCheckpoint`` and ``print_progress``."""
        several = isinstance(callback, list | CallbackList)
        given = getattr(callback, "callbacks", callback) if several else [callback]
        checkpoints = [each for each in given if isinstance(each, EpisodeCheckpoint)]
        if checkpoints and self.use_sde:
            raise ValueError(
                "EpisodeCheckpoint cannot resume generalised state-dependent exploration exactly; "
                f"use {type(self).__name__} with use_sde=False."
            )
        known = [AgentCallback.around(each) for each in given]
        with locked(checkpoints):
            return super().learn(total_timesteps, known if several else known[0], *args, **kwargs)

    def predict(
        self, observation: Any, *args: Any, **kwargs: Any
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Choose actions as the learner does; refuse an observation that cannot be data.

        Raises:
            ValueError: If a number of it is not finite, or larger than 1e25.
        """
        check_observation(observation)
        return super().predict(observation, *args, **kwargs)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """Collect; if it ends within an episode, the next `learn` resets the environments."""
        try:
            result = super().collect_rollouts(*args, **kwargs)
        except BaseException:
            self._last_obs = None
            raise
        if not result.continue_training:  # a callback stopped it at a step, which SB3 did not store
            self._last_obs = None
        return result

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        *args: Any,
    ) -> tuple[int, BaseCallback]:
        """Refuse to spend a real episode on an agent that could not learn from it."""
        self.ready_task()
        if self.env is None:
            raise ValueError(
                f"There is no environment to learn in; pass env to {type(self).__name__}.load, or "
                "use set_env()."
            )
        assert isinstance(self.train_freq, TrainFreq), "converted when the agent was made"
        if self.n_envs > 1 and self.train_freq.unit is TrainFrequencyUnit.EPISODE:
            raise ValueError(
                f"With {self.n_envs} environments Stable-Baselines3 cannot train by episodes; pass "
                f"a number of steps as train_freq, such as ({self.episode_length()}, 'step')."
            )
        if self.replay_buffer.buffer_size < self.episode_length():
            raise ValueError(
                f"buffer_size must hold an episode of {self.episode_length()} steps, for the "
                "dynamics to learn it; found room for "
                f"{self.replay_buffer.buffer_size} of each environment."
            )
        if reset_num_timesteps or self._last_obs is None:  # SB3 ends the episodes under way
            self.replay_buffer.end_episodes(np.ones(self.n_envs, dtype=bool))
        self._remember()
        self.model_hooks = []  # callbacks that have some add themselves
        noise = deepcopy(self.action_noise)  # which SB3 resets
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args)
        seen = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        assert isinstance(seen, np.ndarray), "observations are boxes"
        self.try_task(seen, self.action_space)
        if self._random_state is not None:  # a run that goes on
            self._random_state.restore()
            self._random_state, self.action_noise = None, noise
        return result

    def ready_task(self) -> Task:
        """The task, if the agent can learn with it.

        Raises:
            ValueError: If it is missing, or has constraints or an action rate.
            TypeError: If task or options are of another kind.
        """
        name = type(self).__name__
        if self.task is None:
            raise ValueError(
                f"{name} needs a task to learn; found None. Pass task=Task(dynamics, reward, ...) "
                f"to {name} or, as it is not saved, to {name}.load. Without it the agent can only "
                "predict."
            )
        check_kind("task", self.task, Task, "a Task(dynamics, reward, ...)")
        check_kind("options", self.options, DynaOptions, "DynaOptions(...)")
        for part in ("constraints", "action_rate"):
            self.task.refuse(name, part, "MPCAgent can")
        return self.task

    def recorded_episodes(self, newest: int | None = None) -> Trajectories:
        """Return the real steps in the buffer of episodes that have ended; or the newest ones."""
        data = self._recorded()
        return data if newest is None else data.some(slice(max(len(data) - newest, 0), None))

    def _recorded(self, keep: np.ndarray | None = None) -> Trajectories:
        spec = self.ready_task().dynamics.spec
        return self.replay_buffer.recorded(spec, self.policy.unscale_action, keep)

    def env_attribute(self, name: str) -> Any:
        """An attribute of the first environment; None without one."""
        return None if self.env is None else self.env.get_attr(name)[0]

    # The model

    def action_bounds(self) -> Tensor:
        """Lower and upper bounds of the actions, ``2 x action_dim``."""
        space = self.action_space
        return torch.from_numpy(np.stack([space.low, space.high]).astype(np.float64))

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
            worst_reward=float(min(recorded.rewards, default=np.inf)),
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
        """Action noise as the real steps have it, begun again for each particle."""
        if self.action_noise is None:
            return None
        base = getattr(self.action_noise, "base_noise", self.action_noise)  # of a vectorised one
        vectorised = VectorizedActionNoise(base, num_envs)
        vectorised.reset()
        return vectorised

    def _setup_model(self) -> None:
        if self.task is not None:
            way_out = "MPCAgent and PolicySearchAgent can"
            self.task.refuse(type(self).__name__, "sensors", way_out)
            self.task.check_spaces(self.observation_space, self.action_space)
        names = ("real_fraction", "model_buffer_size")
        self.replay_buffer_kwargs |= {name: getattr(self.options, name) for name in names}
        super()._setup_model()

    # Saving

    def save(self, *args: Any, **kwargs: Any) -> None:
        """Save as Stable-Baselines3 does, with what the dynamics have learnt."""
        if self.task is not None and not self.learnt_before:
            self.learnt_before = self.task.dynamics.state_dict()
            try:
                super().save(*args, **kwargs)
            finally:
                self.learnt_before = {}
        else:  # of an agent that was loaded without a task
            super().save(*args, **kwargs)

    @classmethod
    def load(cls, *args: Any, **kwargs: Any) -> Self:
        """Load as Stable-Baselines3 does; the dynamics of a ``task`` learn what they had learnt.

        Raises:
            RuntimeError: If these were other dynamics, or another physics.
        """
        agent: Self = super().load(*args, **kwargs)
        agent._remember()
        return agent

    def _remember(self) -> None:
        """Let the dynamics of the task take what those of a file had learnt."""
        if self.task is not None and self.learnt_before:
            self.task.dynamics.load_state_dict(self.learnt_before)
            self.learnt_before = {}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "task", "model_hooks", "_random_state"]

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """Load both buffers; the file is a pickle: open only one that you trust."""
        super().load_replay_buffer(path, truncate_last_traj)
        self.replay_buffer.model_buffer.device = self.device

    # Checkpoints

    @classmethod
    def wrapped(cls, env: GymEnv) -> VecEnv:
        """The user's environment in the wrappers of Stable-Baselines3."""
        return cls._wrap_env(env)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return guarded(OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper))

    @classmethod
    def described(cls, env: VecEnv) -> dict[str, Any]:
        """Number, wrappers and spaces of the environments."""
        return {**super().described(env), "num_envs": env.num_envs}

    def saved_parts(self) -> dict[str, bytes]:
        """SB3's file of the agent, both buffers, and the environments."""
        agent, buffers = io.BytesIO(), io.BytesIO()
        self.save(agent)
        self.save_replay_buffer(buffers)
        return {
            "agent.zip": agent.getvalue(),
            "buffers.pkl": buffers.getvalue(),
            "action_space.json": json.dumps(self._action_generator.state).encode(),
            "environment.pkl": environment_state(self.env),
        }

    @classmethod
    def from_parts(cls, parts: dict[str, bytes], env: VecEnv, task: Task) -> Self:
        """The agent that :meth:`saved_parts` saved."""
        agent = cls.load(io.BytesIO(parts["agent.zip"]), env=env, task=task, force_reset=False)
        agent.load_replay_buffer(io.BytesIO(parts["buffers.pkl"]), truncate_last_traj=False)
        agent._action_generator.state = json.loads(parts["action_space.json"])
        if not restore_environment(env, parts["environment.pkl"]):
            agent._last_obs = None  # the environment is reset
        return agent

    @property
    def _action_generator(self) -> Any:
        """The generator of the first actions, with ``learning_starts``."""
        return self.action_space.np_random.bit_generator


class DynaSAC(Dyna, SAC):
    """Soft actor-critic that also trains inside a dynamics model, see :class:`Dyna`.

    One whose model never serves (``DynaOptions(last_model_episode=0)``) is Stable-Baselines3's
    ``SAC``, bit for bit.

    Example:
        >>> from gpadjust.rl import DynaOptions, DynaSAC
        >>> from gpadjust.systems import cart_pole
        >>> system, options = cart_pole(), DynaOptions(model_episodes=2)
        >>> agent = DynaSAC("MlpPolicy", system.make(), system.task(), options, seed=0)
        >>> agent.learn(total_timesteps=25).num_episodes
        1
    """


class DynaTD3(Dyna, TD3):
    """TD3 that also trains inside a dynamics model, see :class:`Dyna`.

    Its policy is deterministic: pass ``action_noise``, without which it explores neither the real
    system nor the model. Particles have noise of their own.

    Example:
        >>> import numpy as np
        >>> from stable_baselines3.common.noise import NormalActionNoise
        >>> from gpadjust.rl import DynaOptions, DynaTD3
        >>> from gpadjust.systems import cart_pole
        >>> system, options = cart_pole(), DynaOptions(model_episodes=2)
        >>> noise = {"action_noise": NormalActionNoise(np.zeros(1), 0.2 * np.ones(1)), "seed": 0}
        >>> agent = DynaTD3("MlpPolicy", system.make(), system.task(), options, **noise)
        >>> agent.learn(total_timesteps=25).num_episodes
        1
    """
