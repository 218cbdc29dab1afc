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
from gpadjust.control.checkpoint import EpisodeCheckpoint, pickled_environment
from gpadjust.control.learning import (
    check_functions,
    learn_dynamics,
    locks_of,
    warn_of_bounds,
    warn_of_promise,
)
from gpadjust.control.rollouts import random_sequences
from gpadjust.control.state_filter import StateFilter, smooth_episodes
from gpadjust.control.step_guard import StepGuard
from gpadjust.control.summary import agent_table, agent_text
from gpadjust.control.task import ActionRate, Task
from gpadjust.display import Display
from gpadjust.dynamics import Trajectories
from gpadjust.dynamics.base import checked_horizons
from gpadjust.progress import long_work, tick

MAX_HOLD = 5  # steps of a random action
_LOST = 0.1  # share of runs in the model that may leave the bounds without a warning

Callback = Callable[["Agent", str, dict[str, float]], Any]
"""A function of the agent, the name of an event, and its numbers; see :class:`Agent`."""


class Agent(ABC, Display):
    """A controller that learns from real episodes: :meth:`learn` plays, learns and improves.

    A subclass defines how it acts (:meth:`predict`) and what it improves in a model
    (:meth:`improve`). Before there are data, the model is the physics; without one, or with
    several, the actions of the first episode are random.

    An error on the way loses no episode. Correct what is wrong, for example set ``agent.task`` to a
    task with other functions, and call ``learn`` again; new dynamics learn all episodes.
    Transitions at which the physics fails are left out, with a warning. A step that fails is not
    stored and ends its episode, see :class:`StepGuard`.

    Callbacks are called with the agent, the name of an event, and a dictionary of numbers:

    - ``"episode"``: an episode begins;
    - ``"plan"``: its first action is chosen, in ``seconds``, with the agent's :meth:`promise`;
    - ``"step"``: a real step was made, with its ``reward``;
    - ``"trial"``: the episode has ended: its ``number`` (from 1), ``steps``, ``seconds``, the
      ``reward`` of a step, and the ``promised_reward``;
    - ``"fit"``: the dynamics are updated, with scores of the new steps before that (``nlpd``,
      ``coverage``, ``rmse/x``, ``coverage_15``, ...), ``real_reward`` and ``promised_reward``;
    - ``"search"``: an event of a subclass;
    - ``"done"``: all steps are made.

    Args:
        env: The real environment, of Gymnasium, with boxes of observations and actions as in the
            spec of the dynamics; the attribute has a :class:`StepGuard` around.
        task: The dynamics of the system, its reward and goal.
        reward_tolerance: Largest error of the task's rewards, relative to the largest real one of
            an episode; None to check neither rewards nor terminations.
        score_horizons: Numbers of steps over which each new episode is predicted, open loop along
            its actions, before the dynamics learn it; () for no such scores.
        seed: Seed of the global generators and the environment. Default: none.

    Attributes:
        task: The task; the next ``learn`` first improves in a new one.
        model: The task in the newest model; None while actions are random.
        num_timesteps: Number of real steps.
        num_episodes: Number of real episodes in the dynamics.
        promised_reward: Promised reward of a step in the newest episodes; None for random actions.
        notes: Your data, saved and resumed with the agent.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If observations or actions are not boxes of the spec's entries, or a number is
            out of range; at ``learn``, if functions of the task return wrong shapes, or differ from
            the rewards or terminations of a real episode.
    """

    not_saved: ClassVar[tuple[str, ...]] = ("env", "_task", "model", "_callbacks", "_random_state")
    """Attributes that a checkpoint lacks, in addition to those of the base classes: those that
    contain a task, a model or the dynamics, or cannot be pickled."""

    _task: Task
    model: Task | None
    _can_act: bool | None  # in the newest model; None before it has improved in it
    _filter: StateFilter | None
    _random_state: Any = None  # of a resumed run, until `learn`

    def __init__(
        self,
        env: Any,
        task: Task,
        *,
        reward_tolerance: float | None = 1e-3,
        score_horizons: Sequence[int] = (1, 5, 15),
        seed: int | None = None,
    ) -> None:
        self.task = task
        expected = "an environment of Gymnasium, as gymnasium.make(...) makes it, not vectorized"
        check_kind("env", env, gym.Env, expected)
        task.check_spaces(env.observation_space, env.action_space)
        self.env = self.wrapped(env)
        if reward_tolerance is not None:
            checked_number("reward_tolerance", reward_tolerance, least=0)
        self.reward_tolerance = reward_tolerance
        self.score_horizons = () if score_horizons == () else checked_horizons(score_horizons)
        self.num_timesteps = 0
        self.num_episodes = 0
        self.promised_reward: float | None = None
        self.notes: dict[str, Any] = {}
        spec = task.dynamics.spec
        self._observed = episodes.nothing(task.observed.observation_dim, spec.action_dim)
        self._estimated = episodes.nothing(spec.state_dim, spec.action_dim)  # states behind sensors
        self._promises: list[float | None] = []  # one for each episode
        self._start: NDArray[Any] | None = None  # observation of the next episode, after a reset
        self._env_seed = seed  # of the first reset
        self._callbacks: list[Callback] = []
        if seed is not None:
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002 - the generator that SB3 uses
            torch.manual_seed(seed)

    # What a subclass defines

    @abstractmethod
    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Choose actions, as a policy of Stable-Baselines3, for its ``evaluate_policy``.

        Args:
            observation: ``observation_dim`` of the spec, or ``n x observation_dim``.
            state: State that the last call returned; None at the start.
            episode_start: ``n`` booleans, True for an episode that begins.
            deterministic: If True, the same observation and state have the same actions.

        Returns:
            Actions, ``action_dim`` or ``n x action_dim``, and the state for the next call.
        """

    def improve(self, task: Task) -> bool:
        """Improve in the task in the newest model; return True if the agent can act by now.

        Else the actions of the next episode are random.
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
        """Play so many further real steps, in complete episodes, and learn from each.

        Without further steps, only recorded episodes are learnt. Callbacks are, for example,
        :class:`EpisodeCheckpoint` and :func:`print_progress`.

        Raises:
            TypeError: If ``total_timesteps`` is not a whole number.
        """
        checked_whole("total_timesteps", total_timesteps)
        callbacks: Any = [callback] if callable(callback) else [*(callback or ())]
        end = self.num_timesteps + total_timesteps
        work = long_work("learn", "steps", total=max(0, total_timesteps))
        with locks_of(callbacks), work:
            self._callbacks = callbacks
            if self._random_state is not None:  # a resumed run
                episodes.set_generators(self._random_state)
                self._random_state = None
            self._check()
            if len(self._promises) > self.num_episodes:  # an update failed, or was interrupted
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
        """Find errors before they cost a real step."""
        if self.task.sensors is not None:
            self.task.dynamics.state_dict()  # or an error: they learn all episodes again
            if self.known_task() is None:
                raise ValueError(
                    "The estimate of hidden states needs a model; give the dynamics a physics, or "
                    "leave the sensors out."
                )
        episodes.try_task(self.task, np.atleast_2d(self._reset()), self.env)

    def _reset(self) -> NDArray[Any]:
        """Return the first observation of the next episode."""
        if self._start is None:
            self._start = self.env.reset(seed=self._env_seed)[0]
            self._env_seed = None
        return self._start

    def _play(self) -> None:
        """Play a real episode, and record its steps."""
        observation = self._reset()
        self._start = None
        begun = time.perf_counter()
        state: Any = None
        promises: dict[str, float] = {}
        is_random = self.model is None
        random_actions = self._random_actions()
        rows: list[episodes.Row] = []
        try:
            while True:
                if is_random:
                    action = next(random_actions)
                else:
                    asked = time.perf_counter()
                    action, state = self._act(observation, state, np.array([not rows]))
                    if not rows:
                        promises = self.promise(state)
                        self._check_result("promise", promises, dict, "a dictionary of numbers")
                        self.tell("plan", {**promises, "seconds": time.perf_counter() - asked})
                space: Any = self.env.action_space
                action = np.clip(action, space.low, space.high).astype(space.dtype)
                following, reward, terminated, truncated, info = self.env.step(action)
                self.num_timesteps += 1
                tick("steps")
                failed = bool(info.get("step_failed"))
                if not failed:
                    rows.append((observation, action, following, float(reward), bool(terminated)))
                self.tell("step", {"reward": float(reward)})
                is_complete = len(rows) == self.task.episode_length
                if failed or terminated or truncated or is_complete:
                    break
                observation = following
        finally:
            if rows:  # else there is no step to compare with a promise
                self._promises.append(promises.get("promised_reward"))
                self._observed = self._observed.append(episodes.recorded(rows))
        if rows:
            values: dict[str, float] = {"number": len(self._promises), "steps": len(rows)}
            values["reward"] = sum(row[3] for row in rows) / len(rows)
            values["seconds"] = time.perf_counter() - begun
            if self._promises[-1] is not None:
                values["promised_reward"] = self._promises[-1]
            self.tell("trial", values)

    def _act(
        self, observation: NDArray[Any], state: Any, begins: NDArray[np.bool_]
    ) -> tuple[NDArray[Any], Any]:
        """Return action and state of `predict`, checked."""
        result: Any = self.predict(observation, state, begins)
        shape = self.env.action_space.shape
        if isinstance(result, tuple) and len(result) == 2:
            action = np.asarray(result[0])
            if action.shape == shape and np.isfinite(action).all():
                return action, result[1]
        expected = f"must return the action, finite and of shape {shape}, and the next state"
        raise ValueError(f"{type(self).__name__}.predict {expected}; found {result!r}.")

    def _random_actions(self) -> Iterator[NDArray[Any]]:
        """Yield random actions, held for some steps, for the episode and beyond."""
        num_steps = self.episode_length()
        rate = self.task.rate or ActionRate()
        action: Tensor | None = None
        while True:
            for chosen in random_sequences(1, num_steps, self.action_bounds(), MAX_HOLD)[0]:
                action = rate.limited(chosen, action)
                yield action.numpy().astype(self.env.action_space.dtype)
            num_steps = 1

    def _learn_dynamics(self) -> None:
        """Update the dynamics by the episodes that are not in them."""
        task, dynamics = self.task, self.task.dynamics
        acted_in = self.model
        self._estimate_states()
        # Fresh dynamics learn all episodes.
        data = self.recorded_episodes()
        is_new = data.episode >= self.num_episodes
        new = data.subset(is_new) if dynamics.has_learnt else data
        is_enough = len(new) > 1 or (len(new) == 1 and dynamics.is_fitted)  # a first fit needs two
        if not is_enough:
            if len(new):
                self._can_act = None  # there is another start
            return
        if self.reward_tolerance is not None and task.sensors is None:
            check_functions(task, new, self.reward_tolerance)
        complete = episodes.completed(task, data, self.env)
        values = learn_dynamics(complete, new, data, self.score_horizons)
        self.promised_reward = _mean_promise(self._promises[self.num_episodes :])
        self.num_episodes = len(self._promises)
        # The agent improves in the new model before it acts.
        self.model = None
        self._can_act = None
        values["real_reward"] = float(data.rewards[is_new].mean())
        if self.promised_reward is not None:
            values["promised_reward"] = self.promised_reward
            warn_of_promise(values, data.rewards)
        if task.state_bounds is None and acted_in is not None and acted_in.state_bounds is not None:
            warn_of_bounds(dynamics.spec, new, acted_in.state_bounds)
        self.tell("fit", values)

    def _estimate_states(self) -> None:
        """Estimate the states behind sensors again, if there are new episodes."""
        if self.filter is None or len(self._promises) == self.num_episodes:
            return
        newest = replace(self.task, dynamics=self.newest_model.dynamics)
        self._filter, self._estimated = smooth_episodes(
            newest, self.filter, self._observed, seed=len(self._promises)
        )

    def _improve(self) -> None:
        """Improve in the newest model, if there is one."""
        if self._can_act is not None:
            return
        task = self.known_task()
        if task is None:
            return
        can_act: Any = self.improve(task)
        self._check_result("improve", can_act, bool | np.bool_, "True if it can act by now")
        self._can_act = bool(can_act)
        self.model = task if can_act else None

    def _check_result(self, method: str, result: Any, kind: Any, expected: str) -> None:
        check_kind(f"The result of {type(self).__name__}.{method}", result, kind, expected)

    def tell(self, event: str, values: dict[str, float] | None = None) -> None:
        """Call the callbacks."""
        for callback in self._callbacks:
            callback(self, event, values or {})

    def warn_of_bounds(self, share: float, runs: str) -> None:
        """Warn if more than a tenth of the runs in the model leave the bounds of the states."""
        if share > _LOST:
            message = (
                f"{share:.0%} of {runs} leave the bounds of the states in the model. Penalise such "
                "states in the reward, widen state_bounds of the task, or search longer."
            )
            warnings.warn(message, UserWarning, stacklevel=3)

    # Models and data

    @property
    def task(self) -> Task:
        """The dynamics of the system, its reward and goal."""
        return self._task

    @task.setter
    def task(self, task: Task) -> None:
        check_kind("task", task, Task, "a Task(dynamics, reward, ...), which it needs to learn")
        self._task = task
        self._filter = None
        self.model = None
        self._can_act = None

    @property
    def newest_model(self) -> Task:
        """``model``, or before the agent can act, the task in data or physics; else an error."""
        task = self.model or self.known_task()
        if task is None:
            name = type(self).__name__
            raise RuntimeError(f"{name} has no model yet; call `learn`, or give a physics.")
        return task

    def known_task(self) -> Task | None:
        """Return the completed task in the newest model or physics; None without both."""
        dynamics = self.task.dynamics.before_data()
        if dynamics is None:
            return None
        task = episodes.completed(self.task, self.recorded_episodes(), self.env)
        return replace(task, dynamics=dynamics)

    @property
    def filter(self) -> StateFilter | None:
        """The filter of a task with sensors, with estimated noises."""
        if self._filter is None and self.task.sensors is not None:
            self._filter = StateFilter.guessed(self.newest_model, self.action_bounds())
        return self._filter

    def recorded_episodes(self, newest: int | None = None) -> Trajectories:
        """Return the real steps of episodes that have ended, or only the newest steps.

        With sensors the states are estimates.
        """
        data = self._estimated
        if self.task.sensors is None:
            data = episodes.decoded(self.task.dynamics.spec, self._observed)
        return episodes.newest(data, newest)

    @property
    def promises(self) -> list[float | None]:
        """The promised reward of a step of each episode; None for random actions."""
        return [*self._promises]

    def episode_length(self) -> int:
        """Return the steps of an episode, of the task or else the environment."""
        return episodes.episode_length(self.task, self.env)

    def action_bounds(self) -> Tensor:
        """Return lower and upper bounds of the actions, ``2 x action_dim``."""
        return episodes.action_bounds(self.env)

    def __repr__(self) -> str:
        """Name the agent, its environment and dynamics, its progress, and its last reward."""
        return agent_text(self)

    def _repr_html_(self) -> str:
        return agent_table(self)

    # Checkpoints

    def save(self, path: Any) -> None:
        """Write a checkpoint, for :func:`resume`."""
        EpisodeCheckpoint(path).write(self)

    @staticmethod
    def wrapped(env: Any) -> StepGuard:
        """Return the user's environment with a guard around it."""
        return StepGuard.around(env)

    def environment_state(self) -> bytes | None:
        """Return the environment for a checkpoint; None, with a warning, if it has no pickle."""
        return pickled_environment(self.env)

    def go_on(self, env: Any, task: Task, environment: bytes | None) -> None:
        """Set environment and task, after the attributes of a checkpoint."""
        self._task = task
        self._callbacks = []
        self.env = env if environment is None else cloudpickle.loads(environment)
        self.model = self.known_task() if self._can_act else None
        if environment is None:
            self._start = None  # it will be reset


def _mean_promise(promises: Sequence[float | None]) -> float | None:
    """Return the mean promise of episodes; None if one of them has none."""
    made = [promise for promise in promises if promise is not None]
    if not made or len(made) < len(promises):
        return None
    return sum(made) / len(made)


def print_progress(agent: Any, event: str, values: dict[str, float]) -> None:
    """Print the numbers of each plan, trial, fit and search: a callback of agents and of Dyna."""
    if event not in ("step", "episode", "done"):
        print(f"{event}:", ", ".join(f"{name} {value:.3g}" for name, value in values.items()))
