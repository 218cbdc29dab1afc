"""Systems near walls: how often constraints are violated, and what keeping them costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from gpadjust import ODEPhysics, systems
from gpadjust.physics import Physics
from gpadjust.states import StateSpec
from gpadjust.systems import System
from gpadjust.systems.swing_up import REAL_CART_POLE, equation_physics
from paper.control.systems import tanks

GUST = 0.02  # m/s, standard deviation of what a step adds to the velocity of the cart
GOAL = 0.5  # m


class GustyCart(gym.Env[Any, Any]):
    """A cart of 1.4 kg with dry friction, in gusts."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """At rest, at 0 m."""
        super().reset(seed=seed)
        self.state = np.zeros(2)
        return self.state.copy(), {}

    def step(self, action: Any) -> Any:
        """Push, and be pushed."""
        with torch.no_grad():
            row = torch.tensor([[*self.state, action[0]]], dtype=torch.float64)
            x, v = real_cart(row)[0].tolist()
        gust = GUST * self.np_random.normal()
        self.state = np.array([x + 0.1 * gust, v + gust])
        return self.state.copy(), -abs(self.state[0] - GOAL), False, False, {}


def real_cart(rows: Tensor) -> Tensor:
    """The next state without a gust."""
    x, v, force = rows.unbind(-1)
    v = v + 0.1 * (force - 0.3 * torch.tanh(v / 0.05)) / 1.4
    return torch.stack([x + 0.1 * v, v], dim=-1)


def believed_cart(state: Tensor, action: Tensor) -> Tensor:
    """The rates of a cart of 1 kg without friction."""
    return torch.stack([state[:, 1], action[:, 0]], dim=-1)


def cart_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """By the distance from the goal, in m."""
    return -(next_states[:, 0] - GOAL).abs()


def below(column: int, most: float, states: Tensor, actions: Tensor) -> Tensor:
    """A wall: a state is at most so large."""
    return states[:, [column]] - most


def within(column: int, most: float, states: Tensor, actions: Tensor) -> Tensor:
    """Two walls: a state is at most so far from 0."""
    return torch.stack([states[:, column] - most, -most - states[:, column]], dim=-1)


@dataclass(frozen=True)
class Walled:
    """A system with walls, the true model of it, and the error of a step of its f_p."""

    system: System
    truth: Physics | Callable[[Tensor], Tensor]


def cart(seed: int) -> Walled:
    """The cart of the guide, whose goal is 2 cm before a wall."""
    system = System(
        GustyCart,
        StateSpec(["x", "v"], ["force"], step=0.1),
        ODEPhysics(believed_cart, step=0.1, state_dim=2),
        cart_reward,
        episode_length=20,
        constraints=partial(below, 0, 0.52),
        physics_error={"v": 0.03, "x": 0.003},
    )
    return Walled(system, real_cart)


def cart_pole(seed: int) -> Walled:
    """The cart-pole on a short track."""
    system = systems.cart_pole(seed)
    limits = {"x": 0.02, "theta": 0.05, "x_dot": 0.2, "theta_dot": 0.5}
    system = replace(system, constraints=partial(within, 0, 0.5), physics_error=limits)
    return Walled(system, equation_physics(REAL_CART_POLE))


def two_tanks(seed: int) -> Walled:
    """Two tanks, of which the upper one must not be too full."""
    limits = {"upper": 0.2, "lower": 0.2}
    system = replace(tanks(), constraints=partial(below, 0, 8.0), physics_error=limits)
    return Walled(system, tanks("true").physics)
