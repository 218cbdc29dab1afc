"""The swing-up of a cart-pole: equation of motion, physics, environment and system."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import (
    check_columns,
    check_kind,
    check_switch,
    checked_number,
    checked_options,
    checked_whole,
    finite_array,
)
from gpadjust.physics import ODEPhysics, Unknown
from gpadjust.states import StateSpec
from gpadjust.systems.rendering import RENDER_MODES, SIZE, ViewedEnv, draw_cart_pole
from gpadjust.systems.system import System

TIME_STEP = 0.1
SUBSTEPS = 5  # one Euler step of 0.1 s has an error of 0.3 rad/s
START_MEAN = (0.0, math.pi, 0.0, 0.0)  # hanging, at rest
START_STD = 0.2
MAX_FORCE = 10.0  # N
MAX_START = 100.0  # far beyond reachable states; the equation can be integrated there

CART_POLE_SPEC = StateSpec(
    ["x", "theta", "x_dot", "theta_dot"], actions=["force"], angles=["theta"], step=TIME_STEP
)
"""The state of the cart-pole; policy and model see sine and cosine of the angle."""


def cart_pole_spec(encode_angle: bool = True) -> StateSpec:
    """Return the spec for options of the environment."""
    return replace(CART_POLE_SPEC, angles=("theta",) if encode_angle else ())


@dataclass(frozen=True)
class CartPoleEquation:
    r"""The equation of motion of a cart with a pole, a uniform rod on a hinge without friction.

    With the position :math:`x` of the cart, the angle :math:`\theta` of the pole from *upright*,
    counter-clockwise, the force :math:`a` on the cart and :math:`M = m_c + m_p`,

    .. math::
        \ddot{x} &= \frac{-2 m_p l \dot\theta^2 \sin\theta + 3 m_p g \sin\theta \cos\theta
            + 4 (a - b \dot{x})}{4 M - 3 m_p \cos^2\theta} \\
        \ddot\theta &= \frac{-3 m_p l \dot\theta^2 \sin\theta \cos\theta + 6 M g \sin\theta
            + 6 (a - b \dot{x}) \cos\theta}{l (4 M - 3 m_p \cos^2\theta)}.

    This is the system of Deisenroth, "Efficient Reinforcement Learning using Gaussian Processes",
    2010, Appendix C, with the angle from upright.

    Args:
        cart_mass: The mass :math:`m_c` of the cart, in kg.
        pole_mass: The mass :math:`m_p` of the pole, in kg.
        pole_length: The length :math:`l` of the pole, in m.
        damping: The friction :math:`b` between cart and track, in N s/m.
        gravity: The acceleration :math:`g` of gravity, in m/s². Default: Deisenroth's 9.82.

    Raises:
        TypeError, ValueError: If a mass, the length or the gravity is not a positive number, or the
            friction is negative.

    Example:
        >>> equation = CartPoleEquation(0.5, 0.5, 0.6, 0.1)
        >>> equation(torch.zeros(1, 4), torch.ones(1, 1))  # at rest, upright, pushed with 1 N
        tensor([[0.0000, 0.0000, 1.6000, 4.0000]])
    """

    cart_mass: float
    pole_mass: float
    pole_length: float
    damping: float
    gravity: float = 9.82

    def __post_init__(self) -> None:
        """Check the parameters."""
        for name in ("cart_mass", "pole_mass", "pole_length", "gravity"):
            checked_number(name, getattr(self, name), above=0)
        checked_number("damping", self.damping, least=0)

    def __call__(self, state: Tensor, action: Tensor, p: Mapping[str, Any] | None = None) -> Tensor:
        """Return the time derivative ``... x 4`` of states ``... x 4`` under forces ``... x 1``.

        States are position, angle, velocity and angular velocity, in m, rad and s, the force is in
        N; ``p`` has other values of some parameters by name, ``...`` each.
        """
        if state.shape[-1] != 4 or action.shape[-1] != 1:
            raise ValueError(
                "Expected states ... x 4 (x, theta, x_dot, theta_dot) and actions ... x 1 (force), "
                f"got {tuple(state.shape)} and {tuple(action.shape)}."
            )
        coefficients = self._coefficients
        if p is not None:
            coefficients = _coefficients({**vars(self), **p})
        mass, half_moment, swung_mass, gravity, arm, damping = coefficients
        _, theta, x_dot, theta_dot = state.unbind(-1)
        sin, cos = theta.sin(), theta.cos()
        # a - b x'
        force = action[..., 0]
        if damping is not None:
            force = force - damping * x_dot
        # a - m l / 2 theta'^2 sin theta
        net = torch.addcmul(force, theta_dot * theta_dot, half_moment * sin, value=-1)
        # g sin theta
        tilt = gravity * sin
        # The fraction of x'' over 4: (net + 3/4 m cos theta tilt) / (M - 3/4 m cos^2 theta)
        swung = swung_mass * cos
        x_ddot = torch.addcmul(net, swung, tilt) / torch.addcmul(mass, swung, cos, value=-1)
        # The pole about its moving hinge: 2/3 l theta'' = tilt + cos theta x''
        theta_ddot = torch.addcmul(tilt, cos, x_ddot) / arm
        return torch.stack([x_dot, theta_dot, x_ddot, theta_ddot], dim=-1)

    @cached_property
    def _coefficients(self) -> tuple[Any, ...]:
        return _coefficients(vars(self))


REAL_CART_POLE = CartPoleEquation(cart_mass=0.5, pole_mass=0.5, pole_length=0.6, damping=0.1)
"""The system to control."""


def _coefficients(values: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the coefficients of the equation as tensors; None for a friction of zero."""
    m, length, damping = (values[name] for name in ("pole_mass", "pole_length", "damping"))
    # M, m l / 2, 3/4 m, g, 2/3 l, b
    numbers = [values["cart_mass"] + m, m * length / 2, 0.75 * m, values["gravity"], length / 1.5]
    # An unknown parameter is a tensor, which may be zero in some rows.
    numbers.append(damping if torch.is_tensor(damping) or damping != 0 else None)
    return tuple(v if v is None else torch.as_tensor(v, dtype=torch.float64) for v in numbers)


def equation_physics(
    equation: Callable[..., Tensor], unknowns: Mapping[str, Unknown] | None = None
) -> ODEPhysics:
    """Return the physics of the next state of a cart-pole, after 0.1 s at one force.

    It integrates by Runge-Kutta of order four with substeps of 0.02 s.

    Example:
        >>> physics = equation_physics(REAL_CART_POLE)  # of columns x, theta, their rates, force
        >>> physics(torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0]], dtype=torch.float64))
        tensor([[0.0081, 0.0206, 0.1627, 0.4233]], dtype=torch.float64)
    """
    options = {"state_dim": 4, "substeps": SUBSTEPS, "unknowns": unknowns, "name": "cart_pole"}
    return ODEPhysics(equation, TIME_STEP, **options)  # type: ignore[arg-type]


def believed_cart_pole(seed: int) -> CartPoleEquation:
    """Return a cart-pole with roughly known masses and length, without friction."""
    random = np.random.default_rng(checked_whole("seed", seed, 0))
    values = random.uniform([0.4, 0.5, 0.5], [0.6, 0.7, 0.7])
    cart_mass, pole_mass, pole_length = map(float, values)
    return CartPoleEquation(cart_mass, pole_mass, pole_length, damping=0.0)


def cart_pole_cost(states: Tensor, pole_length: float = REAL_CART_POLE.pole_length) -> Tensor:
    r"""Return the cost, in [0, 1], of states ``... x 4``, by the distance d of the tip of the pole.

    The goal of the tip is its place above the origin with the pole upright:

    .. math:: c = 1 - \exp(-2 d^2), \qquad
        d^2 = (x - l \sin\theta)^2 + (l \cos\theta - l)^2.
    """
    check_columns("states", states, 4)
    x, theta = states[..., 0], states[..., 1]
    across = x - pole_length * theta.sin()
    up = pole_length * (theta.cos() - 1)
    # 1 - exp(-2 d^2)
    return -torch.expm1(-2 * (across.square() + up.square()))


def cart_pole_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """Return the rewards of transitions: minus the cost of the next states ``... x 4``."""
    return -cart_pole_cost(next_states)


def cart_pole_start(n: int) -> Tensor:
    """Draw start states ``n x 4`` from N([0, pi, 0, 0], 0.2²)."""
    checked_whole("n", n, 0)
    mean = torch.tensor(START_MEAN, dtype=torch.float64)
    return mean + START_STD * torch.randn(n, 4, dtype=torch.float64)


class CartPoleSwingUpEnv(ViewedEnv):
    r"""Swing up the pole of a cart-pole and balance it, by pushing the cart.

    The pole hangs at first. The action, a force in [-10, 10] N, is constant for a time step;
    stronger forces are clipped. The observation is
    :math:`[x, \sin\theta, \cos\theta, \dot{x}, \dot\theta]`, with the angle from upright;
    ``state`` has the true state in float64. The reward is minus the cost of the next state, in
    [-1, 0], by the distance of the tip from its goal; the ``info`` of a step has the ``"cost"``.
    ``gym.make`` truncates an episode after 25 steps.

    Args:
        render_mode: ``"rgb_array"`` lets ``render`` return a frame, which needs ``pygame-ce``.
        encode_angle: If False, the observation is the state
            :math:`[x, \theta, \dot{x}, \dot\theta]`, with the angle not wrapped.
        equation: The system. Default: ``REAL_CART_POLE``.

    Raises:
        TypeError, ValueError: If an argument has another type, or is out of range.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("gpadjust.systems:gpadjust/CartPoleSwingUp-v0")
        >>> observation, info = env.reset(options={"state": [0.0, 0.0, 0.0, 0.0]})
        >>> observation
        array([0., 0., 1., 0., 0.], dtype=float32)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.high)
        >>> round(reward, 3)
        -0.004
    """

    size = SIZE
    metadata = {"render_modes": RENDER_MODES, "render_fps": round(1 / TIME_STEP)}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        encode_angle: bool = True,
        equation: CartPoleEquation = REAL_CART_POLE,
    ) -> None:
        super().__init__(render_mode)
        check_switch("encode_angle", encode_angle)
        check_kind("equation", equation, CartPoleEquation, "a CartPoleEquation")
        self.equation = equation
        self.physics = equation_physics(equation)
        self.state_spec = cart_pole_spec(encode_angle)
        high = [np.inf, 1.0, 1.0, np.inf, np.inf] if encode_angle else [np.inf] * 4
        # Sine and cosine have bounds, positions and velocities have none.
        bound = np.array(high, dtype=np.float32)
        self.observation_space = gym.spaces.Box(-bound, bound, dtype=np.float32)
        self.action_space = gym.spaces.Box(-MAX_FORCE, MAX_FORCE, (1,), dtype=np.float32)
        self._force = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode from N([0, pi, 0, 0], 0.2²), or at ``options={"state": ...}``.

        Raises:
            ValueError: If the state is not four numbers of magnitude at most 100.
        """
        super().reset(seed=seed)
        options = checked_options("options", options, ("state",))
        if "state" in options:
            state = finite_array(options["state"], (4,))
            if state is None or (np.abs(state) > MAX_START).any():
                raise ValueError(
                    "options['state'] must be four finite numbers, x, theta, x_dot and theta_dot, "
                    f"of magnitude at most {MAX_START:g}; found {options['state']!r}."
                )
            self.state = state
        else:
            self.state = self.np_random.normal(START_MEAN, START_STD)
        self._force = 0.0
        return self._observe(self.state), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Push the cart for a time step by a force in N, of shape ``(1,)``."""
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset before the first step.")
        force = finite_array(action, (1,))
        if force is None:
            raise ValueError(f"Expected one finite force as action, (1,); found {action!r}.")
        force = force.clip(-MAX_FORCE, MAX_FORCE)
        # The physics of the real parameters is the simulator.
        with torch.no_grad():
            row = torch.from_numpy(np.concatenate([self.state, force]))
            state = self.physics(row.unsqueeze(0)).squeeze(0)
            cost = cart_pole_cost(state, self.equation.pole_length).item()
        self.state = state.numpy()
        self._force = float(force[0])
        return self._observe(self.state), -cost, False, False, {"cost": cost}

    def _draw(self, canvas: Any, state: NDArray[np.float64]) -> None:
        x, theta = map(float, state[:2])
        # The largest force has an arrow of 0.6 m.
        reach = 0.6 * self._force / MAX_FORCE
        draw_cart_pole(canvas, x, theta, self.equation.pole_length, reach)

    def _observe(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        return self.state_spec.observe(torch.from_numpy(state)).numpy().astype(np.float32)


def cart_pole(
    seed: int = 0,
    *,
    noise: Mapping[str, float] | None = None,
    unknowns: bool = False,
    encode_angle: bool = True,
    episode_length: int = 25,
) -> System:
    """Return the swing-up of a cart-pole, a :class:`CartPoleSwingUpEnv`.

    Its physics has other masses, another length and no friction.

    Args:
        seed: Seed of the physics, with masses from U(0.4, 0.6) kg for the cart and U(0.5, 0.7) kg
            for the pole, and a length from U(0.5, 0.7) m.
        noise: Standard deviations of the sensors' noise, by the name of the state.
        unknowns: If True, masses, length and damping of the physics are unknown parameters.
        encode_angle: As of the environment.
        episode_length: Number of steps of an episode.

    Example:
        >>> from gpadjust import systems
        >>> systems.cart_pole(seed=1, unknowns=True).unknowns["damping"].prior_text
        '0 to 1'
    """
    check_switch("unknowns", unknowns)
    believed = believed_cart_pole(seed)
    parameters: dict[str, Unknown] | None = None
    if unknowns:  # factors that cover the real values
        parameters = {
            "cart_mass": Unknown(believed.cart_mass, factor=1.5, unit="kg"),
            "pole_mass": Unknown(believed.pole_mass, factor=1.5, unit="kg"),
            "pole_length": Unknown(believed.pole_length, factor=1.5, unit="m"),
            "damping": Unknown(0.05, bounds=(0.0, 1.0), unit="N s/m"),
        }
    make = partial(
        gym.make,
        "gpadjust/CartPoleSwingUp-v0",
        max_episode_steps=episode_length,
        encode_angle=encode_angle,
    )
    return System(
        make,
        cart_pole_spec(encode_angle),
        equation_physics(believed, parameters),
        cart_pole_reward,
        start=cart_pole_start,
        episode_length=episode_length,
        noise=noise,
    )
