"""The cart-pole: its equation of motion, its physics, its states and its cost."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor, nn

from gpadjust.checks import check_columns, checked_number, checked_whole
from gpadjust.physics import ODEPhysics
from gpadjust.states import StateSpec

TIME_STEP = 0.1
SUBSTEP = 0.02  # s, the longest: a single Euler step of 0.1 s errs by 0.3 rad/s
START_MEAN = (0.0, math.pi, 0.0, 0.0)
START_STD = 0.2

CART_POLE_SPEC = StateSpec(
    ["x", "theta", "x_dot", "theta_dot"], actions=["force"], angles=["theta"]
)
"""The state of the cart-pole; policy and model see sine and cosine of the angle."""

CART_POLE_RAW_SPEC = StateSpec(["x", "theta", "x_dot", "theta_dot"], actions=["force"])
"""The same state with the angle as it is, not wrapped: the observation is the state."""


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
    2010, Appendix C, with the angle taken from upright. Its tip is at
    :math:`(x - l \sin\theta, l \cos\theta)`.

    Args:
        cart_mass: The mass :math:`m_c` of the cart, in kg.
        pole_mass: The mass :math:`m_p` of the pole, in kg.
        pole_length: The length :math:`l` of the pole, in m.
        damping: The friction :math:`b` between cart and track, in N s/m.
        gravity: The acceleration :math:`g` of gravity, in m/s²; as Deisenroth has it, 9.82.

    Raises:
        TypeError: If one of them is no number.
        ValueError: If a mass, the length or the gravity is not positive, or the damping negative.

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
        for entry in fields(self):
            value = getattr(self, entry.name)
            least = "not negative" if entry.name == "damping" else "positive"
            try:
                finite = math.isfinite(value)
            except TypeError:
                raise TypeError(f"{entry.name} must be a number; found {value!r}.") from None
            if not finite or value < 0 or (value == 0 and least == "positive"):
                raise ValueError(f"{entry.name} must be finite and {least}; found {value}.")

    def __call__(self, state: Tensor, action: Tensor) -> Tensor:
        """The time derivative of the state.

        Args:
            state: ``... x 4``: position, angle, velocity and angular velocity, in m, rad and s.
            action: ``... x 1``, the force in N.

        Returns:
            ``... x 4``.

        Raises:
            ValueError: If the last dimensions are not 4 and 1.
        """
        if state.shape[-1] != 4 or action.shape[-1] != 1:
            raise ValueError(
                "Expected states ... x 4 (x, theta, x_dot, theta_dot) and actions ... x 1 (force), "
                f"got {tuple(state.shape)} and {tuple(action.shape)}."
            )
        _, theta, x_dot, theta_dot = state.unbind(-1)
        m, length, g = self.pole_mass, self.pole_length, self.gravity
        M = self.cart_mass + m
        sin, cos = theta.sin(), theta.cos()
        force = action[..., 0] - self.damping * x_dot
        swing = m * length * theta_dot.square() * sin
        inertia = 4 * M - 3 * m * cos.square()
        x_ddot = (-2 * swing + 3 * m * g * sin * cos + 4 * force) / inertia
        theta_ddot = (-3 * swing * cos + 6 * M * g * sin + 6 * force * cos) / (length * inertia)
        return torch.stack([x_dot, theta_dot, x_ddot, theta_ddot], dim=-1)

    def energy(self, state: Tensor) -> Tensor:
        """The kinetic and the potential energy in J, ``...``, of states ``... x 4``.

        The potential energy is zero when the pole is level.
        """
        _, theta, x_dot, theta_dot = state.unbind(-1)
        m, length = self.pole_mass, self.pole_length
        cos = theta.cos()
        kinetic = (
            (self.cart_mass + m) * x_dot.square() / 2
            - m * length * x_dot * theta_dot * cos / 2
            + m * length**2 * theta_dot.square() / 6
        )
        return kinetic + m * self.gravity * length * cos / 2


REAL_CART_POLE = CartPoleEquation(cart_mass=0.5, pole_mass=0.5, pole_length=0.6, damping=0.1)
"""The system to control."""


def cart_pole_physics(
    cart_mass: float,
    pole_mass: float,
    pole_length: float,
    damping: float,
    time_step: float = TIME_STEP,
) -> ODEPhysics:
    """The state of a cart-pole a time step later, under a force that is held.

    It does not limit the force, as the environment does.

    Args:
        cart_mass: The mass of the cart, in kg.
        pole_mass: The mass of the pole, in kg.
        pole_length: The length of the pole, in m.
        damping: The friction between cart and track, in N s/m.
        time_step: In s.

    Returns:
        A physics of columns ``[x, theta, x_dot, theta_dot, force]``, by Runge-Kutta of order four
        with substeps of at most 0.02 s.

    Example:
        >>> physics = cart_pole_physics(0.5, 0.5, 0.6, 0.1)
        >>> physics(torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0]], dtype=torch.float64))
        tensor([[0.0081, 0.0206, 0.1627, 0.4233]], dtype=torch.float64)
    """
    equation = CartPoleEquation(cart_mass, pole_mass, pole_length, damping)
    return equation_physics(equation, time_step)


def equation_physics(
    equation: CartPoleEquation | nn.Module, time_step: float = TIME_STEP, name: str = "cart_pole"
) -> ODEPhysics:
    """A time step, in s, of such an equation."""
    checked_number("time_step", time_step, above=0)
    substeps = math.ceil(round(time_step / SUBSTEP, 6))
    return ODEPhysics(equation, time_step, state_dim=4, substeps=substeps, name=name)


def random_cart_pole_physics(seed: int, time_step: float = TIME_STEP) -> ODEPhysics:
    """The physics as someone may believe it to be, who has not measured the system.

    The masses are drawn from U(0.4, 0.6) kg for the cart and U(0.5, 0.7) kg for the pole, the
    length from U(0.5, 0.7) m; there is no friction.

    Args:
        seed: The same seed gives the same physics.
        time_step: In s.

    Returns:
        A physics as :func:`cart_pole_physics` builds it; ``physics.rhs`` has the parameters.

    Raises:
        TypeError: If ``seed`` is no whole number.
        ValueError: If it is negative, or ``time_step`` not positive.
    """
    checked_whole("seed", seed, 0)
    cart_mass, pole_mass, pole_length = np.random.default_rng(seed).uniform(
        [0.4, 0.5, 0.5], [0.6, 0.7, 0.7]
    )
    drawn = (float(cart_mass), float(pole_mass), float(pole_length))
    return cart_pole_physics(*drawn, damping=0.0, time_step=time_step)


def cart_pole_cost(states: Tensor, pole_length: float = REAL_CART_POLE.pole_length) -> Tensor:
    r"""The cost of states, in [0, 1].

    With the distance :math:`d` of the pole's tip from where it is when the pole stands upright
    over the origin,

    .. math:: c = 1 - \exp(-2 d^2), \qquad
        d^2 = (x - l \sin\theta)^2 + (l \cos\theta - l)^2.

    Args:
        states: ``... x 4``.
        pole_length: The length :math:`l` of the pole, in m.

    Returns:
        ``...``.
    """
    check_columns("states", states, 4)
    x, theta = states[..., 0], states[..., 1]
    across = x - pole_length * theta.sin()
    up = pole_length * (theta.cos() - 1)
    return -torch.expm1(-2 * (across.square() + up.square()))


def cart_pole_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """The reward ``...`` of transitions: minus the cost of the next states ``... x 4``."""
    return -cart_pole_cost(next_states)


def cart_pole_start(n: int) -> Tensor:
    r"""Draw ``n x 4`` start states, hanging at rest but for a spread, from PyTorch's generator.

    Each is from :math:`\mathcal{N}([0, \pi, 0, 0], 0.2^2 I)`.
    """
    checked_whole("n", n, 0)
    mean = torch.tensor(START_MEAN, dtype=torch.float64)
    return mean + START_STD * torch.randn(n, 4, dtype=torch.float64)
