"""Agents: controllers that play real episodes, learn from them, and improve."""

from __future__ import annotations

import random
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import cloudpickle
import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_number, checked_whole
from gpadjust.control import episodes
from gpadjust.control.checkpoint import EpisodeCheckpoint, locked, pickled_environment
from gpadjust.control.rollouts import random_sequences
from gpadjust.control.state_filter import StateFilter, smooth_episodes
from gpadjust.control.step_guard import StepGuard
from gpadjust.control.task import Task
from gpadjust.display import Display
from gpadjust.dynamics import Trajectories
from gpadjust.dynamics.base import checked_horizons
from gpadjust.progress import long_work, tick

MAX_HOLD = 5  # steps of a random action
_LOST = 0.1  # of runs in the model, which may leave the bounds without a warning

Callback = Callable[["Agent", str, dict[str, float]], Any]
"""What is called with the agent, the name of an event, and its numbers; see :class:`Agent`."""


class Agent(ABC, Display):
    """A controller that learns from real episodes: :meth:`learn` plays, learns and improves.

    A subclass says how it acts (:meth:`predict`) and what it improves in a model (:meth:`improve`).
    Before there are data, the model is the physics; without one, or with several, the first
    episode's actions are random.

    An error on the way (a wrong reward, a physics that fails, one of your own to end a run early)
    loses nothing: the episodes are kept, and the next ``learn`` begins with them. Mend what
    is wrong, set ``agent.task`` to a task with other functions, for example, and call ``learn``
    again; dynamics that know nothing learn all episodes. Transitions at which the physics fails are
    not learnt, with a warning. A step that fails is not kept and ends its episode, see
    :class:`StepGuard`.

    Callbacks are called with the agent, the name of an event, and a dictionary of numbers:

    - ``"episode"``: an episode begins;
    - ``"plan"``: its first action is chosen, in ``seconds``, with the agent's :meth:`promise`;
    - ``"step"``: a real step was made, with its ``reward``;
    - ``"trial"``: the episode has ended: its ``number`` (from 1), ``steps``, ``seconds``, the
      ``reward`` of a step, and the ``promised_reward``;
    - ``"fit"``: the dynamics have learnt, with scores of the new steps before that (``nlpd``,
      ``coverage``, ``rmse/x``, ``coverage_15``, ...), ``real_reward`` and ``promised_reward``;
    - ``"update"``, ``"search"``: as a subclass has them;
    - ``"done"``: all steps are made.

    Args:
        env: The real environment, of Gymnasium, with boxes of observations and actions as in the
            spec of the dynamics; the attribute has a :class:`StepGuard` around.
        task: What is known of the system.
        action_noise: Called at each step for what is added to the action, ``action_dim`` numbers in
            halves of its range, such as Stable-Baselines3's ``NormalActionNoise``.
        random_steps: Episodes that begin before so many real steps have random actions, held for
            up to five steps. Default: the first one is that of the physics.
        reward_tolerance: How far the known rewards may be from the real ones, relative to the
            largest of an episode; None to check neither rewards nor terminations.
        score_horizons: Numbers of steps over which each new episode is predicted before it is
            learnt, open loop along its actions, at 39 particles of 4 windows; () does without.
        seed: Seed of the global generators and the environment. Default: none.

    Attributes:
        task: The task; where it is set, the next ``learn`` improves in it first.
        model: The task in the newest model, by which it acts; None as long as actions are random.
        num_timesteps: Real steps.
        num_episodes: Real episodes that the dynamics have learnt.
        promised_reward: The reward of a step that the model had promised of the episodes that were
            learnt last; None of random actions.
        wall_time: Seconds spent on ``"plan"`` (the actions), ``"fit"`` and ``"update"``.
        notes: What you want to keep with the agent; saved and resumed with it.

    Raises:
        TypeError: If something is of another kind.
        ValueError: If observations or actions are not boxes of the spec's entries, or a number is
            out of range; when learning starts, if the task's functions do not return what they
            should; after a real episode, if its rewards or terminations are not those of the task.
    """

    not_saved: ClassVar[tuple[str, ...]] = ("env", "_task", "model", "_callbacks", "_random_state")
    """Attributes that are not in checkpoints, beside those of the classes above.

    A subclass names those that hold a task, a model or the dynamics, or cannot be pickled; a
    resumed agent lacks them.
    """

    _task: Task
    model: Task | None
    _can_act: bool | None  # in the newest model; None before it has improved in it
    _filter: StateFilter | None
    _random_state: Any = None  # of a run that goes on, until `learn`

    def __init__(
        self,
        env: Any,
        task: Task,
        *,
        action_noise: Callable[[], NDArray[Any]] | None = None,
        random_steps: int = 0,
        reward_tolerance: float | None = 1e-3,
        score_horizons: Sequence[int] = (1, 5, 15),
        seed: int | None = None,
    ) -> None:
        self.task = task
        expected = "an environment of Gymnasium, as gymnasium.make(...) makes it, not vectorized"
        check_kind("env", env, gym.Env, expected)
        task.check_spaces(env.observation_space, env.action_space)
        self.env = self.wrapped(env)
        self.action_noise = action_noise
        self.random_steps = checked_whole("random_steps", random_steps, 0)
        if reward_tolerance is not None:
            checked_number("reward_tolerance", reward_tolerance, least=0)
        self.reward_tolerance = reward_tolerance
        self.score_horizons = () if score_horizons == () else checked_horizons(score_horizons)
        self.num_timesteps = 0
        self.num_episodes = 0
        self.promised_reward: float | None = None
        self.wall_time = dict.fromkeys(("plan", "fit", "update"), 0.0)
        self.notes: dict[str, Any] = {}
        spec = task.dynamics.spec
        self._observed = episodes.nothing(task.observed.observation_dim, spec.action_dim)
        self._estimated = episodes.nothing(spec.state_dim, spec.action_dim)  # states behind sensors
        self._promises: list[float | None] = []  # one for each episode
        self._start: NDArray[Any] | None = None  # where the next episode begins, after a reset
        self._env_seed = seed  # of the first reset
        self._callbacks: list[Callback] = []
        if seed is not None:
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002 - the generator that SB3 uses
            torch.manual_seed(seed)

    # What a subclass says

    @abstractmethod
    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Choose actions, as policies of Stable-Baselines3 do, for its ``evaluate_policy``.

        Args:
            observation: ``observation_dim`` of the spec, or ``n x observation_dim``.
            state: What the last call returned as state; None at the start.
            episode_start: Which episodes begin, ``n``.
            deterministic: Whether the same actions are chosen at the same observation and state.

        Returns:
            Actions, ``action_dim`` or ``n x action_dim``, and the state for the next call.
        """

    def improve(self, task: Task) -> bool:
        """Improve in the task in the newest model; return whether the agent can act by now.

        If it cannot, as where it is not known yet where episodes start, the next episode's actions
        are random.
        """
        return True

    def promise(self, state: Any) -> dict[str, float]:
        """Return the numbers of ``"plan"`` by the state that came with the first action.

        The ``promised_reward``, of a step on average, is compared with the real one.
        """
        return {}

    # The loop

    def learn(
        self, total_timesteps: int, callback: Callback | Sequence[Callback] | None = None
    ) -> Self:
        """Play so many further real steps, in whole episodes, and learn from each.

        A bar shows the progress of more than five seconds, where somebody sees it.

        Args:
            total_timesteps: Number of steps; the last episode is played to its end. If it is not
                positive, as for a run that has ended, episodes that were not learnt are learnt.
            callback: One or more, such as :class:`EpisodeCheckpoint` or :func:`print_progress`.

        Raises:
            TypeError: If ``total_timesteps`` is no whole number.
        """
        checked_whole("total_timesteps", total_timesteps)
        callbacks = [] if callback is None else [callback] if callable(callback) else [*callback]
        end = self.num_timesteps + total_timesteps
        with locked(callbacks), long_work("learn", "steps", total=max(0, total_timesteps)):
            self._callbacks = callbacks
            if self._random_state is not None:  # a run that goes on
                episodes.set_generators(self._random_state)
                self._random_state = None
            self._check()
            if len(self._promises) > self.num_episodes:  # learning has failed, or was interrupted
                self._learn_dynamics()
            self._improve()
            while self.num_timesteps < end:
                self.tell("episode")
                self._play()
                self._learn_dynamics()
                self._improve()
            self.tell("done")
        return self

    def _check(self) -> None:
        """Find what is wrong before it costs a real step."""
        task, rate = self.task, self.task.rate
        is_limited = rate is not None and rate.most is not None
        if self.action_noise is not None and (is_limited or task.sensors is not None):
            raise ValueError(
                "Noise may change actions by more than action_rate allows, and hidden states are "
                "estimated by actions without noise; leave action_noise out, or limit and sensors."
            )
        if task.sensors is not None:
            task.dynamics.state_dict()  # or an error: they learn all again after each episode
            if self.known_task() is None:
                raise ValueError(
                    "Hidden states are estimated in a model; give the dynamics a physics, or leave "
                    "the sensors out."
                )
        episodes.try_task(task, np.atleast_2d(self._reset()), self.env)

    def _reset(self) -> NDArray[Any]:
        """Return the observation at which the next episode begins."""
        if self._start is None:
            seed, self._env_seed = self._env_seed, None
            self._start = self.env.reset(seed=seed)[0]
        return self._start

    def _play(self) -> None:
        """Play a real episode, and record its steps."""
        observation, self._start = self._reset(), None
        begun, state, promised = time.perf_counter(), None, None
        random_actions = self._random_actions() if self.model is None else None
        rows: list[episodes.Row] = []
        getattr(self.action_noise, "reset", lambda: None)()
        try:
            while True:
                if random_actions is not None:
                    action = next(random_actions)
                else:
                    asked = time.perf_counter()
                    action, state = self._act(observation, state, np.array([not rows]))
                    if not rows:
                        promises = self.promise(state)
                        name = f"The result of {type(self).__name__}.promise"
                        check_kind(name, promises, dict, "a dictionary of numbers")
                        self.tell("plan", {**promises, "seconds": time.perf_counter() - asked})
                        promised = promises.get("promised_reward")
                space: Any = self.env.action_space
                if self.action_noise is not None:
                    action = action + self.action_noise() * (space.high - space.low) / 2
                action = np.clip(action, space.low, space.high).astype(space.dtype)
                following, reward, terminated, truncated, info = self.env.step(action)
                self.num_timesteps += 1
                tick("steps")
                failed = bool(info.get("step_failed"))
                if not failed:
                    rows.append((observation, action, following, float(reward), bool(terminated)))
                self.tell("step", {"reward": float(reward)})
                is_whole = len(rows) == self.task.episode_length
                if failed or terminated or truncated or is_whole:
                    break
                observation = following
        finally:
            if rows:  # else there is no step to compare with a promise
                self._promises.append(promised)
                self._observed = self._observed.append(episodes.recorded(rows))
        if rows:
            values: dict[str, float] = {"number": len(self._promises), "steps": len(rows)}
            values["reward"] = sum(row[3] for row in rows) / len(rows)
            values["seconds"] = time.perf_counter() - begun
            self.tell("trial", values | ({} if promised is None else {"promised_reward": promised}))

    def _act(
        self, observation: NDArray[Any], state: Any, begins: NDArray[np.bool_]
    ) -> tuple[NDArray[Any], Any]:
        """Return the action and state that a subclass predicts, checked."""
        with episodes.timed(self.wall_time, "plan"):
            result: Any = self.predict(observation, state, begins)
        shape = self.env.action_space.shape
        if isinstance(result, tuple) and len(result) == 2:
            action = np.asarray(result[0])
            if action.shape == shape and np.isfinite(action).all():
                return action, result[1]
        raise ValueError(
            f"{type(self).__name__}.predict must return the action, finite and of shape {shape}, "
            f"and the state for the next call; found {result!r}."
        )

    def _random_actions(self) -> Iterator[NDArray[Any]]:
        """Return random actions, held for some steps, for the episode and, if need be, beyond."""
        num_steps, bounds, rate = self.episode_length(), self.action_bounds(), self.task.rate
        before: Tensor | None = None
        while True:
            for action in random_sequences(1, num_steps, bounds, MAX_HOLD)[0]:
                before = action if rate is None else rate.limited(action, before)
                yield before.numpy().astype(self.env.action_space.dtype)
            num_steps = 1

    def _learn_dynamics(self) -> None:
        """Let the dynamics learn the episodes that they have not, if there are any."""
        task, dynamics, acted_in = self.task, self.task.dynamics, self.model
        state_filter = self.filter
        if state_filter is not None and len(self._promises) > self.num_episodes:
            with episodes.timed(self.wall_time, "fit"):
                newest = replace(task, dynamics=self.newest_model.dynamics)
                self._filter, self._estimated = smooth_episodes(
                    newest, state_filter, self._observed, seed=len(self._promises)
                )
        known = self.recorded_episodes()
        is_new = known.episode >= self.num_episodes
        new = known.subset(is_new) if dynamics.has_learnt else known
        if len(new) < (1 if dynamics.is_fitted else 2):  # a first fit needs two
            self._can_act = None if len(new) else self._can_act  # there is another start
            return
        if self.reward_tolerance is not None and state_filter is None:
            episodes.check_functions(task, new, self.reward_tolerance)
        with episodes.timed(self.wall_time, "fit"):
            whole = episodes.completed(task, known, self.env)
            values = episodes.learn_dynamics(whole, new, known, self.score_horizons)
        promises, self.num_episodes = self._promises[self.num_episodes :], len(self._promises)
        self.model, self._can_act = None, None
        made = [each for each in promises if each is not None]  # none by random actions
        self.promised_reward = sum(made) / len(made) if made and made == promises else None
        values["real_reward"] = float(known.rewards[is_new].mean())
        if self.promised_reward is not None:
            values["promised_reward"] = self.promised_reward
            episodes.warn_of_promise(values, known.rewards)
        if acted_in is not None and acted_in.state_bounds is not None and task.state_bounds is None:
            episodes.warn_of_bounds(dynamics.spec, new, acted_in.state_bounds)
        self.tell("fit", values)

    def _improve(self) -> None:
        """Improve in what is known, if that is something and actions are not to be random."""
        is_random = self.num_timesteps < self.random_steps
        if self._can_act is not None or is_random or (task := self.known_task()) is None:
            return
        with episodes.timed(self.wall_time, "update"):
            can_act: Any = self.improve(task)
        name = f"{type(self).__name__}.improve"
        check_kind(f"The result of {name}", can_act, bool | np.bool_, "True if it can act by now")
        self._can_act, self.model = bool(can_act), task if can_act else None

    def tell(self, event: str, values: dict[str, float] | None = None) -> None:
        """Call the callbacks."""
        for callback in self._callbacks:
            callback(self, event, values or {})

    # What it knows

    @property
    def task(self) -> Task:
        """What is known of the system."""
        return self._task

    @task.setter
    def task(self, task: Task) -> None:
        check_kind("task", task, Task, "a Task(dynamics, reward, ...), which it needs to learn")
        self._task, self._filter = task, None
        self.model, self._can_act = None, None

    def warn_of_bounds(self, share: float, what: str) -> None:
        """Warn if what was planned leaves the bounds of the states in over a tenth of its runs."""
        if share > _LOST:
            warnings.warn(
                f"{share:.0%} of {what} leave the bounds of the states in the model, so that it is "
                "not to be trusted there. Penalise such states in the reward, widen state_bounds "
                "of the task, or search longer.",
                UserWarning,
                stacklevel=3,
            )

    @property
    def newest_model(self) -> Task:
        """``model``, or before the agent has learnt to act, the task in data or physics.

        Raises:
            RuntimeError: If there is neither.
        """
        task = self.known_task() if self.model is None else self.model
        if task is None:
            raise RuntimeError(
                f"{type(self).__name__} knows nothing of the system yet; call `learn`, or pass "
                "dynamics with a physics."
            )
        return task

    def known_task(self) -> Task | None:
        """Return the completed task in the newest model or physics; None if there is neither."""
        dynamics = self.task.dynamics.before_data()
        task = episodes.completed(self.task, self.recorded_episodes(), self.env)
        return None if dynamics is None else replace(task, dynamics=dynamics)

    @property
    def filter(self) -> StateFilter | None:
        """The filter of what sensors show, with the noises that were learnt; None without them."""
        if self._filter is None and self.task.sensors is not None:
            self._filter = StateFilter.guessed(self.newest_model, self.action_bounds())
        return self._filter

    def recorded_episodes(self, newest: int | None = None) -> Trajectories:
        """Return the real steps of episodes that have ended, with sensors by their estimates."""
        is_hidden, spec = self.task.sensors is not None, self.task.dynamics.spec
        data = self._estimated if is_hidden else episodes.decoded(spec, self._observed)
        return episodes.newest(data, newest)

    @property
    def promises(self) -> list[float | None]:
        """The reward of a step that the model promised of each episode; None of random actions."""
        return [*self._promises]

    def episode_length(self) -> int:
        """Return the steps of an episode, of the task or else the environment."""
        return episodes.episode_length(self.task, self.env)

    def action_bounds(self) -> Tensor:
        """Return lower and upper bounds of the actions, ``2 x action_dim``."""
        return episodes.action_bounds(self.env)

    def __repr__(self) -> str:
        """Name the agent, its environment and dynamics, what it has done, and its last reward."""
        return episodes.described(self)

    def _repr_html_(self) -> str:
        return episodes.html_of(self)

    # Checkpoints

    def save(self, path: Any) -> None:
        """Write a checkpoint, from which :func:`resume` makes the agent."""
        EpisodeCheckpoint(path).write(self)

    @staticmethod
    def wrapped(env: Any) -> StepGuard:
        """Return the user's environment with a guard around it."""
        return StepGuard.around(env)

    def environment_state(self) -> bytes | None:
        """Return the environment for a checkpoint; None, and a warning, if it cannot be saved."""
        return pickled_environment(self.env)

    def go_on(self, env: Any, task: Task, environment: bytes | None) -> None:
        """Take environment and task, after the attributes of a checkpoint."""
        self._task, self._callbacks = task, []
        self.env = env if environment is None else cloudpickle.loads(environment)
        self.model = self.known_task() if self._can_act else None
        self._start = None if environment is None else self._start  # it will be reset


def print_progress(agent: Any, event: str, values: dict[str, float]) -> None:
    """Print the numbers of each plan, trial, fit and search: a callback of agents and of Dyna."""
    if event not in ("step", "episode", "done"):
        print(f"{event}:", ", ".join(f"{name} {value:.3g}" for name, value in values.items()))
