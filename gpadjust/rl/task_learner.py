"""An off-policy learner that knows its task."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from copy import deepcopy
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import (
    MaybeCallback,
    TensorDict,
    TrainFreq,
    TrainFrequencyUnit,
)
from torch import Tensor

from gpadjust.control import Task
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.rl.model_vec_env import check_spaces
from gpadjust.rl.random_state import RandomState
from gpadjust.rl.recorded_episodes import RecordedEpisodes

_NOT_SAVED = ("task", "held", "_random_state", "_unread_dynamics", "_is_learning")


class TaskLearner(OffPolicyAlgorithm):
    """An off-policy learner of Stable-Baselines3 that knows its :class:`~gpadjust.control.Task`.

    It checks the task before the first real step, reads real episodes in the task's units, and
    saves what the dynamics learnt with its own parameters. The task itself is not saved.

    Args:
        task: The task; None for an agent that only predicts.
        args: Further arguments of the learner.
        kwargs: Further arguments of the learner.

    Attributes:
        task: The task; to change a part of it, set another one.
        wall_time: Seconds spent on each part of the work.
        held: While it learns, what is closed in the end, such as locks of callbacks.
        notes: What you want to keep with the agent, in plain values; saved and resumed with it.
    """

    replay_buffer: MixedReplayBuffer
    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(self, task: Task | None, *args: Any, **kwargs: Any) -> None:
        self.task = task
        self.wall_time: dict[str, float] = {}
        self.notes: dict[str, Any] = {}
        self._known = _known(task)
        self._num_stored = 0  # of the time steps, how many came into the buffer
        self._random_state: RandomState | None = None
        self._is_learning = False
        self.held = ExitStack()
        self._unread_dynamics: dict[str, Any] = {}  # of an agent that was loaded without a task
        if kwargs.get("_init_setup_model", True):
            self.ready_task()
        super().__init__(*args, **kwargs)

    def ready_task(self) -> Task:
        """The task, if the agent can learn with it.

        Raises:
            ValueError: If it is missing, or lacks what it had when the agent was made.
            TypeError: If it is of another kind.
        """
        name = type(self).__name__
        if self.task is None:
            raise ValueError(
                f"{name} needs a task to learn; found None. Pass task=Task(dynamics, reward, ...) "
                f"to {name} or, as it is not saved, to {name}.load. Without it the agent can only "
                "predict."
            )
        if not isinstance(self.task, Task):
            raise TypeError(f"task must be a Task(dynamics, reward, ...); found {self.task!r}.")
        missing = [part for part in self._known if part not in _known(self.task)]
        if missing:
            raise ValueError(
                f"{name} was made with a task that has {missing[0]}, which is None now; give it to "
                "the task again."
            )
        return self.task

    def recorded_episodes(self, newest: int | None = None) -> RecordedEpisodes:
        """The real transitions in the buffer; or the newest steps of each environment only."""
        spec = self.ready_task().dynamics.spec
        return RecordedEpisodes(self.replay_buffer, self.policy, spec, newest)

    def model_task(self) -> Task:
        """The task, with what environment and real episodes tell where it says nothing.

        Raises:
            ValueError: If nobody says how long an episode is.
        """
        task = self.ready_task()
        recorded = self.recorded_episodes()
        found: dict[str, Any] = {"episode_length": self.episode_length()}
        if recorded.num_transitions:
            found |= {"initial_states": recorded.draw_starts, "state_bounds": recorded.bounds()}
        return replace(task, **{k: v for k, v in found.items() if getattr(task, k) is None})

    def episode_length(self) -> int:
        """Steps of an episode: those of the task, or else the time limit of the environment.

        Raises:
            ValueError: If there is neither.
        """
        task = self.ready_task()
        if task.episode_length is not None:
            return task.episode_length
        if self.env is None:
            raise ValueError(
                "Nobody says how long an episode is; give the task an episode_length, or the agent "
                "an environment: load(..., env=env)."
            )
        spec = self.env.get_attr("spec")[0]
        length = None if spec is None else spec.max_episode_steps
        if length is None:
            # A TimeLimit that was put around an environment by hand.
            with suppress(AttributeError):
                length = self.env.get_attr("_max_episode_steps")[0]
        if length is None:
            raise ValueError(
                "The environment has no time limit that could be read; give the task an "
                "episode_length, the number of steps of an episode."
            )
        return int(length)

    def last_states(self) -> Tensor:
        """Where the real environments are, ``n_envs x state_dim``."""
        return self.ready_task().dynamics.spec.decode(self._last_observations())

    def _last_observations(self) -> Tensor:
        """What the real environments have shown last, ``n_envs x observation_dim``."""
        seen = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        assert isinstance(seen, np.ndarray), "observations are boxes"
        return torch.from_numpy(seen.astype(np.float64))

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add what is done inside to a part of ``wall_time``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.wall_time[part] = self.wall_time.get(part, 0.0) + spent

    def _on_step(self) -> None:
        """Remember that the step was stored."""
        super()._on_step()
        self._num_stored = self.num_timesteps

    def _setup_model(self) -> None:
        """Check the spaces before SB3 builds its networks on them."""
        if self.task is not None:
            check_spaces(self.task.dynamics.spec, self.observation_space, self.action_space)
        super()._setup_model()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """Refuse to spend a real episode on an agent that could not learn from it."""
        task = self.ready_task()
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
        self.episode_length()
        if self.replay_buffer.buffer_size < self.episode_length():
            raise ValueError(
                f"buffer_size must hold an episode of {self.episode_length()} steps, for the "
                "dynamics to learn it; found room for "
                f"{self.replay_buffer.buffer_size} of each environment."
            )
        if self._num_stored != self.num_timesteps:
            # A callback stopped the last call at a step that SB3 made, but did not store.
            self._last_obs = None
        if reset_num_timesteps or self._last_obs is None:
            self.environments_reset()  # SB3 ends the episodes under way
        if self._unread_dynamics:
            task.dynamics.load_state_dict(self._unread_dynamics)
            self._unread_dynamics = {}
        noise = deepcopy(self.action_noise)  # which SB3 resets
        result = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        self._num_stored = self.num_timesteps
        before = RandomState.capture()
        task.dynamics.spec.check_observations(self._last_observations())
        states = self.last_states()
        # Of a single state much would look right that is not.
        twice = torch.cat([states, states])
        task.rehearse(twice, self._middle_action().expand(len(twice), -1))
        before.restore()
        if self._random_state is not None:  # a run that goes on
            self._random_state.restore()
            self.action_noise = noise
        self._random_state = None
        self._is_learning = True
        return result

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """As in SB3; after an error the next call resets the environments, wherever they are."""
        self._is_learning = False
        with ExitStack() as self.held:
            try:
                return super().learn(*args, **kwargs)
            except BaseException:
                if self._is_learning:
                    self._last_obs = None
                raise

    def environments_reset(self) -> None:
        """Called before all environments are reset, wherever they are."""
        self.replay_buffer.end_episodes(np.ones(self.n_envs, dtype=bool))

    def _middle_action(self) -> Tensor:
        """An action in the middle of the action space."""
        return torch.from_numpy((self.action_space.low + self.action_space.high) / 2).double()

    # Saving

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """As in SB3, with the state of the dynamics."""
        learnt = self._unread_dynamics
        if self.task is not None and not learnt:
            learnt = self.task.dynamics.state_dict()
        return {**super().get_parameters(), "dynamics": learnt}

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """As in SB3; without a task, the state of the dynamics is kept for the next ``save``.

        Raises:
            ValueError: As in SB3, if something is missing, unless ``exact_match`` is False.
            RuntimeError: If the state is of other dynamics, or of another physics.
        """
        if isinstance(load_path_or_dict, dict):
            parameters: dict[str, Any] = dict(load_path_or_dict)
        else:
            parameters = load_from_zip_file(load_path_or_dict, device=device, load_data=False)[1]
        if exact_match and "dynamics" not in parameters:
            raise ValueError(
                "Expected parameters with the state of the dynamics, 'dynamics'; found "
                f"{sorted(parameters)}. Pass exact_match=False to take the networks alone."
            )
        state = _on_cpu(parameters.pop("dynamics", None))
        if state is None or self.task is None:
            super().set_parameters(parameters, exact_match, device)
            self._unread_dynamics = self._unread_dynamics if state is None else state
            return
        before = self.task.dynamics.state_dict()
        self.task.dynamics.load_state_dict(state)
        try:
            super().set_parameters(parameters, exact_match, device)
        except BaseException:
            self.task.dynamics.load_state_dict(before)
            raise

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *_NOT_SAVED]


def _known(task: Task | None) -> list[str]:
    """The functions that a task may have and this one has."""
    names = ("terminated", "initial_states")
    return [name for name in names if getattr(task, name, None) is not None]


def _on_cpu(state: Any) -> Any:
    """A state of dynamics, which SB3 loads to the device of the networks, where they compute."""
    if isinstance(state, dict):
        return {name: _on_cpu(part) for name, part in state.items()}
    return state.cpu() if torch.is_tensor(state) else state
