"""A dynamics model as a vectorised environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
from torch import Tensor

from gpadjust.dynamics import Dynamics, TransitionFunctions
from gpadjust.rl.mixed_replay_buffer import CompactReplayBuffer
from gpadjust.rl.sound_steps import sound_steps

_CHUNK = 2000  # transitions at once, for the sake of memory

Reward = Callable[[Tensor, Tensor, Tensor], Tensor]
Termination = Callable[[Tensor], Tensor]
InitialStates = Callable[[int], Tensor]
Particles = Literal["independent", "functions"]


class ModelStep(NamedTuple):
    """What a step of all particles gave.

    Args:
        observations: ``num_envs x observation_dim``.
        rewards: ``num_envs``, as all that follows.
        terminated: Whether the state ended the trial.
        truncated: Whether the time limit or the bounds did.
        left_bounds: Whether the particle would have left the bounds.
    """

    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    left_bounds: np.ndarray


class ModelVecEnv(VecEnv):
    r"""Particles that move by a dynamics model, as a Stable-Baselines3 ``VecEnv``.

    A step of all particles is one call of the model. Its randomness is PyTorch's global generator.

    Args:
        dynamics: The model; it must be fitted.
        reward: Known rewards ``N`` of states ``N x state_dim``, actions ``N x action_dim`` and next
            states ``N x state_dim``, float64 tensors in the units of the spec.
        initial_states: Draws ``n`` states, ``n x state_dim``, at which trials start.
        num_envs: Number of particles.
        trial_length: Steps after which a trial is truncated.
        observation_space: The policy's, of the spec's observations.
        action_space: The policy's.
        terminated: Whether states ``N x state_dim`` end a trial, ``N`` booleans. Default: none.
        particles: ``"independent"``: each step is a draw of its own from the predictive
            distribution, as in the paper. ``"functions"``: between two calls of ``reset``, each
            particle follows a transition function of its own, drawn from the posterior, so that
            what it meets is consistent along its trajectory.
        bounds: Lower and upper bounds of the states, ``2 x state_dim``. A particle that would leave
            them or the finite numbers, or meets a failure of the physics, is truncated where it
            is: the step's next observation is the old one, its reward zero, its
            ``info["left_bounds"]`` True. Bounds give way to the states at which trials start.
            Default: infinite.

    Attributes:
        num_left_bounds: How many particles have left the bounds.

    Raises:
        ValueError: If spaces do not fit the spec, a number is not positive, or ``bounds`` have
            another shape.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        reward: Reward,
        initial_states: InitialStates,
        num_envs: int,
        trial_length: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        *,
        terminated: Termination | None = None,
        particles: Particles = "independent",
        bounds: Tensor | None = None,
    ) -> None:
        spec = dynamics.spec
        check_spaces(dynamics, observation_space, action_space)
        for name, number in (("num_envs", num_envs), ("trial_length", trial_length)):
            if number < 1:
                raise ValueError(f"{name} must be at least 1; found {number}.")
        if particles not in ("independent", "functions"):
            raise ValueError(f"Unknown particles {particles!r}; use 'independent' or 'functions'.")
        if bounds is not None and bounds.shape != (2, spec.state_dim):
            raise ValueError(
                f"bounds must be of shape 2 x {spec.state_dim}; found {tuple(bounds.shape)}."
            )
        self.render_mode = None
        super().__init__(num_envs, observation_space, action_space)
        self.dynamics = dynamics
        self.reward = reward
        self.initial_states = initial_states
        self.trial_length = trial_length
        self.terminated = terminated
        self.particles = particles
        self.bounds = bounds
        self.num_left_bounds = 0
        self._states = torch.empty(num_envs, spec.state_dim, dtype=torch.float64)
        self._steps = torch.zeros(num_envs, dtype=torch.long)
        self._functions: TransitionFunctions | None = None

    def reset(self) -> np.ndarray:
        """Start all trials; observations ``num_envs x observation_dim``."""
        self._states = self._draw_initial(self.num_envs)
        self._steps.zero_()
        if self.particles == "functions":
            self._functions = self.dynamics.sample_functions(self.num_envs)
        return self._observe(self._states)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions ``num_envs x action_dim`` of the next step, in the action space."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all particles; those whose trial ended start another."""
        step = self.transition(self._actions)
        dones = step.terminated | step.truncated
        observations = step.observations.copy()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in dones.nonzero()[0]:
            infos[i] = {
                "terminal_observation": step.observations[i],
                "TimeLimit.truncated": bool(step.truncated[i]),
                "left_bounds": bool(step.left_bounds[i]),
            }
        if dones.any():
            ended = torch.from_numpy(dones)
            self._states[ended] = self._draw_initial(int(dones.sum()))
            self._steps[ended] = 0
            observations[dones] = self._observe(self._states[ended])
        return observations, step.rewards, dones, infos

    def transition(self, actions: np.ndarray) -> ModelStep:
        """Step all particles, without a new start for those whose trial ended."""
        moves = torch.as_tensor(actions, dtype=torch.float64)
        self._states, rewards, terminated, left = self._outcome(self._states, moves)
        self._steps += 1
        self.num_left_bounds += int(left.sum())
        truncated = ((self._steps >= self.trial_length) | left) & ~terminated
        return ModelStep(
            self._observe(self._states),
            rewards.numpy().astype(np.float32),
            terminated.numpy(),
            truncated.numpy(),
            left.numpy(),
        )

    def refresh(self, buffer: CompactReplayBuffer) -> None:
        """Let the transitions in a buffer end anew, as the model now has it.

        The states and actions stay, and with them the time limits; where the model would leave the
        bounds, a transition stays as it was.

        Args:
            buffer: Transitions of an earlier model.
        """
        if not buffer.size():
            return
        if self.particles == "functions":
            self._functions = self.dynamics.sample_functions(self.num_envs)
        for rows in np.array_split(np.arange(buffer.size()), -(-buffer.size() // _CHUNK)):
            obs = torch.from_numpy(buffer.observations[rows, 0].astype(np.float64))
            assert isinstance(self.action_space, spaces.Box), "checked at the start"
            low, high = self.action_space.low, self.action_space.high
            scaled = buffer.actions[rows, 0].astype(np.float64)
            actions = torch.from_numpy(low + (scaled + 1) / 2 * (high - low))
            states = self.dynamics.spec.decode(obs)
            following, rewards, terminated, left = self._outcome(states, actions)
            kept = ~left.numpy()
            timeouts = buffer.timeouts[rows, 0].astype(bool) & ~terminated.numpy()
            for name, values in (
                ("next_observations", self._observe(following)),
                ("rewards", rewards.numpy()),
                ("dones", terminated.numpy() | timeouts),
                ("timeouts", timeouts),
            ):
                getattr(buffer, name)[rows[kept], 0] = values[kept]

    def _outcome(self, states: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Next states, rewards, termination, and who would have left the bounds."""
        following = sound_steps(self._move, states, actions)
        left = ~following.isfinite().all(-1)
        if self.bounds is not None:
            low, high = self.bounds
            left |= ((following < low) | (following > high)).any(-1)
        following = torch.where(left.unsqueeze(-1), states, following)
        rewards = per_particle(self.reward(states, actions, following), len(states), "reward")
        terminated = torch.zeros_like(left)
        if self.terminated is not None:
            terminated = per_particle(self.terminated(following), len(states), "terminated").bool()
        return following, rewards.masked_fill(left, 0.0), terminated & ~left, left

    def _move(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states of ``N`` rows, which follow the functions in blocks, if there are any."""
        functions = self._functions
        if functions is None:
            return self.dynamics.sample(states, actions)
        n, k = len(states), self.num_envs
        filled = torch.arange(-(-n // k) * k).clamp_max(n - 1)
        blocks = (rows[filled].reshape(k, -1, rows.shape[-1]) for rows in (states, actions))
        return functions(*blocks).flatten(0, 1)[:n]

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of this environment, once for each particle."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all particles."""
        if len(list(self._get_indices(indices))) < self.num_envs:
            raise ValueError("The particles share their attributes; set them for all at once.")
        setattr(self, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Refuse: there are no environments inside."""
        raise NotImplementedError(
            f"The particles of a ModelVecEnv have no methods of their own, such as {method_name!r}."
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """False for each particle."""
        return [False] * len(list(self._get_indices(indices)))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed PyTorch's global generator, from which all particles draw."""
        if seed is not None:
            torch.manual_seed(seed)
        return [None] * self.num_envs

    def _draw_initial(self, n: int) -> Tensor:
        states = torch.as_tensor(self.initial_states(n), dtype=torch.float64)
        if states.shape != (n, self.dynamics.spec.state_dim):
            raise ValueError(
                f"initial_states({n}) must return states of shape {n} x "
                f"{self.dynamics.spec.state_dim}; found {tuple(states.shape)}."
            )
        if self.bounds is not None:
            low, high = self.bounds
            room = torch.where((high - low).isfinite(), (high - low) / 2, 0.0)
            wider = (states < low) | (states > high)
            low = torch.where(wider.any(0), torch.minimum(low, states.amin(0) - room), low)
            high = torch.where(wider.any(0), torch.maximum(high, states.amax(0) + room), high)
            self.bounds = torch.stack([low, high])
        return states

    def _observe(self, states: Tensor) -> np.ndarray:
        return self.dynamics.spec.observe(states).numpy().astype(self.observation_space.dtype)


def per_particle(values: Tensor, n: int, name: str) -> Tensor:
    """Check what a function of the user's says of ``n`` rows."""
    values = torch.as_tensor(values).detach()
    if values.shape != (n,):
        raise ValueError(
            f"{name} must return one value per row, shape ({n},); found {tuple(values.shape)}."
        )
    if not values.isfinite().all():
        row = int((~values.isfinite()).nonzero()[0])
        raise ValueError(f"{name} returned {values[row]} for row {row}; expected finite numbers.")
    return values


def check_function(function: Any, name: str, num_arguments: int) -> None:
    """Raise a TypeError unless a function of the user's takes what it will be given, or is None."""
    if function is None:
        return
    if not callable(function):
        raise TypeError(f"{name} must be a function; found {function!r}.")
    try:
        signature = inspect.signature(function)
    except ValueError:  # some compiled functions have none
        return
    try:
        signature.bind(*range(num_arguments))
    except TypeError as error:
        raise TypeError(
            f"{name} is called with {num_arguments} argument(s); found {name}{signature}."
        ) from error


def check_spaces(
    dynamics: Dynamics, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """Raise a ValueError unless the spaces are boxes of the spec's observations and actions."""
    spec = dynamics.spec
    for name, space, size in (
        ("observation", observation_space, spec.observation_dim),
        ("action", action_space, spec.action_dim),
    ):
        if not isinstance(space, spaces.Box) or space.shape != (size,):
            raise ValueError(
                f"The spec of the dynamics says that the {name} has {size} entries, so a Box of "
                f"shape ({size},) is expected; found {space}. States: {tuple(spec.states)}, of "
                f"which angles (seen as sine and cosine): {tuple(spec.angles)}; actions: "
                f"{tuple(spec.actions)}."
            )
