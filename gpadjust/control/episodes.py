"""Real episodes: their steps, and what they add to a task."""

from __future__ import annotations

import random
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from gpadjust.checks import seeded
from gpadjust.control.rollouts import Rollouts, random_sequences
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec

_LARGEST = 1e25  # no quantity of a machine, nor its square, is as large in a usual unit
_REACH = 10.0  # half ranges of the recorded states, from their middle to the bounds
_MOST = 10.0  # largest factor of this distance for the states that the physics reaches
_EPISODES = 64  # episodes of random actions in the physics

Row = tuple[Any, ...]
"""A real step: observation, action, next observation, reward, and True if it terminated."""

# Observations and steps


def fault(observation: ArrayLike, reward: Any = 0.0, names: Sequence[str] = ()) -> str:
    """Return a message on a number that cannot be data, or an empty text."""
    for name, values in (("observation", observation), ("reward", reward)):
        numbers = np.asarray(values, dtype=np.float64)
        for place in np.argwhere(~(np.abs(numbers) <= _LARGEST)):  # True for NaN, too
            entry = f"entry {', '.join(map(str, place))} of the " if len(place) else "the "
            if len(place) == 1 and place[0] < len(names):
                entry = f"{names[place[0]]!r}, {entry}"
            return (
                f"{entry}{name} is {numbers[tuple(place)]:g}, where a finite number of at most "
                f"{_LARGEST:g} is expected (a larger quantity needs another unit)"
            )
    return ""


def check_observation(
    observation: ArrayLike, problem: str = "No action can be chosen", names: Sequence[str] = ()
) -> None:
    """Raise a ValueError that begins with a problem, if an observation cannot be data."""
    message = fault(observation, names=names)
    if message:
        raise ValueError(f"{problem}: {message}. Stop the machine, or wait for a good observation.")


def recorded(rows: Sequence[Row]) -> Trajectories:
    """Return the steps of an episode, with observations in the place of states."""
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    before, actions, after, rewards, terminated = map(torch.from_numpy, columns)
    return Trajectories(before, actions, after, torch.zeros(len(rows)), rewards, terminated.bool())


def nothing(width: int, action_dim: int) -> Trajectories:
    """Return no steps, of states or observations with ``width`` entries."""
    states, actions = (torch.empty(0, size, dtype=torch.float64) for size in (width, action_dim))
    none = torch.empty(0, dtype=torch.float64)
    return Trajectories(states, actions, states, none, none, none.bool())


def decoded(spec: StateSpec, data: Trajectories) -> Trajectories:
    """Return trajectories of observations as trajectories of states."""
    states, next_states = spec.decode(data.states), spec.decode(data.next_states)
    return replace(data, states=states, next_states=next_states)


def newest(data: Trajectories, steps: int | None) -> Trajectories:
    """Return the newest steps; None for all."""
    return data if steps is None else data.subset(slice(max(len(data) - steps, 0), None))


# What environment and episodes add to a task


def action_bounds(env: Any) -> Tensor:
    """Return lower and upper bounds of the actions, ``2 x action_dim``."""
    space = env.action_space
    return torch.from_numpy(np.stack([space.low, space.high]).astype(np.float64))


def episode_length(task: Task, env: Any) -> int:
    """Return the steps of an episode: of the task, or else the time limit of the environment."""
    length = task.episode_length
    for name in ("spec", "_max_episode_steps"):  # the latter of a TimeLimit that the user added
        if length is None:
            with suppress(AttributeError):
                is_vector = hasattr(env, "num_envs")
                limit = env.get_attr(name)[0] if is_vector else env.get_wrapper_attr(name)
                length = getattr(limit, "max_episode_steps", limit)
    if length is None:
        raise ValueError("The environment has no time limit; give the task an episode_length.")
    return int(length)


def completed(task: Task, data: Trajectories, env: Any) -> Task:
    """Return a task with length, starts and bounds of environment and episodes if it lacks them."""
    length = episode_length(task, env)
    parts: dict[str, Any] = {"episode_length": length}
    if len(data):
        starts = data.states[data.steps == 1]
        draw = lambda n: starts[torch.randint(len(starts), (n,))]  # noqa: E731
        parts["initial_states"] = task.initial_states or draw
        if task.state_bounds is None:
            physics = task.dynamics.physics_alone()
            reached: Any = physics and _reach(physics, starts, action_bounds(env), length)
            parts["state_bounds"] = far_bounds(task.dynamics.spec, data, reached)
    return replace(task, **parts)


def far_bounds(spec: StateSpec, data: Trajectories, reached: Tensor | None = None) -> Tensor:
    """Return bounds ``2 x state_dim`` far beyond the states of real episodes.

    They are infinite for angles, constants and previous values, and include the states that the
    physics reached, ``2 x state_dim``, up to a hundred half ranges, as a physics may run away.
    """
    states = torch.cat([data.states, data.next_states])
    low, high = states.amin(0), states.amax(0)
    middle, room = (low + high) / 2, _REACH * (high - low) / 2
    room[high == low] = torch.inf  # a state that has not moved yet
    free = {*spec.angles, *spec.exogenous, *spec.previous}
    room[[i for i, name in enumerate(spec.states) if name in free]] = torch.inf
    low, high = middle - room, middle + room
    if reached is not None:
        beyond = (reached[1] - reached[0]) / 2
        low = torch.minimum(low, (reached[0] - beyond).maximum(middle - _MOST * room))
        high = torch.maximum(high, (reached[1] + beyond).minimum(middle + _MOST * room))
    return torch.stack([low, high])


@torch.no_grad()
def _reach(physics: Dynamics, starts: Tensor, bounds: Tensor, num_steps: int) -> Tensor:
    """Return least and greatest states in a physics at random actions, half at their bounds."""
    low, high = bounds
    with seeded(0):
        sequences = random_sequences(_EPISODES, num_steps, bounds, num_steps)
    extreme = torch.where(sequences > (low + high) / 2, high, low)
    sequences[::2] = extreme[::2]
    states = starts[torch.linspace(0, len(starts) - 1, _EPISODES).round().long()]
    task = Task(physics, lambda states, actions, next_states: 0 * states[:, 0])
    with suppress(PhysicsError):
        run = Rollouts(task, None).follow(states, sequences)
        states = torch.cat([states, run.next_states[run.made]])
    return torch.stack([states.amin(0), states.amax(0)])


def try_task(task: Task, observations: np.ndarray, env: Any) -> None:
    """Call the task's functions at observations ``N x observation_dim`` and a middle action."""
    episode_length(task, env)
    observed = torch.from_numpy(observations.astype(np.float64))
    task.observed.check_observations(observed)
    before = generators()
    if task.sensors is None:  # two rows, as many a wrong shape looks right with one
        states = task.dynamics.spec.decode(observed).repeat(2, 1)
    else:
        states = task.draw_initial_states(2)
    task.try_functions(states, action_bounds(env).mean(0).expand(len(states), -1))
    set_generators(before)


# Generators


def generators() -> tuple[Any, ...]:
    """Return the state of the global generators of Python, NumPy, PyTorch and its devices."""
    devices = torch.cuda.get_rng_state_all()
    return random.getstate(), np.random.get_state(), torch.get_rng_state(), devices  # noqa: NPY002


def set_generators(state: tuple[Any, ...]) -> None:
    """Set the global generators to a state."""
    random.setstate(state[0])
    np.random.set_state(state[1])  # noqa: NPY002
    torch.set_rng_state(state[2])
    if state[3] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state[3])
