"""The loop of an agent: play an episode, learn the dynamics, improve."""

from __future__ import annotations

import time
import warnings
from abc import abstractmethod
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
from gpadjust.control.checkpoint import (
    EpisodeCheckpoint,
    packed,
    pickled_environment,
    unpacked,
)
from gpadjust.control.pickled_agent import pickled, unpickled
from gpadjust.control.random_state import RandomState
from gpadjust.control.reach import random_sequences
from gpadjust.control.real_steps import RealStep, RealSteps
from gpadjust.control.recorded_episodes import RecordedEpisodes, learn_dynamics
from gpadjust.control.smoothed_episodes import smooth_episodes
from gpadjust.control.state_filter import StateFilter
from gpadjust.control.step_guard import StepGuard
from gpadjust.control.task import Task
from gpadjust.control.task_agent import TaskAgent, locked
from gpadjust.dynamics.free_run import checked_horizons

MAX_HOLD = 5  # steps of a random action

Callback = Callable[["Agent", str, dict[str, float]], Any]
"""What is called with the agent, the name of an event, and its numbers; see :class:`Agent`."""


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

    not_saved: ClassVar[tuple[str, ...]] = (
        "env",
        "_steps",
        "_callbacks",
        "_random_state",
    )
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
        self._steps = RealSteps(self.env.action_space)
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
        episode, begins, state = len(self._promises), True, None
        began, before, rewards = time.perf_counter(), self.num_timesteps, list[float]()
        self._promises.append(None)
        random = self._random_actions() if self.model is None else None
        getattr(self.action_noise, "reset", lambda: None)()
        while True:
            if random is not None:
                action = self._steps.scaled(next(random))
            else:
                asked = time.perf_counter()
                with self.timed("plan"):
                    choice, state = self._chosen(observation, state, np.array([begins]))
                noise = 0.0 if self.action_noise is None else self.action_noise()
                action = self._steps.scaled(choice, noise)
                if begins:
                    said = self._said(state)
                    self._promises[episode] = said.get("promised_reward")
                    self.tell("plan", {**said, "seconds": time.perf_counter() - asked})
            taken = self._steps.unscaled(action)
            following, reward, terminated, truncated, info = self.env.step(taken)
            self.num_timesteps += 1
            failed = bool(info.get("step_failed"))
            if not failed:
                row = (observation, action, following, float(reward), bool(terminated))
                self._steps.steps.append(RealStep(episode, *row))
                rewards.append(float(reward))
            self.tell("step", {"reward": float(reward)})
            whole = self.num_timesteps - before == self.task.episode_length
            if failed or terminated or truncated or whole:
                break
            observation, begins = following, False
        if not rewards:
            self._promises.pop()  # there is no step of it to compare
            return
        values: dict[str, float] = {"number": len(self._promises), "steps": len(rewards)}
        values |= {"reward": sum(rewards) / len(rewards), "seconds": time.perf_counter() - began}
        if (promised := self._promises[episode]) is not None:
            values["promised_reward"] = promised
        self.tell("trial", values)

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
        new = recorded.some(recorded.episode >= (self.num_episodes if dynamics.has_learnt else 0))
        if new.num_transitions < (1 if dynamics.is_fitted else 2):  # a first fit needs two
            self._is_improved &= new.num_transitions == 0  # there is another start
            return
        if self.reward_tolerance is not None and sensors is None:
            new.check(self.task, self.reward_tolerance)
        with self.timed("fit"):
            task = recorded.complete(self.task, self.episode_length(), self.action_bounds())
            values = learn_dynamics(task, new, recorded, self.score_horizons)
        bounds = None if self.model is None else self.model.state_bounds
        if bounds is not None and self.task.state_bounds is None:
            new.warn_of_bounds(bounds)
        self.model, self._is_improved = None, False  # it is not the newest any more
        real = recorded.rewards[recorded.episode >= self.num_episodes].mean()
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
        seen = self._steps.seen()
        if not seen:
            return
        newest = self.task.dynamics.before_data()
        assert newest is not None, "checked at the start"
        task = replace(self.task, dynamics=newest)
        known = self.filter
        assert known is not None, "there are sensors"
        self._filter, self._steps.paths = smooth_episodes(task, known, seen, len(seen))

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

    def recorded_episodes(self, newest: int | None = None) -> RecordedEpisodes:
        """The real steps; or the newest of them only.

        With sensors the states are drawn from what is known of them since they were last learnt.
        """
        return self._steps.recorded(self.task, newest)

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
            sequences = random_sequences(1, num_steps, bounds, MAX_HOLD)
            if rate is not None:
                sequences = rate.limited(sequences, before)
            for action in sequences[0]:
                yield action.numpy().astype(self.env.action_space.dtype)
            num_steps, before = 1, sequences[0, -1]

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
            "steps.pt": packed(self._steps.state_dict()),
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
        agent._steps = RealSteps.of(steps, agent.env.action_space)
        vars(agent).update(unpickled(parts["agent.pkl"], agent))
        return agent
