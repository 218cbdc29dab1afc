"""Equations of motion: rates of states under actions, of the real systems and of f_p alike.

Each takes states ``N x state_dim``, actions ``N x action_dim`` and its parameters by name, and
returns rates ``N x state_dim``, in SI units unless said. A parameter that f_p lacks is zero there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

GRAVITY = 9.81
BRIM = 10.0  # cm
_SLIDES = 0.05  # rad/s, at which dry friction is three quarters of its value

Parameters = Mapping[str, Any]


def friction(rate: Tensor, p: Parameters) -> Tensor:
    """Return the viscous and dry friction of a joint, a torque against its rate."""
    return p["viscous"] * rate + p["dry"] * (rate / _SLIDES).tanh()


def pendulum(state: Tensor, action: Tensor, p: Parameters) -> Tensor:
    """Return the rates of Pendulum-v1's rod on a drive; its angle is from upright, g 10 m/s²."""
    theta, rate = state.unbind(-1)
    torque = action[:, 0] - friction(rate, p)
    inertia = p["mass"] * p["length"] ** 2 / 3
    return torch.stack([rate, 15 / p["length"] * theta.sin() + torque / inertia], dim=-1)


def furuta(state: Tensor, action: Tensor, p: Parameters) -> Tensor:
    """Return the rates of a pendulum on an arm that a voltage turns; theta is from upright.

    Lagrange's equations of two uniform rods. The motor's torque falls with its speed by the
    voltage that it induces; arm and joint have friction.
    """
    _, theta, arm_rate, rate = state.unbind(-1)
    mass, length, arm = p["mass"], p["length"], p["arm_length"]
    sin, cos = theta.sin(), theta.cos()
    inertia = mass * length**2 / 3  # about the joint
    across = mass * arm * length / 2 * cos
    whole = p["arm_mass"] * arm**2 / 3 + mass * arm**2 + inertia * sin.square()
    torque = p["torque"] * (action[:, 0] - p["induced"] * arm_rate) - friction(arm_rate, p)
    torque = torque - 2 * inertia * sin * cos * arm_rate * rate
    torque = torque + mass * arm * length / 2 * sin * rate.square()
    swing = inertia * sin * cos * arm_rate.square() + mass * GRAVITY * length / 2 * sin
    swing = swing - p["joint"] * rate
    size = whole * inertia - across.square()
    arm_acceleration = (inertia * torque - across * swing) / size
    acceleration = (whole * swing - across * torque) / size
    return torch.stack([arm_rate, rate, arm_acceleration, acceleration], dim=-1)


def quadrotor(state: Tensor, action: Tensor, p: Parameters) -> Tensor:
    """Return the rates of a rigid body in a vertical plane under two thrusts, and drag."""
    _, _, phi, x_rate, z_rate, turn = state.unbind(-1)
    left, right = action.unbind(-1)
    thrust = left + right
    drag = p["drag"] * (x_rate.square() + z_rate.square() + 1e-12).sqrt()
    x_acceleration = (-thrust * phi.sin() - drag * x_rate) / p["mass"]
    z_acceleration = (thrust * phi.cos() - drag * z_rate) / p["mass"] - GRAVITY
    torque = p["arm"] * (right - left) - p["turning_drag"] * turn
    rates = [x_rate, z_rate, turn, x_acceleration, z_acceleration, torque / p["inertia"]]
    return torch.stack(rates, dim=-1)


def tanks(state: Tensor, action: Tensor, p: Parameters) -> Tensor:
    """Return the rates of two tanks' levels in cm; a pump fills the upper, which fills the lower.

    Torricelli's outflows; the flow of the pump, which has to rise to the level of the upper tank,
    falls with that; what is above the brim flows over.
    """
    level = state.clamp_min(1e-6)
    upper, lower = level.unbind(-1)
    inflow = p["pump"] * action[:, 0] * (1 - p["back_pressure"] * upper)
    between = p["upper_outflow"] * upper.sqrt()
    outflow = p["lower_outflow"] * lower.sqrt()
    rates = torch.stack([inflow - between, between - outflow], dim=-1)
    return rates - p["overflow"] * (level - BRIM).clamp_min(0)
