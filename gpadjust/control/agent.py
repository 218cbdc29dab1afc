"""Agents: a task that real episodes complete, and the loop that plays, learns and improves."""

from __future__ import annotations

import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, ClassVar, Self

import cloudpickle
import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_number, checked_whole
from gpadjust.control.checkpoint import (
    EpisodeCheckpoint,
    RandomState,
    locked,
    packed,
    pickled,
    pickled_environment,
    unpacked,
    unpickled,
)
from gpadjust.control.episodes import check_functions, completed, learn_dynamics, warn_of_bounds
from gpadjust.control.rollouts import random_sequences
from gpadjust.control.smoothed_episodes import smooth_episodes
from gpadjust.control.state_filter import StateFilter
from gpadjust.control.step_guard import StepGuard
from gpadjust.control.task import Task
from gpadjust.dynamics import Trajectories
from gpadjust.dynamics.base import checked_horizons

MAX_HOLD = 5  # steps of a random action

Callback = Callable[["Agent", str, dict[str, float]], Any]
"""What is called with the agent, the name of an event, and its numbers; see :class:`Agent`."""


class TaskAgent(ABC):
    """Base of all agents: a task, which real episodes complete, and the parts of a checkpoint.

    Attributes:
        task: The task; not saved.
        wall_time: Seconds spent on each part of the work.
    """

    task: Any
    env: Any
    num_episodes: int
    num_timesteps: int
    wall_time: dict[str, float]
    _random_state: RandomState | None = None  # of a run that goes on, until `learn`

    def ready_task(self) -> Task:
        """The task, if the agent can learn with it."""
        return self.task

    def model_task(self) -> Task:
        """The task, with what environment and real episodes tell where it says nothing.

        Raises:
            ValueError: If nobody says how long an episode is.
        """
        parts = self.recorded_episodes(), self.episode_length(), self.action_bounds()
        return completed(self.ready_task(), *parts)

    @abstractmethod
    def action_bounds(self) -> Tensor:
        """Lower and upper bounds of the actions, ``2 x action_dim``."""

    def episode_length(self) -> int:
        """Steps of an episode: those of the task, or else the time limit of the environment.

        Raises:
            ValueError: If there is neither.
        """
        length = self.ready_task().episode_length
        if length is None and (spec := self.env_attribute("spec")) is not None:
            length = spec.max_episode_steps
        if length is None:
            with suppress(AttributeError):  # a TimeLimit that was put around it by hand
                length = self.env_attribute("_max_episode_steps")
        if length is None:
            raise ValueError(
                "There is no environment, or no time limit that could be read of it; give the task "
                "an episode_length, the number of steps of an episode."
            )
        return int(length)

    def try_task(self, observations: np.ndarray, action_space: Any) -> None:
        """Call the task's functions at observations ``N x observation_dim`` and a middle action."""
        self.episode_length()
        before, task = RandomState.capture(), self.ready_task()
        seen = torch.from_numpy(observations.astype(np.float64))
        task.observed.check_observations(seen)
        # Of a single state much would look right that is not.
        if task.sensors is None:
            twice = task.dynamics.spec.decode(seen).repeat(2, 1)
        else:
            twice = task.draw_initial_states(2)
        middle = torch.from_numpy((action_space.low + action_space.high) / 2).double()
        task.try_functions(twice, middle.expand(len(twice), -1))
        before.restore()

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add what is done inside to a part of ``wall_time``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.wall_time[part] += time.perf_counter() - start

    def __repr__(self) -> str:
        """Name the agent, its environment and dynamics, what it has done, and its last reward."""
        env = "no environment" if self.env is None else layer_names(self.env)[-1]
        if self.task is None:
            return f"{type(self).__name__}({env}, no task)"
        recorded, last = self.recorded_episodes(), ""
        if len(recorded):
            newest = recorded.rewards[recorded.episode == recorded.episode[-1]]
            last = f", last reward {newest.mean():.3g} a step"
        return (
            f"{type(self).__name__}({env}, {type(self.task.dynamics).__name__}, "
            f"{self.num_episodes} episodes learnt, {self.num_timesteps} steps{last})"
        )

    @abstractmethod
    def recorded_episodes(self, newest: int | None = None) -> Trajectories:
        """Return the real steps, or the newest of them only."""

    @abstractmethod
    def env_attribute(self, name: str) -> Any:
        """An attribute of the environment or of one that it wraps."""

    @classmethod
    @abstractmethod
    def wrapped(cls, env: Any) -> Any:
        """The user's environment as the agent holds it."""

    @classmethod
    def described(cls, env: Any) -> dict[str, Any]:
        """The environment in plain values, which are compared before anything is unpickled."""
        return {
            "wrappers": " of ".join(layer_names(env)),
            "observation_space": str(env.observation_space),
            "action_space": str(env.action_space),
        }

    @abstractmethod
    def saved_parts(self) -> dict[str, bytes]:
        """The files of a checkpoint, by name."""

    @classmethod
    @abstractmethod
    def from_parts(cls, parts: dict[str, bytes], env: Any, task: Task) -> Self:
        """The agent of these files."""


class Agent(TaskAgent):
    """A controller that learns from real episodes: :meth:`learn` plays, learns and improves.

    A subclass says how it acts (:meth:`predict`) and what it improves in a model (:meth:`improve`).
    Before there are data, the model is the physics; without one, or with several, the first
    episode's actions are random.

    An error on the way (a wrong reward, a physics that fails, a fit that does not converge) loses
    nothing: the episodes are kept, and the dynamics learn them after the next one. Mend what is
    wrong, set ``agent.task`` to a task with other functions or dynamics, for example, and call
    ``learn`` again; dynamics that know nothing learn all episodes. Transitions at which the physics
    fails are not learnt, with a warning. A step that fails, or gives what cannot be data, is not
    kept and ends its episode, see :class:`StepGuard`; so does one that did not happen, which an
    environment tells by a true ``info["step_failed"]``.

    Callbacks are called with the agent, the name of an event, and a dictionary of numbers:

    - ``"episode"``: an episode begins;
    - ``"plan"``: its first action is chosen, which took ``seconds``, with what the agent says of it
      (:meth:`promise`);
    - ``"step"``: a real step was made, with its ``reward``;
    - ``"trial"``: the episode has ended, with its ``number`` (from 1), ``steps``, ``seconds``, the
      ``reward`` of a step, and what was promised of it (``promised_reward``);
    - ``"fit"``: the dynamics have learnt, with the scores of the new steps before that
      (``nlpd``, ``coverage``, ``rmse/x``, ``coverage_15``, ...), ``real_reward`` of a step and
      ``promised_reward``;
    - ``"update"``, ``"search"``: as a subclass has them;
    - ``"done"``: all steps are made.

    To end a run early, raise an error of your own: nothing is lost.

    Args:
        env: The real environment, of Gymnasium, with a box of observations, as the spec of the
            dynamics has them, and a box of actions; the attribute has a :class:`StepGuard` around.
        task: What is known of the system; rewards and terminations are compared with those of
            each real episode.
        action_noise: Called at each step for what is added to the action, ``action_dim`` numbers in
            halves of its range, such as Stable-Baselines3's ``NormalActionNoise``.
        random_steps: Episodes that begin before so many real steps have random actions, held for
            up to five steps. Default: the first one is that of the physics.
        reward_tolerance: How far the known rewards may be from the recorded ones, relative to the
            largest of an episode; None to check neither rewards nor terminations, as noisy sensors
            may need.
        score_horizons: Numbers of steps over which each new episode is predicted before it is
            learnt, open loop along its actions. Some half a second, and with a physics that is
            costly its evaluation at 39 particles of 4 windows a step; () does without.
        seed: Seed of the global generators and the environment. Default: none.

    Attributes:
        task: The task; set another one to change a part of it.
        model: The task in the newest model, by which it acts; None as long as actions are random.
        num_timesteps: Real steps.
        num_episodes: Real episodes that the dynamics have learnt.
        promised_reward: The reward of a step that the model had promised of the newest episodes
            that were learnt, or None, as of random actions.
        wall_time: Seconds spent on ``"plan"`` (the actions), ``"fit"`` and ``"update"``.
        notes: What you want to keep with the agent, in plain values; saved and resumed with it.

    Raises:
        TypeError: If something is of another kind.
        ValueError: If observations or actions are not boxes of the spec's entries, or a number is
            out of range; when learning starts, if the task's functions do not return what they
            should; after a real episode, if its rewards or terminations are not those of the task.
    """

    not_saved: ClassVar[tuple[str, ...]] = ("env", "_data", "_paths", "_callbacks", "_random_state")
    """Attributes that are not in checkpoints, beside those of the classes above.

    A subclass names those that cannot be pickled; a resumed agent lacks them.
    """

    model: Task | None
    _is_improved: bool  # in all that is known
    _filter: StateFilter | None

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
        checked_whole("random_steps", random_steps, 0)
        if reward_tolerance is not None:
            checked_number("reward_tolerance", reward_tolerance, least=0)
        self.task = task
        expected = "an environment of Gymnasium, as gymnasium.make(...) makes it, not vectorized"
        check_kind("env", env, gym.Env, expected)
        self.env = StepGuard.around(env)
        task.check_spaces(env.observation_space, env.action_space)
        self.action_noise = action_noise
        self.random_steps = random_steps
        self.reward_tolerance = reward_tolerance
        self.score_horizons = () if score_horizons == () else checked_horizons(score_horizons)
        self.num_timesteps = 0
        self.num_episodes = 0
        self.promised_reward: float | None = None
        self.wall_time = dict.fromkeys(("plan", "fit", "update"), 0.0)
        self.notes: dict[str, Any] = {}
        self._data = _no_steps(self.env)
        self._paths: list[Tensor] = []  # with sensors, states of each smoothed episode, T + 1 rows
        self._promises: list[float | None] = []  # one for each episode
        self._start: NDArray[Any] | None = None  # where the next episode begins, after a reset
        self._env_seed = seed  # of the first reset
        self._callbacks: list[Callback] = []
        if seed is not None:
            RandomState.seed(seed)

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
        """Improve in the newest model; return whether the agent can act by now.

        If it cannot, as where it is not known yet where episodes start, the next episode's actions
        are random.

        Args:
            task: The task in the newest model, the ``model`` of the next episode.
        """
        return True

    def promise(self, state: Any) -> dict[str, float]:
        """Return the promises of the model for an episode that begins: the numbers of ``"plan"``.

        Of these ``promised_reward``, of a step on average, is compared with the real one.

        Args:
            state: What :meth:`predict` returned with its first action.
        """
        return {}

    # The loop

    def learn(
        self, total_timesteps: int, callback: Callback | Sequence[Callback] | None = None
    ) -> Self:
        """Play so many further real steps, in whole episodes, and learn from each.

        Args:
            total_timesteps: Number of steps; the episode under way is played to its end.
            callback: One or more callbacks, such as :class:`EpisodeCheckpoint` or
                :func:`print_progress`.
        """
        given = [] if callback is None else [callback] if callable(callback) else [*callback]
        end = self.num_timesteps + total_timesteps
        with locked(given):
            self._callbacks = given
            self._begin()
            while True:
                if not self._is_improved:
                    self._improve()
                if self.num_timesteps >= end:
                    break
                self.tell("episode")
                self._play()
                self._learn_dynamics()
            self.tell("done")
        return self

    def _play(self) -> None:
        """Play a real episode, and keep its steps."""
        observation, self._start = self._reset(), None
        began, state, promised = time.perf_counter(), None, None
        rows: list[tuple[Any, ...]] = []
        random = self._random_actions() if self.model is None else None
        getattr(self.action_noise, "reset", lambda: None)()
        try:
            while True:
                if random is not None:
                    action = next(random)
                else:
                    asked = time.perf_counter()
                    with self.timed("plan"):
                        action, state = self._chosen(observation, state, np.array([not rows]))
                    if not rows:
                        said = self._said(state)
                        promised = said.get("promised_reward")
                        self.tell("plan", {**said, "seconds": time.perf_counter() - asked})
                action = self._explored(action)
                following, reward, terminated, truncated, info = self.env.step(action)
                self.num_timesteps += 1
                failed = bool(info.get("step_failed"))
                if not failed:
                    row = (observation, action, following, float(reward), bool(terminated))
                    rows.append(row)
                self.tell("step", {"reward": float(reward)})
                whole = len(rows) == self.task.episode_length
                if failed or terminated or truncated or whole:
                    break
                observation = following
        finally:
            if rows:  # else there is no step to compare with a promise
                self._promises.append(promised)
                self._keep(rows)
        if not rows:
            return
        values: dict[str, float] = {"number": len(self._promises), "steps": len(rows)}
        values["reward"] = sum(row[3] for row in rows) / len(rows)
        values["seconds"] = time.perf_counter() - began
        if promised is not None:
            values["promised_reward"] = promised
        self.tell("trial", values)

    def _explored(self, action: NDArray[Any]) -> NDArray[Any]:
        """Return an action with noise, if there is any, within the bounds."""
        space = self.env.action_space
        if self.action_noise is not None:
            action = action + self.action_noise() * (space.high - space.low) / 2
        return np.clip(action, space.low, space.high).astype(space.dtype)

    def _keep(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Keep the steps of an episode, observations as they came."""
        columns = (np.array(column, dtype=np.float64) for column in zip(*rows, strict=True))
        before, actions, after, rewards, terminated = map(torch.from_numpy, columns)
        episode = torch.zeros(len(rows))
        new = Trajectories(before, actions, after, episode, rewards, terminated.bool())
        self._data = self._data.append(new)

    def _chosen(
        self, observation: NDArray[Any], state: Any, begins: NDArray[np.bool_]
    ) -> tuple[NDArray[Any], Any]:
        """The action and state that a subclass predicts, checked."""
        found: Any = self.predict(observation, state, begins)
        shape = self.env.action_space.shape
        if isinstance(found, tuple) and len(found) == 2:
            action = np.asarray(found[0])
            if action.shape == shape and np.isfinite(action).all():
                return action, found[1]
        raise ValueError(
            f"{type(self).__name__}.predict must return the action, finite and of shape {shape}, "
            f"and the state for the next call; found {found!r}."
        )

    def _said(self, state: Any) -> dict[str, float]:
        """The promise of a subclass, checked."""
        said: Any = self.promise(state)
        if not isinstance(said, dict):
            raise TypeError(
                f"{type(self).__name__}.promise must return a dictionary of numbers, such as "
                f"{{'promised_reward': -0.3}}; found {said!r}."
            )
        return said

    def _learn_dynamics(self) -> None:
        """Let the dynamics learn the episodes that they have not, if there are any."""
        dynamics, sensors = self.task.dynamics, self.task.sensors
        if sensors is not None and len(self._promises) > self.num_episodes:
            with self.timed("fit"):
                self._smooth()
        recorded = self.recorded_episodes()
        is_new = recorded.episode >= self.num_episodes
        new = recorded.some(is_new) if dynamics.has_learnt else recorded
        if len(new) < (1 if dynamics.is_fitted else 2):  # a first fit needs two
            self._is_improved &= len(new) == 0  # there is another start
            return
        if self.reward_tolerance is not None and sensors is None:
            check_functions(self.task, new, self.reward_tolerance)
        with self.timed("fit"):
            bounds_of_actions = self.action_bounds()
            task = completed(self.task, recorded, self.episode_length(), bounds_of_actions)
            values = learn_dynamics(task, new, recorded, self.score_horizons)
        bounds = None if self.model is None else self.model.state_bounds
        if bounds is not None and self.task.state_bounds is None:
            warn_of_bounds(dynamics.spec, new, bounds)
        self.model, self._is_improved = None, False  # it is not the newest any more
        real = recorded.rewards[is_new].mean()
        promises, self.num_episodes = self._promises[self.num_episodes :], len(self._promises)
        kept = [each for each in promises if each is not None]
        # Of actions that were random nothing was promised.
        self.promised_reward = sum(kept) / len(kept) if kept and kept == promises else None
        values["real_reward"] = float(real)
        if self.promised_reward is not None:
            values["promised_reward"] = self.promised_reward
            self._compare(values, recorded.rewards)
        self.tell("fit", values)

    def _smooth(self) -> None:
        """Estimate the states behind all episodes, and the noises, in the newest model."""
        if not len(self._data):
            return
        episodes = self._data.episodes()
        newest = self.task.dynamics.before_data()
        assert newest is not None, "checked at the start"
        task = replace(self.task, dynamics=newest)
        known = self.filter
        assert known is not None, "there are sensors"
        self._filter, self._paths = smooth_episodes(task, known, episodes, len(episodes))

    def _improve(self) -> None:
        """Improve in what is known, if that is something and actions are not to be random."""
        if self.num_timesteps < self.random_steps:
            return
        task = self.known_task()
        if task is None:
            return
        with self.timed("update"):
            can_act = self.improve(task)
        if not isinstance(can_act, bool | np.bool_):
            raise TypeError(
                f"{type(self).__name__}.improve must return whether the agent can act by now, True "
                f"or False; found {can_act!r}."
            )
        self._is_improved = True
        if can_act:
            self.model = task

    def tell(self, event: str, values: dict[str, float] | None = None) -> None:
        """Call the callbacks."""
        for each in self._callbacks:
            each(self, event, values or {})

    # What it knows

    @property
    def task(self) -> Task:
        """The task; where it is set, the next ``learn`` improves in it first."""
        return self._task

    @task.setter
    def task(self, task: Task) -> None:
        told = "a Task(dynamics, reward, ...), which an agent needs to learn"
        check_kind("task", task, Task, told)
        self._task = task
        self.model, self._is_improved = None, False
        self._filter = None

    @property
    def filter(self) -> StateFilter | None:
        """The filter of what sensors show, with the noises that were learnt; None without sensors.

        Raises:
            RuntimeError: If there is neither a physics nor a real episode.
        """
        if self._filter is None and self.task.sensors is not None:
            self._filter = StateFilter.guessed(self.newest_model, self.action_bounds())
        return self._filter

    def recorded_episodes(self, newest: int | None = None) -> Trajectories:
        """The real steps; or the newest of them only.

        They are those of episodes that have ended. With sensors the states are drawn from what is
        known of them since they were last learnt.
        """
        data, paths = self._data, self._paths
        if self.task.sensors is None:
            spec = self.task.dynamics.spec
            states, next_states = (spec.decode(each) for each in (data.states, data.next_states))
        else:  # of the episodes that are smoothed
            none = torch.empty(0, self.task.dynamics.spec.state_dim, dtype=torch.float64)
            data = data.some(slice(sum(len(path) - 1 for path in paths)))
            states = torch.cat([none, *(path[:-1] for path in paths)])
            next_states = torch.cat([none, *(path[1:] for path in paths)])
        data = replace(data, states=states, next_states=next_states)
        return data if newest is None else data.some(slice(max(len(data) - newest, 0), None))

    def env_attribute(self, name: str) -> Any:
        """An attribute of the environment or of one that it wraps."""
        return self.env.get_wrapper_attr(name)

    @property
    def newest_model(self) -> Task:
        """``model``, or where the agent has not learnt to act yet, the task in what is known.

        Raises:
            RuntimeError: If there is neither a physics nor a real episode.
        """
        task = self.known_task() if self.model is None else self.model
        if task is None:
            raise RuntimeError(
                f"{type(self).__name__} knows nothing of the system yet; call `learn`, or give the "
                "dynamics a physics."
            )
        return task

    def known_task(self) -> Task | None:
        """``model_task`` in the newest model, or in the physics; None if nothing is known yet."""
        task = self.model_task()
        dynamics = task.dynamics.before_data()
        return None if dynamics is None else replace(task, dynamics=dynamics)

    def action_bounds(self) -> Tensor:
        """Lower and upper bounds of the actions, ``2 x action_dim``."""
        space = self.env.action_space
        return torch.from_numpy(np.stack([space.low, space.high]).astype(np.float64))

    # The parts of the loop

    def _begin(self) -> None:
        """Find what is wrong before it costs a real step."""
        if self._random_state is not None:  # a run that goes on
            self._random_state.restore()
            self._random_state = None
        if self.task.sensors is not None:
            self._check_sensors()
        rate = self.task.rate
        if self.action_noise is not None and rate is not None and rate.most is not None:
            raise ValueError(
                "Noise on the actions may change them by more than action_rate allows; leave "
                "action_noise out, or the limit."
            )
        self.try_task(np.atleast_2d(self._reset()), self.env.action_space)

    def _check_sensors(self) -> None:
        """Raise a ValueError if hidden states could not be estimated."""
        if self.known_task() is None:
            raise ValueError(
                "Hidden states are estimated in a model of the system; give the dynamics a "
                "physics, or leave the sensors out."
            )
        self.task.dynamics.state_dict()  # or an error: they learn all again after each episode
        if self.action_noise is not None:
            raise ValueError(
                "The estimate of hidden states takes the actions for those that were chosen; leave "
                "action_noise out, or the sensors."
            )

    def _reset(self) -> NDArray[Any]:
        """The observation at which the next episode begins."""
        if self._start is None:
            seed, self._env_seed = self._env_seed, None
            self._start = self.env.reset(seed=seed)[0]
        return self._start

    def _random_actions(self) -> Iterator[NDArray[Any]]:
        """Random actions, held for some steps, for the episode and, if it is longer, beyond."""
        num_steps, bounds, rate = self.episode_length(), self.action_bounds(), self.task.rate
        before: Tensor | None = None
        while True:
            for action in random_sequences(1, num_steps, bounds, MAX_HOLD)[0]:
                before = action if rate is None else rate.limited(action, before)
                yield before.numpy().astype(self.env.action_space.dtype)
            num_steps = 1

    def _compare(self, values: dict[str, float], recorded: Tensor) -> None:
        """Warn if a real step gave less than promised by a quarter of the range of all rewards.

        The warning also says if data had overridden the physics in most of the predictions. (That
        alone is no fault: where a model has learnt without noise that its physics is a little off,
        they do so nearly everywhere.)
        """
        real, promised = values["real_reward"], values["promised_reward"]
        span = max(float(recorded.max()), promised) - float(recorded.min())
        if promised - real <= span / 4:
            return
        overrides = values.get("overrides", 0.0)
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

    # Checkpoints

    @classmethod
    def wrapped(cls, env: Any) -> Any:
        """The user's environment with a guard around it."""
        return StepGuard.around(env)

    def save(self, path: Any) -> None:
        """Write a checkpoint, from which :func:`resume` makes the agent."""
        EpisodeCheckpoint(path).write(self)

    def saved_parts(self) -> dict[str, bytes]:
        """Settings and counts, the real steps, what the dynamics learnt, and the environment."""
        left_out = {name for each in type(self).__mro__ for name in vars(each).get("not_saved", ())}
        state = {name: part for name, part in vars(self).items() if name not in left_out}
        env = pickled_environment(self.env)
        if env is None:
            state["_start"] = None  # it will be reset
        return {
            "agent.pkl": pickled(state, self),
            "steps.pt": packed({**vars(self._data), "paths": self._paths}),
            "dynamics.pt": packed(self.task.dynamics.state_dict()),
            "environment.pkl": env or b"",
        }

    @classmethod
    def from_parts(cls, parts: dict[str, bytes], env: Any, task: Task) -> Self:
        """The agent that :meth:`saved_parts` saved."""
        steps = unpacked(parts["steps.pt"])
        task.dynamics.load_state_dict(unpacked(parts["dynamics.pt"]))
        agent = cls.__new__(cls)
        agent.task, agent._callbacks = task, []
        agent.env = cloudpickle.loads(parts["environment.pkl"]) if parts["environment.pkl"] else env
        agent._paths = steps.pop("paths")
        agent._data = Trajectories(**steps)
        vars(agent).update(unpickled(parts["agent.pkl"], agent))
        return agent


def layer_names(env: Any) -> list[str]:
    """The classes of an environment and of what it wraps, from the outside."""
    names = [type(env).__name__]
    held = getattr(env, "envs", None)  # of a vectorised environment, which are alike
    first = held[0] if isinstance(held, list) and held else None
    for inner in (getattr(env, "venv", None), getattr(env, "env", None), first):
        if inner is not None:
            return names + layer_names(inner)
    return names


def _no_steps(env: Any) -> Trajectories:
    """Return the steps of an agent that has made none."""
    observation, action = (
        torch.empty(0, *space.shape, dtype=torch.float64)
        for space in (env.observation_space, env.action_space)
    )
    rewards = torch.empty(0, dtype=torch.float64)
    return Trajectories(observation, action, observation, rewards, rewards, rewards.bool())
