"""A machine: its equation of motion, the true parameters, and those that are believed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.physics import ODEPhysics, Unknown
from gpadjust.states import StateSpec
from gpadjust.systems import System

Physics = Literal["crude", "unknown", "true"]
"""What is given as f_p: the crude one, the same with unknown parameters, or the true system."""
Rates = Callable[[Tensor, Tensor, Mapping[str, Any]], Tensor]
Reward = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Machine:
    """A real system and what is believed of it."""

    spec: StateSpec  # what states and actions are, with the duration of a step
    rates: Rates  # its equation of motion
    true: Mapping[str, float]  # the parameters of the real system
    # Those that f_p has, with the crude value as the guess; the others are zero there.
    believed: Mapping[str, Unknown]
    reward: Reward  # known rewards, in [-1, 0]
    actions: tuple[list[float], list[float]]  # the least and the largest values of the actions
    # The least and the largest values of the states at which episodes start.
    starts: tuple[list[float], list[float]]
    episode_length: int  # in steps
    # Of the integration of f_p, in a step; the real one, whose friction is stiff, has twice as
    # many.
    substeps: int = 2
    # The least and the largest values that states can have, if that is known.
    bounds: tuple[list[float], list[float]] | None = None
    # The environment; `MachineEnv` unless there is another.
    env: Callable[..., gym.Env[Any, Any]] | None = None

    def physics(self, kind: Physics = "crude") -> ODEPhysics:
        """Return the physics of the next values of the states that move."""
        guesses = {name: known.guess for name, known in self.believed.items()}
        fixed = self.true if kind == "true" else dict.fromkeys(self.true, 0.0) | guesses
        return ODEPhysics(
            partial(_rates, self.rates, fixed),
            step=self.spec.step or 1.0,
            state_dim=len(self.spec.moving),
            substeps=self.substeps * (2 if kind == "true" else 1),
            unknowns=self.believed if kind == "unknown" else None,
            name=self.rates.__name__,
        )

    def start(self, n: int) -> Tensor:
        """Draw states at which episodes start, ``n x state_dim``, by PyTorch's generator."""
        low, high = torch.tensor(self.starts, dtype=torch.float64)
        return low + (high - low) * torch.rand(n, len(low), dtype=torch.float64)

    def system(self, physics: Physics = "crude") -> System:
        """Return the system with an f_p."""
        return System(
            self.env or partial(MachineEnv, self),
            self.spec,
            self.physics(physics),
            self.reward,
            start=self.start,
            episode_length=self.episode_length,
            state_bounds=None if self.bounds is None else torch.tensor(self.bounds).double(),
        )


def _rates(
    rates: Rates, fixed: Mapping[str, float], state: Tensor, action: Tensor, p: Any = None
) -> Tensor:
    return rates(state, action, {**fixed, **(p or {})})


class MachineEnv(gym.Env[NDArray[np.float64], NDArray[np.float32]]):
    """The real system: observations are the states, with sine and cosine of angles."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.physics = machine.physics("true")
        dim = machine.spec.observation_dim
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (dim,), np.float64)
        low, high = np.array(machine.actions, dtype=np.float32)
        self.action_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.state = torch.zeros(machine.spec.state_dim, dtype=torch.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start an episode, at random or at ``options["state"]``."""
        super().reset(seed=seed)
        state = (options or {}).get("state")
        drawn = self.np_random.uniform(*self.machine.starts) if state is None else state
        self.state = torch.as_tensor(drawn, dtype=torch.float64)
        return self._observation(), {}

    def step(self, action: NDArray[Any]) -> Any:
        """Make a step, with the actions clipped to what there is."""
        low, high = np.array(self.machine.actions)
        row = torch.as_tensor(np.clip(np.asarray(action, dtype=float), low, high))[None]
        spec, state = self.machine.spec, self.state[None]
        following = state.clone()
        with torch.no_grad():
            moving = torch.cat([state[:, spec.moving], row], dim=-1)
            following[:, spec.moving] = self.physics(moving)
            reward = self.machine.reward(state, row, following).item()
        self.state = following[0]
        return self._observation(), reward, False, False, {}

    def _observation(self) -> NDArray[np.float64]:
        return self.machine.spec.observe(self.state).numpy()
