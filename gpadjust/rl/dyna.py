"""Learners of Stable-Baselines3 that also train inside a dynamics model."""

from __future__ import annotations

import inspect
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, ClassVar, Self

import cloudpickle
import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    unwrap_vec_normalize,
)

from gpadjust.checks import check_kind
from gpadjust.control import EpisodeCheckpoint, StepGuard, Task
from gpadjust.control import episodes as real
from gpadjust.control.checkpoint import pickled_environment
from gpadjust.control.learning import check_functions, learn_dynamics, locks_of
from gpadjust.control.summary import agent_table, agent_text
from gpadjust.display import Display
from gpadjust.dynamics import Trajectories
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.model_vec_env import ModelVecEnv
from gpadjust.rl.options import DynaOptions


class AgentCallback(BaseCallback):
    """Calls a callback of :class:`gpadjust.control.Agent` at the corresponding events of Dyna.

    A trial is a rollout of Stable-Baselines3 in which an episode ends.
    """

    model: Any

    def __init__(self, callback: Any) -> None:
        super().__init__()
        self.callback = callback
        self._start_time = 0.0
        self._steps_before = 0

    @staticmethod
    def around(callback: Any) -> Any:
        """Return a callback of agents, a function of three values, as one of SB3."""
        if isinstance(callback, BaseCallback) or not callable(callback):
            return callback
        try:
            inspect.signature(callback).bind("agent", "event", "values")
        except (TypeError, ValueError):  # a function of SB3, of locals and globals
            return callback
        return AgentCallback(callback)

    def _init_callback(self) -> None:
        self.model.fit_callbacks.append(self.callback)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # The updates of the last episode are done, and the next has not begun.
        self.callback(self.model, "episode", {})
        self._start_time = time.perf_counter()
        self._steps_before = len(self.model.replay_buffer.episodes)

    def _on_rollout_end(self) -> None:
        new = self.model.replay_buffer.episodes.subset(slice(self._steps_before, None))
        # A checkpoint saves at the start of the next rollout, after the updates of the learner.
        if len(new) and not isinstance(self.callback, EpisodeCheckpoint):
            values: dict[str, float] = {"number": self.model.num_episodes + 1, "steps": len(new)}
            values["reward"] = float(new.rewards.mean())
            values["seconds"] = time.perf_counter() - self._start_time
            self.callback(self.model, "trial", values)

    def _on_training_end(self) -> None:
        # Another callback may have stopped the run within an episode.
        if self.model.num_timesteps >= self.model._total_timesteps:
            self.callback(self.model, "done", {})


class Dyna(OffPolicyAlgorithm, Display):
    r"""A base for off-policy learners, which then train on real episodes and in a model.

    After each real episode, the agent updates on all experience, as the learner does; updates the
    dynamics of its task by the real transitions; and runs ``model_episodes`` episodes of particles
    in the model, with ``updates_per_model_step`` gradient steps for each step of each particle.
    Real and model experience are in one :class:`MixedReplayBuffer` (Sutton 1990; Wannawas and
    Faisal 2023, sec. 2.3). Model steps do not count as time steps. Everything else belongs to the
    learner: callbacks, ``VecNormalize``, schedules, ``predict``, and ``save`` and ``load``, which
    save the learner alone; an :class:`~gpadjust.control.EpisodeCheckpoint` saves a run. After
    errors and failed steps the experience remains, as in :class:`gpadjust.control.Agent`; after
    wrong data of an environment, call ``agent.replay_buffer.reset()``.

    Any off-policy learner of Stable-Baselines3 whose ``train`` samples from ``replay_buffer`` can
    be a base, as in ``class DynaTD3(Dyna, TD3): ...``.

    Args:
        policy: As in the learner.
        env: The real environment; its observations follow the spec of the dynamics.
        task: The task; to change a part of it, set another one.
        options: Options of the model.
        buffer_size: Number of real transitions in the buffer.
        learning_starts: As in the learner. Default: the untrained policy acts in the first episode.
        train_freq: As in the learner. Default: after each episode; with several environments give a
            number of steps. The model is fitted after updates at which an episode has ended.
        gradient_steps: As in the learner. Default: one for each real step.
        kwargs: Further arguments of the learner.

    Attributes:
        num_episodes: Number of real episodes that have ended and were used.
        wall_time: Seconds spent on ``"fit"``, ``"rollout"`` and ``"update"``.
        notes: As of :class:`gpadjust.control.Agent`.

    Raises:
        ValueError: As :class:`gpadjust.control.Agent`, and if there is no task, or ``n_steps`` is
            not 1.
        TypeError: If task, options or the bases of a subclass have another type.
    """

    not_saved: ClassVar[tuple[str, ...]] = (
        *("env", "task", "fit_callbacks", "_random_state"),
        *("_vec_normalize_env", "_logger", "_custom_logger"),
    )
    replay_buffer: MixedReplayBuffer
    observation_space: spaces.Box
    action_space: spaces.Box
    _custom_logger = False
    _random_state: Any = None  # of a resumed run, until `learn`

    def __init_subclass__(cls, **options: Any) -> None:
        """Check that the bases are Dyna, then an off-policy learner."""
        super().__init_subclass__(**options)
        # Dyna must override methods of the learner.
        mro = cls.__mro__
        for base in mro[: mro.index(BaseAlgorithm)]:
            is_off_policy = issubclass(base, OffPolicyAlgorithm)
            is_before = mro.index(base) < mro.index(Dyna) and not issubclass(base, Dyna)
            if issubclass(base, BaseAlgorithm) and (is_before or not is_off_policy):
                raise TypeError(
                    f"{cls.__name__} needs Dyna first among its bases, then an off-policy learner, "
                    f"as in class {cls.__name__}(Dyna, SAC); found {base.__name__}."
                )

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
            raise ValueError(f"Dyna has no n-step returns; found n_steps={kwargs['n_steps']}.")
        if gradient_steps == 0:
            raise ValueError(
                "gradient_steps must be 1 or more, or -1, as the model is fitted after them."
            )
        self.task: Any = task
        self.options = DynaOptions() if options is None else options
        self.num_episodes = 0
        self.owed_updates = 0.0  # fraction of an update, of earlier steps in the model
        self.wall_time = dict.fromkeys(("fit", "rollout", "update"), 0.0)
        self.notes: dict[str, Any] = {}
        self.fit_callbacks: list[Any] = []  # of agents
        if kwargs.get("_init_setup_model", True):  # `load` sets the task afterwards
            self._check_task()
        super().__init__(
            policy,
            env,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            replay_buffer_class=MixedReplayBuffer,
            **kwargs,
        )

    def _setup_model(self) -> None:
        if self.task is not None:
            self.task.check_spaces(self.observation_space, self.action_space)
        self.replay_buffer_kwargs |= {"real_fraction": self.options.real_fraction}
        super()._setup_model()

    def _check_task(self) -> None:
        """Raise an error if task or options are missing or not supported."""
        name = type(self).__name__
        if self.task is None:
            raise ValueError(
                f"{name} needs a task to learn; found None. Pass task=Task(dynamics, reward, ...) "
                f"to {name}, or to {name}.load, as `save` does not save it."
            )
        check_kind("task", self.task, Task, "a Task(dynamics, reward, ...)")
        check_kind("options", self.options, DynaOptions, "DynaOptions(...)")
        for part in ("constraints", "action_rate", "sensors"):
            self.task.refuse(name, part, "MPCAgent can")

    # One iteration

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update on all experience, update the dynamics, train in them; SB3 calls this."""
        buffer, options, dynamics = self.replay_buffer, self.options, self.task.dynamics
        if not buffer.size():
            return  # all steps failed
        last = options.last_model_episode
        uses_model = last is None or self.num_episodes < last
        # New real episodes; the first update of the dynamics has all of them.
        recorded = self.recorded_episodes()
        new = recorded.subset(slice(buffer.num_learnt, None))
        data = new if dynamics.has_learnt else recorded
        is_enough = len(new) and (len(data) > 1 or dynamics.is_fitted)  # two rows have a scale
        if is_enough and uses_model and options.reward_tolerance is not None:
            check_functions(self.task, data, options.reward_tolerance)
        # Update on real transitions, and on transitions of earlier models.
        buffer.mix = uses_model
        with _timed(self.wall_time, "update"):
            super().train(gradient_steps, batch_size)
        if not is_enough:
            return
        # Update the dynamics by the new episodes.
        metrics: dict[str, float] = {}
        if uses_model:
            with _timed(self.wall_time, "fit"):
                horizons = options.score_horizons
                metrics = learn_dynamics(self.model_task(), data, recorded, horizons)
        buffer.num_learnt = len(recorded)
        num_ended = int((new.steps == 1).sum())
        self.num_episodes += num_ended
        for name, value in {**metrics, "real_reward": float(new.rewards.mean())}.items():
            self.logger.record(f"model/{name}", value)
        if not uses_model:
            return
        for callback in self.fit_callbacks:
            callback(self, "fit", metrics)
        # Train in the newest model.
        self._train_in_model(options.model_episodes * num_ended, batch_size)
        total = sum(self.wall_time.values())
        for name, seconds in self.wall_time.items():
            self.logger.record(f"model/share_{name}", seconds / total)

    def _train_in_model(self, num_episodes: int, batch_size: int) -> None:
        """Run parallel model episodes, with updates at each step."""
        if not num_episodes:
            return
        at_once = self.options.num_particles or num_episodes
        # SB3 counts updates between two target updates from each call of train(): call it with
        # multiples of this interval.
        interval = getattr(self, "target_update_interval", 1)
        all_returns: list[np.ndarray] = []
        num_left, num_steps = 0, 0
        for start in range(0, num_episodes, at_once):
            env = self.model_env(min(num_episodes - start, at_once))
            noise = self._model_noise(env.num_envs)
            with _timed(self.wall_time, "rollout"):
                if start == 0 and self.options.refresh_model_data:
                    env.refresh(self.replay_buffer.model_buffer)
                obs = env.reset()
            returns = np.zeros(env.num_envs)
            running = np.ones(env.num_envs, dtype=bool)
            while running.any():
                with _timed(self.wall_time, "rollout"):
                    # One step of the particles whose episode has not ended, into the buffer.
                    ahead = env.steps_ahead
                    actions = self._act_in_model(obs, noise)
                    step = env.transition(actions)
                    done = step.terminated | step.truncated
                    columns = (
                        obs,
                        step.observations,
                        self.policy.scale_action(actions),
                        step.rewards,
                        done,
                        step.truncated,
                    )
                    self.replay_buffer.add_model_rows(*(column[running] for column in columns))
                    # A particle outside of the bounds gets the worst reward for all further steps.
                    lost = np.minimum(env.worst_reward * ahead, env.worst_reward)
                    returns += np.where(step.left_bounds, lost, step.rewards) * running
                    num_left += int((step.left_bounds & running).sum())
                    num_steps += int(running.sum())
                    self.owed_updates += self.options.updates_per_model_step * int(running.sum())
                    running &= ~done
                    obs = step.observations
                # Despite rounding, 10 * 0.3 are 3 updates.
                updates = int(self.owed_updates + 1e-9) // interval * interval
                self.owed_updates -= updates
                if updates:
                    with _timed(self.wall_time, "update"):
                        super().train(updates, batch_size)
            all_returns.append(returns)
        self.logger.record("model/ep_rew_mean", float(np.concatenate(all_returns).mean()))
        self.logger.record("model/left_bounds", num_left)
        if num_steps == num_left == self.replay_buffer.model_buffer.size():
            warnings.warn(
                "All model episodes left the bounds of the states in the first step, so that the "
                "agent cannot learn from them. Check the task's initial_states, or pass "
                "state_bounds.",
                UserWarning,
                stacklevel=2,
            )

    def _act_in_model(self, observations: np.ndarray, noise: ActionNoise | None) -> np.ndarray:
        """Sample the policy's actions at observations ``N x observation_dim``, not normalised."""
        self.policy.set_training_mode(False)
        inputs: Any = observations
        if self._vec_normalize_env is not None:
            inputs = self._vec_normalize_env.normalize_obs(observations)
        actions = self.predict(inputs, deterministic=False)[0]
        if noise is None:
            return actions
        # SB3 adds noise to actions in [-1, 1].
        scaled = np.clip(self.policy.scale_action(actions) + noise(), -1, 1)
        return self.policy.unscale_action(scaled).astype(actions.dtype)

    def _model_noise(self, num_envs: int) -> ActionNoise | None:
        """Return the action noise of the real steps, started again for each particle."""
        if self.action_noise is None:
            return None
        # SB3 vectorises noise for several environments.
        base = getattr(self.action_noise, "base_noise", self.action_noise)
        noise = VectorizedActionNoise(base, num_envs)
        noise.reset()
        return noise

    # Model and data

    def model_env(self, num_envs: int) -> ModelVecEnv:
        """Return the present dynamics as an environment of ``num_envs`` particles."""
        rewards = self.replay_buffer.episodes.rewards
        return ModelVecEnv(
            self.model_task(),
            num_envs,
            self.observation_space,
            self.action_space,
            sampling=self.options.sampling,
            worst_reward=float(min(rewards, default=np.inf)),
        )

    def model_task(self) -> Task:
        """Return the task, with missing length, starts and bounds by environment and episodes."""
        return real.completed(self.task, self.recorded_episodes(), self.env)

    def recorded_episodes(self, newest: int | None = None) -> Trajectories:
        """Return the real steps of episodes that have ended, or only the newest steps."""
        data = real.decoded(self.task.dynamics.spec, self.replay_buffer.episodes)
        return real.newest(data, newest)

    def __repr__(self) -> str:
        """Return a text on the agent, its environment, dynamics, progress and last reward."""
        return agent_text(self)

    def _repr_html_(self) -> str:
        return agent_table(self)

    # The loop of Stable-Baselines3

    def learn(self, total_timesteps: int, callback: Any = None, *args: Any, **kwargs: Any) -> Self:
        """Learn; callbacks may include those of an ``Agent``, functions of three values."""
        callbacks = callback if isinstance(callback, list) else [callback]
        if isinstance(callback, CallbackList):
            callbacks = callback.callbacks
        if self.use_sde and any(isinstance(part, EpisodeCheckpoint) for part in callbacks):
            # SB3 draws noise before it calls callbacks, and again after resume.
            raise ValueError("EpisodeCheckpoint cannot resume use_sde=True exactly; use False.")
        adapted: Any = [AgentCallback.around(part) for part in callbacks]
        if len(adapted) == 1:
            adapted = adapted[0]
        with locks_of(callbacks):
            return super().learn(total_timesteps, adapted, *args, **kwargs)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        *args: Any,
    ) -> tuple[int, BaseCallback]:
        """Check task and functions before the first real step."""
        self._check_task()
        if reset_num_timesteps or self._last_obs is None:  # SB3 ends the episodes under way
            self.replay_buffer.end_episodes()
        self.fit_callbacks = []  # callbacks of agents add themselves
        noise = deepcopy(self.action_noise)  # SB3 resets it
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args)
        observations: Any = self._last_obs
        if self._vec_normalize_env is not None:
            observations = self._last_original_obs
        real.try_task(self.task, observations, self.env)
        if self._random_state is not None:  # a resumed run continues its random numbers
            real.set_generators(self._random_state)
            self._random_state = None
            self.action_noise = noise
        return result

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """Collect real steps; if they stop within an episode, `learn` resets the environments."""
        try:
            result = super().collect_rollouts(*args, **kwargs)
        except BaseException:
            self._last_obs = None
            raise
        if not result.continue_training:  # a callback stopped it at a step that SB3 did not store
            self._last_obs = None
        return result

    def predict(
        self, observation: Any, *args: Any, **kwargs: Any
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions of the learner; raise a ValueError for an invalid observation."""
        real.check_observation(observation)
        return super().predict(observation, *args, **kwargs)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        inner = _layers(wrapped)[-1]
        if isinstance(inner, DummyVecEnv):
            inner.envs = [StepGuard.around(single) for single in inner.envs]
        return wrapped

    # Checkpoints

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "task", "fit_callbacks", "_random_state"]

    @classmethod
    def wrapped(cls, env: GymEnv) -> VecEnv:
        """Return the user's environment in the wrappers of Stable-Baselines3."""
        return cls._wrap_env(env)

    def environment_state(self) -> Any:
        """Return the states of the wrappers, and the environments if they can be pickled."""
        *wrappers, inner = _layers(self.env)
        content = inner
        if isinstance(inner, DummyVecEnv):  # others have processes, which cannot be pickled
            content = _state(inner), inner.envs
        return [_state(layer) for layer in wrappers], pickled_environment(content)

    def go_on(self, env: VecEnv, task: Task, environment: Any) -> None:
        """Set environment and task, after the attributes of a checkpoint."""
        self.env, self.task = env, task
        self.fit_callbacks = []
        self._vec_normalize_env = unwrap_vec_normalize(env)
        *wrappers, inner = _layers(env)
        for layer, state in zip(wrappers, environment[0], strict=True):
            vars(layer).update(state)
        if environment[1] is None:
            self._last_obs = None  # `learn` resets the environments
        else:
            state, envs = cloudpickle.loads(environment[1])
            vars(inner).update(state, envs=envs)


@contextmanager
def _timed(wall_time: dict[str, float], part: str) -> Iterator[None]:
    """Add the seconds of a block to a part."""
    start = time.perf_counter()
    try:
        yield
    finally:
        wall_time[part] += time.perf_counter() - start


_OF_ALL = ("venv", "envs", "class_attributes", "observation_space", "action_space", "metadata")


def _state(layer: VecEnv) -> dict[str, Any]:
    """Return the attributes of a layer, without those that every layer makes itself."""
    return {name: value for name, value in vars(layer).items() if name not in _OF_ALL}


def _layers(env: Any) -> list[Any]:
    """Return a vectorised environment and those inside of it, from the outside."""
    layers = [env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers


class DynaSAC(Dyna, SAC):
    """Soft actor-critic that also trains inside a dynamics model, see :class:`Dyna`.

    Without its model (``DynaOptions(last_model_episode=0)``) it is Stable-Baselines3's ``SAC``,
    bit for bit.

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

    Its policy is deterministic: pass ``action_noise``, to explore the real system and the model.
    Each particle has its own noise.

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
