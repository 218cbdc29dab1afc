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

_CHUNK = 2000  # transitions at once, for the sake of memory

Sampling = Literal["step", "trajectory"]


class ModelStep(NamedTuple):
    """Result of a step of ``n`` particles: observations ``n x d``, and ``n`` of all else."""

    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray  # by the state
    truncated: np.ndarray  # by the time limit or the bounds
    left_bounds: np.ndarray


class ModelVecEnv(VecEnv):
    r"""Particles that move by a dynamics model, as a Stable-Baselines3 ``VecEnv``.

    Any algorithm of Stable-Baselines3 can learn in it. A step of all particles is one call of the
    model. Its randomness is PyTorch's global generator.

    Leaving the bounds never pays: a particle that would leave the bounds of the task or the finite
    numbers, or meets a failure of the physics, stays where it is, and its episode ends, with
    ``info["left_bounds"]`` and the worst reward that was seen. If that is negative the episode is
    truncated, as its learner goes on valuing the state where it stayed; else it is terminated.

    Args:
        task: What is known; its dynamics must be fitted, and it must say where episodes start and
            how long they are. Its bounds give way to the states at which episodes start.
        num_envs: Number of particles.
        observation_space: The policy's, of the spec's observations.
        action_space: The policy's.
        sampling: ``"step"``: each step is a draw of its own from the predictive distribution, as
            in the paper. ``"trajectory"``: between two calls of ``reset``, each particle follows a
            transition function of its own, drawn from the posterior. (In the terms of PETS,
            trajectory sampling 1 and infinity; Chua et al. 2018.)
        worst_reward: The worst reward seen elsewhere, such as in real episodes.

    Attributes:
        episode_length: Steps after which an episode is truncated.
        num_left_bounds: How many particles have left the bounds.
        worst_reward: The worst reward seen so far; infinite before the first.

    Raises:
        RuntimeError: If the dynamics have learnt nothing yet.
        ValueError: If the task leaves something open, spaces do not fit the spec, or a number is
            out of range.
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
        self.sampling = sampling
        self.worst_reward = worst_reward
        self.num_left_bounds = 0
        self._states = torch.empty(num_envs, task.dynamics.spec.state_dim, dtype=torch.float64)
        self._steps = torch.zeros(num_envs, dtype=torch.long)
        self._functions: TransitionFunctions | None = None
        self._is_followed = True  # whether particles have followed them already

    def reset(self) -> np.ndarray:
        """Start all episodes; observations ``num_envs x observation_dim``."""
        self._start(torch.ones(self.num_envs, dtype=torch.bool))
        if self._is_followed:
            self._draw_functions()
        return self._observe(self._states)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions ``num_envs x action_dim`` of the next step, in the action space."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all particles; those whose episode ended start another."""
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
        """Step all particles, without a new start for those whose episode ended."""
        self._is_followed = True
        moves = torch.as_tensor(actions, dtype=torch.float64)
        step = self._step(self.task, self._states, moves, Moment(self._steps))
        self._states = step.next_states
        self._steps += 1
        self.num_left_bounds += int(step.left_bounds.sum())
        truncated = ((self._steps >= self.episode_length) | step.left_bounds) & ~step.terminated
        rewards = step.rewards.numpy().astype(np.float32)
        ends = (part.numpy() for part in (step.terminated, truncated, step.left_bounds))
        return ModelStep(self._observe(self._states), rewards, *ends)

    def steps_ahead(self) -> np.ndarray:
        """Return the steps of each particle before the time limit, ``num_envs``."""
        return self.episode_length - self._steps.numpy()

    def refresh(self, buffer: ReplayBuffer) -> None:
        """Predict the transitions of an earlier model in a buffer again, by the model as it is now.

        The states and actions stay, and with them the time limits.
        """
        if not buffer.size():
            return
        self._draw_functions()
        space, spec = self.action_space, self.task.dynamics.spec
        assert isinstance(space, spaces.Box), "checked at the start"
        for rows in np.array_split(np.arange(buffer.size()), -(-buffer.size() // _CHUNK)):
            obs, after, scaled = (
                torch.from_numpy(column[rows, 0].astype(np.float64))
                for column in (buffer.observations, buffer.next_observations, buffer.actions)
            )
            low, high = (torch.from_numpy(bound).double() for bound in (space.low, space.high))
            states = spec.decode(obs)
            task = self.task = self.task.widened(states)
            if task.reference is not None:  # the numbers of the steps are not in the buffer
                ahead = spec.decode(after)[:, spec.exogenous_columns]
                task = replace(task, reference=partial(_recorded, ahead))
            step = self._step(task, states, low + (scaled + 1) / 2 * (high - low), Moment())
            terminated = step.terminated.numpy()
            limits = buffer.timeouts[rows, 0].astype(bool) | step.left_bounds.numpy()
            buffer.next_observations[rows, 0] = self._observe(step.next_states)
            buffer.rewards[rows, 0] = step.rewards.numpy()
            buffer.dones[rows, 0] = terminated | limits
            buffer.timeouts[rows, 0] = limits & ~terminated

    def _step(self, task: Task, states: Tensor, actions: Tensor, moment: Moment) -> Steps:
        """Return a step of a task, in which leaving the bounds is the worst that can be."""
        step = task.step(states, actions, moment, move=self._move)
        self.worst_reward = min(self.worst_reward, float(step.rewards.min()))
        if not step.left_bounds.any():
            return step
        rewards = step.rewards.double().masked_fill(step.left_bounds, self.worst_reward)
        terminal = step.left_bounds & (self.worst_reward >= 0)
        return step._replace(rewards=rewards, terminated=step.terminated | terminal)

    def _draw_functions(self) -> None:
        if self.sampling == "trajectory":
            self._functions = self.task.dynamics.sample_functions(self.num_envs)
            self._is_followed = False

    def _move(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return next states of ``N`` rows, which follow functions, if there are any, in blocks."""
        if self._functions is None:
            return self.task.dynamics.sample(states, actions)
        n, k = len(states), self.num_envs
        filled = torch.arange(-(-n // k) * k).clamp_max(n - 1)
        blocks = (rows[filled].reshape(k, -1, rows.shape[-1]) for rows in (states, actions))
        try:
            return self._functions(*blocks).flatten(0, 1)[:n]
        except PhysicsError as error:
            error.rows = tuple(sorted({min(row, n - 1) for row in error.rows}))
            raise

    def _start(self, which: Tensor) -> None:
        """Start episodes of some particles, ``num_envs`` booleans."""
        states = self.task.draw_initial_states(int(which.sum()))
        self.task = self.task.widened(states)
        self._states, self._steps = self._states.clone(), self._steps.masked_fill(which, 0)
        self._states[which] = states

    def _observe(self, states: Tensor) -> np.ndarray:
        observations: np.ndarray = self.task.dynamics.spec.observe(states).numpy()
        return observations.astype(self.observation_space.dtype)

    # What else Stable-Baselines3 asks of a VecEnv

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed PyTorch's global generator, from which all particles draw."""
        if seed is not None:
            torch.manual_seed(seed)
        return [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the attribute of this environment, once for each particle."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all particles."""
        if len(list(self._get_indices(indices))) < self.num_envs:
            raise ValueError("The particles share their attributes; set them for all at once.")
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Refuse: there are no environments inside."""
        raise NotImplementedError(
            f"Particles have no methods of their own, such as {method_name!r}."
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each particle."""
        return [False for _ in self._get_indices(indices)]

    def close(self) -> None:
        """Close nothing."""


def _recorded(set_points: Tensor, states: Tensor, steps: Tensor) -> Tensor:
    """Return set-points that were recorded."""
    return set_points
