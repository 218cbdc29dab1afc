"""A dynamics model as a vectorised environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
from torch import Tensor

from gpadjust.checks import check_choice, checked_whole
from gpadjust.control import Moment, Steps, Task
from gpadjust.dynamics import TransitionFunctions
from gpadjust.physics import PhysicsError

_CHUNK = 2000  # transitions at once, for memory

Sampling = Literal["step", "trajectory"]


class ModelStep(NamedTuple):
    """Result of a step of ``n`` particles: observations ``n x d``, and ``n`` numbers each."""

    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray  # by the state
    truncated: np.ndarray  # by the time limit or the bounds
    left_bounds: np.ndarray


class ModelVecEnv(VecEnv):
    r"""Particles that move by a dynamics model, as a Stable-Baselines3 ``VecEnv``.

    A step of all particles is one call of the model. Random numbers come from PyTorch's global
    generator.

    Leaving the bounds is never an advantage. A particle that would leave the bounds of the task or
    the finite numbers, or where the physics fails, stops, and its episode ends, with
    ``info["left_bounds"]`` and the worst reward so far. If that is negative the episode is
    truncated, as its learner then adds the value of the last state; else it is terminated.

    Args:
        task: The task, with fitted dynamics, initial states and an episode length. Its bounds are
            widened to the initial states.
        num_envs: Number of particles.
        observation_space: The policy's space of the spec's observations.
        action_space: The policy's action space.
        sampling: ``"step"``: a new draw from the predictive distribution in each step, as in the
            paper. ``"trajectory"``: between two calls of ``reset``, a transition function drawn
            from the posterior for each particle. (Chua et al. 2018.)
        worst_reward: The worst reward elsewhere, such as in real episodes.

    Attributes:
        episode_length: Steps after which an episode is truncated.
        num_left_bounds: Number of particles that have left the bounds.
        worst_reward: The worst reward so far; infinite before the first.

    Raises:
        RuntimeError: Before the first update of the dynamics.
        ValueError: If the task is incomplete, spaces do not fit the spec, or a number is out of
            range.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        sampling: Sampling = "step",
        worst_reward: float = np.inf,
    ) -> None:
        task.refuse("ModelVecEnv", "sensors", "MPCAgent and PolicySearchAgent can")
        task.check_spaces(observation_space, action_space)
        if not task.dynamics.is_fitted:
            raise RuntimeError(
                f"{type(task.dynamics).__name__} has not learnt from transitions yet; call "
                "`update`."
            )
        for name in ("initial_states", "episode_length"):
            if getattr(task, name) is None:
                raise ValueError(f"A ModelVecEnv needs a task with {name}; found None.")
        check_choice("sampling", sampling, get_args(Sampling))
        self.render_mode = None
        super().__init__(checked_whole("num_envs", num_envs, 1), observation_space, action_space)
        self.task = task
        self.episode_length: Any = task.episode_length
        self.sampling, self.worst_reward = sampling, worst_reward
        self.num_left_bounds = 0
        self._states = torch.empty(num_envs, task.dynamics.spec.state_dim, dtype=torch.float64)
        self._steps = torch.zeros(num_envs, dtype=torch.long)
        self._functions: TransitionFunctions | None = None
        self._is_followed = True  # if True, `reset` draws new functions

    def reset(self) -> np.ndarray:
        """Start all episodes; observations ``num_envs x observation_dim``."""
        self._start(torch.ones(self.num_envs, dtype=torch.bool))
        if self._is_followed:
            self._draw_functions()
        return self._observe(self._states)

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions ``num_envs x action_dim`` of the next step, in the action space."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all particles; start a new episode where one has ended."""
        step = self.transition(self._actions)
        dones = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in dones.nonzero()[0]:
            infos[i] = {
                "terminal_observation": step.observations[i],
                "TimeLimit.truncated": bool(step.truncated[i]),
                "left_bounds": bool(step.left_bounds[i]),
            }
        if not dones.any():
            return step.observations, step.rewards, dones, infos
        self._start(torch.from_numpy(dones))
        return self._observe(self._states), step.rewards, dones, infos

    def transition(self, actions: np.ndarray) -> ModelStep:
        """Step all particles, without new episodes."""
        self._is_followed = True
        moves = torch.as_tensor(actions, dtype=torch.float64)
        step = self._step(self.task, self._states, moves, Moment(self._steps))
        self._states = step.next_states
        self._steps += 1
        self.num_left_bounds += int(step.left_bounds.sum())
        # A time limit, or a particle that stopped: the last state has a value.
        truncated = ((self._steps >= self.episode_length) | step.left_bounds) & ~step.terminated
        rewards = step.rewards.numpy().astype(np.float32)
        ends = (part.numpy() for part in (step.terminated, truncated, step.left_bounds))
        return ModelStep(self._observe(self._states), rewards, *ends)

    @property
    def steps_ahead(self) -> np.ndarray:
        """The number of steps of each particle before the time limit, ``num_envs``."""
        return self.episode_length - self._steps.numpy()

    def refresh(self, buffer: ReplayBuffer) -> None:
        """Predict the transitions in a buffer again, by the present model.

        States, actions and time limits do not change.
        """
        if not buffer.size():
            return
        self._draw_functions()
        spec = self.task.dynamics.spec
        space = self.action_space
        assert isinstance(space, spaces.Box), "checked at the start"
        for rows in np.array_split(np.arange(buffer.size()), -(-buffer.size() // _CHUNK)):
            obs, next_obs, scaled = (
                torch.from_numpy(column[rows, 0].astype(np.float64))
                for column in (buffer.observations, buffer.next_observations, buffer.actions)
            )
            low, high = (torch.from_numpy(bound).double() for bound in (space.low, space.high))
            states = spec.decode(obs)
            task = self.task = self.task.widened(states)
            if task.reference is not None:  # the numbers of the steps are not in the buffer
                set_points = spec.decode(next_obs)[:, spec.exogenous_columns]
                task = replace(task, reference=partial(_recorded, set_points))
            # Actions in the buffer are in [-1, 1].
            step = self._step(task, states, low + (scaled + 1) / 2 * (high - low), Moment())
            terminated = step.terminated.numpy()
            limits = buffer.timeouts[rows, 0].astype(bool) | step.left_bounds.numpy()
            buffer.next_observations[rows, 0] = self._observe(step.next_states)
            buffer.rewards[rows, 0] = step.rewards.numpy()
            buffer.dones[rows, 0] = terminated | limits
            buffer.timeouts[rows, 0] = limits & ~terminated

    def _step(self, task: Task, states: Tensor, actions: Tensor, moment: Moment) -> Steps:
        """Return a step of a task, with the worst reward for leaving the bounds."""
        step = task.step(states, actions, moment, move=self._move)
        self.worst_reward = min(self.worst_reward, float(step.rewards.min()))
        if not step.left_bounds.any():
            return step
        rewards = step.rewards.double().masked_fill(step.left_bounds, self.worst_reward)
        # With positive rewards, the value of the last state would make leaving an advantage.
        terminal = step.left_bounds & (self.worst_reward >= 0)
        return step._replace(rewards=rewards, terminated=step.terminated | terminal)

    def _draw_functions(self) -> None:
        """Draw a transition function for each particle, if they follow functions."""
        if self.sampling == "trajectory":
            self._functions = self.task.dynamics.sample_functions(self.num_envs)
            self._is_followed = False

    def _move(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return next states of ``N`` rows, with a block of rows for each function."""
        if self._functions is None:
            return self.task.dynamics.sample(states, actions)
        n, k = len(states), self.num_envs
        # Blocks of equal size: the last row fills the last block.
        places = torch.arange(-(-n // k) * k).clamp_max(n - 1)
        blocks = (rows[places].reshape(k, -1, rows.shape[-1]) for rows in (states, actions))
        try:
            return self._functions(*blocks).flatten(0, 1)[:n]
        except PhysicsError as error:
            error.rows = tuple(sorted({min(row, n - 1) for row in error.rows}))
            raise

    def _start(self, mask: Tensor) -> None:
        """Start episodes of some particles, by a mask ``num_envs``."""
        states = self.task.draw_initial_states(int(mask.sum()))
        self.task = self.task.widened(states)
        self._steps = self._steps.masked_fill(mask, 0)
        self._states = self._states.clone()  # a step of the task may share its memory
        self._states[mask] = states

    def _observe(self, states: Tensor) -> np.ndarray:
        """Return observations in the type of the space."""
        observations: np.ndarray = self.task.dynamics.spec.observe(states).numpy()
        return observations.astype(self.observation_space.dtype)

    # Other methods of a VecEnv

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed PyTorch's global generator, from which all particles draw."""
        if seed is not None:
            torch.manual_seed(seed)
        return [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the attribute of this environment for each particle."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all particles."""
        if len(list(self._get_indices(indices))) < self.num_envs:
            raise ValueError("The particles share their attributes; set them for all at once.")
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Raise an error: there are no environments inside."""
        raise NotImplementedError(f"Particles have no methods, such as {method_name!r}.")

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each particle."""
        return [False for _ in self._get_indices(indices)]

    def close(self) -> None:
        """Do nothing, as there is nothing to close."""


def _recorded(set_points: Tensor, states: Tensor, steps: Tensor) -> Tensor:
    """Return recorded set-points, in the form of a task's ``reference``."""
    return set_points
