"""Cart-poles with what no parameter of f_p describes, and f_p with its parameters fitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor, nn

from gpadjust.dynamics import PhysicsDynamics, Trajectories
from gpadjust.envs import CART_POLE_SPEC, REAL_CART_POLE, CartPoleSwingUpEnv
from gpadjust.envs.cart_pole.system import START_MEAN, CartPoleEquation, equation_physics
from gpadjust.physics import PhysicsError
from paper.planning import FRICTIONS, SENSORS, SMALL_NOISE, Settings

_SOFT = 0.05  # m/s: the speed over which dry friction changes its sign


@dataclass(frozen=True)
class FrictionEquation(CartPoleEquation):
    r"""The equation with dry friction of the cart and drag of the pole.

    The force on the cart is less by :math:`d \tanh(\dot{x} / 0.05)`; on the pole acts a torque
    :math:`-k \dot\theta |\dot\theta|`.

    Args:
        dry: The dry friction d, in N.
        drag: The drag k, in N m s²/rad².
    """

    dry: float = 0.0
    drag: float = 0.0

    def __call__(self, state: Tensor, action: Tensor) -> Tensor:
        """The time derivative of the state ``... x 4``, with the action ``... x 1``."""
        theta, x_dot, theta_dot = state.unbind(-1)[1:]
        dry = self.dry * (x_dot / _SOFT).tanh()
        rates = super().__call__(state, action - dry.unsqueeze(-1))
        torque = -self.drag * theta_dot * theta_dot.abs()
        m, length = self.pole_mass, self.pole_length
        total = self.cart_mass + m
        inertia = 4 * total - 3 * m * theta.cos().square()
        x_ddot = 6 * theta.cos() * torque / (length * inertia)
        theta_ddot = 12 * total * torque / (m * length**2 * inertia)
        zero = torch.zeros_like(torque)
        return rates + torch.stack([zero, zero, x_ddot, theta_ddot], dim=-1)


class Sensors(gym.ObservationWrapper[Any, Any, Any]):
    """Observations of the cart-pole with noise; its reward is that of the true state.

    Args:
        env: The cart-pole.
        sd: Standard deviations of the noise, by the name of the entry.
    """

    def __init__(self, env: gym.Env[Any, Any], sd: Mapping[str, float]) -> None:
        super().__init__(env)
        self.sd = np.array([sd[name] for name in CART_POLE_SPEC.states])

    def observation(self, observation: Any) -> Any:
        """Add the noise to the state, by the environment's generator."""
        spec = CART_POLE_SPEC
        state = spec.decode(torch.from_numpy(observation.astype(np.float64)))
        noise = torch.from_numpy(self.sd * self.unwrapped.np_random.normal(size=len(self.sd)))
        return spec.observe(state + noise).numpy().astype(np.float32)


class Still(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes of the cart-pole that start nearly still."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start from about the hanging pole at rest."""
        self.env.reset(seed=seed)
        start = self.unwrapped.np_random.normal(START_MEAN, SMALL_NOISE)
        return self.env.reset(options={"state": start})


class Watched(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the true states of an episode.

    Attributes:
        episodes: Those of each episode, ``T x 4``, the newest last.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.episodes: list[list[NDArray[np.float64]]] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        self.episodes.append([])
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """Make a step."""
        result = self.env.step(action)
        unwrapped: Any = self.unwrapped
        self.episodes[-1].append(unwrapped.state)
        return result


def equation(system: str) -> CartPoleEquation:
    """The equation of motion of a system."""
    if system not in FRICTIONS:
        return REAL_CART_POLE
    dry, drag = FRICTIONS[system]
    real = REAL_CART_POLE
    masses = (real.cart_mass, real.pole_mass)
    return FrictionEquation(*masses, real.pole_length, real.damping, dry=dry, drag=drag)


def environment(system: str, settings: Settings) -> Watched:
    """The real system."""
    env: gym.Env[Any, Any] = CartPoleSwingUpEnv(
        equation=equation(system), time_step=settings.time_step
    )
    if system == "sensors":
        env = Sensors(env, SENSORS)
    elif system == "mc-pilco":
        env = Sensors(Still(env), dict.fromkeys(CART_POLE_SPEC.states, SMALL_NOISE))
    return Watched(gym.wrappers.TimeLimit(env, settings.episode_length))


def mc_pilco_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """The reward of that protocol, of transitions ``N x ...``: how far pole and cart are off.

    That of the others is of the tip alone, under which the cart may swing.
    """
    x, theta = next_states[:, 0], next_states[:, 1]
    lean = torch.atan2(theta.sin(), theta.cos())
    return torch.expm1(-(lean / 3).square() - x.square())


class LearntEquation(nn.Module):
    """The cart-pole's equation of motion with masses, length and friction to be learnt.

    Args:
        start: Where they begin; a friction of 0 at 0.05.
    """

    def __init__(self, start: CartPoleEquation) -> None:
        super().__init__()
        numbers = (start.cart_mass, start.pole_mass, start.pole_length, start.damping or 0.05)
        self.logs = nn.Parameter(torch.tensor(numbers, dtype=torch.float64).log())

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """The time derivative of the state."""
        known = object.__new__(CartPoleEquation)
        names = ("cart_mass", "pole_mass", "pole_length", "damping")
        for name, value in zip(names, self.logs.exp(), strict=True):
            object.__setattr__(known, name, value)  # tensors, which its checks would refuse
        object.__setattr__(known, "gravity", 9.82)
        return known(state, action)


class FittedPhysics(PhysicsDynamics):
    """f_p alone, its parameters fitted to all transitions, by least squares of one step.

    Args:
        start: The equation whose parameters they are at first.
        time_step: In s.
    """

    def __init__(self, start: CartPoleEquation, time_step: float) -> None:
        self.equation = LearntEquation(start)
        physics = equation_physics(self.equation, time_step, name="fitted_cart_pole")
        super().__init__(CART_POLE_SPEC, physics)
        self._data: Trajectories | None = None

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Fit the parameters to these and earlier transitions."""
        data = self._checked(states, actions, next_states)
        data = self._data = data if self._data is None else self._data.append(data)
        truth = self.spec.change(data.states, data.next_states)
        scale = truth.square().mean(0).sqrt()
        rows = torch.cat([data.states, data.actions], dim=-1)

        def residuals() -> Tensor:
            return self.spec.change(data.next_states, self.physics(rows)) / scale

        least_squares_fit(self.equation.logs, residuals)
        self.physics.forget()


def least_squares_fit(logs: nn.Parameter, residuals: Callable[[], Tensor]) -> None:
    """Move logarithms of parameters to least squares, each within a factor of five of where it is.

    Args:
        logs: The parameters.
        residuals: What depends on them, of any shape; where it raises a PhysicsError, they are far
            off.
    """

    def at(values: NDArray[np.float64]) -> NDArray[np.float64]:
        with torch.no_grad():
            logs.copy_(torch.from_numpy(values))
            return residuals().flatten().numpy()

    def tried(values: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            return at(values)
        except PhysicsError:
            return np.full_like(first, 1e3)

    start, room = logs.detach().numpy().copy(), np.log(5)
    first = at(start)
    found = optimize.least_squares(tried, start, bounds=(start - room, start + room))
    at(found.x)
