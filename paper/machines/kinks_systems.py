"""Five systems with kinks or jumps, four smooth ones, and a crude physics of each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import StateSpec

_SUBSTEPS = 200  # of a time step, by the semi-implicit Euler method
_OF_PHYSICS = 50
Advance = Callable[[Tensor, Tensor, float], Tensor]


class System(NamedTuple):
    """A system, where its states and actions begin, and its crude physics.

    Attributes:
        spec: What states and actions are, with the time step.
        low: The least values of states and actions.
        high: The largest ones.
        advance: States after a small time, by states ``n x s`` and actions ``n x a``.
        crude: The same of the physics.
    """

    spec: StateSpec
    low: list[float]
    high: list[float]
    advance: Advance
    crude: Advance

    def step(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states, without noise."""
        return _steps(self.advance, states, actions, self._time_step, _SUBSTEPS)

    def physics(self, X: Tensor) -> Tensor:
        """The physics as dynamics read it: next states by states and actions."""
        states, actions = X.split([self.spec.state_dim, len(self.spec.actions)], dim=-1)
        return _steps(self.crude, states, actions, self._time_step, _OF_PHYSICS)

    def draw(self, number: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """States and actions at random."""
        low, high = torch.tensor([self.low, self.high], dtype=torch.float64)
        unit = torch.rand(number, len(low), generator=generator, dtype=torch.float64)
        drawn = low + (high - low) * unit
        return drawn[:, : self.spec.state_dim], drawn[:, self.spec.state_dim :]

    @property
    def _time_step(self) -> float:
        return self.spec.step or 1.0


def _steps(advance: Advance, x: Tensor, u: Tensor, time: float, number: int) -> Tensor:
    for _ in range(number):
        x = advance(x, u, time / number)
    return x


def _dry(v: Tensor, acceleration: Tensor, most: Tensor | float, h: float) -> Tensor:
    """A relative velocity after a time h; dry friction decelerates by ``most``, or holds."""
    free = v + h * acceleration
    return free.sign() * (free.abs() - h * most).clamp_min(0.0)


def _belt(stiffness: float, viscous: float, dry: float, drop: float) -> Advance:
    """A mass (1 kg) on a spring and a belt, whose speed is the action."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        q, v = x.unbind(-1)
        belt = u[..., 0]
        most = dry * (1 - drop + drop * (-(v - belt).abs() / 0.3).exp())
        pull = -stiffness * q - viscous * (v - belt)
        v = belt + (_dry(v - belt, pull, most, h) if dry else v - belt + h * pull)
        return torch.stack([q + h * v, v], dim=-1)

    return advance


def _cart_pole(mass: float, pole: float, length: float, viscous: float, dry: float) -> Advance:
    """States x, angle from hanging, and their velocities; the action is a force on the cart."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        place, angle, v, w = x.unbind(-1)
        sin, cos = angle.sin(), angle.cos()
        inertia = mass + pole * sin.square()
        force = u[..., 0] - viscous * v
        a = (force + pole * sin * (length * w.square() + 9.81 * cos)) / inertia
        new = _dry(v, a, dry / inertia, h) if dry else v + h * a
        w = w - h * ((new - v) / h * cos + 9.81 * sin) / length
        return torch.stack([place + h * new, angle + h * w, new, w], dim=-1)

    return advance


def _ball(mass: float, drag: float, bounce: float | None) -> Advance:
    """Height and velocity of a ball with a fan, whose thrust is the action, above a floor."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        z, v = x.unbind(-1)
        v = v + h * (u[..., 0] / mass - 9.81 - drag * v)
        z = z + h * v
        if bounce is not None:
            hits = (z < 0) & (v < 0)
            v, z = torch.where(hits, -bounce * v, v), z.clamp_min(0.0)
        return torch.stack([z, v], dim=-1)

    return advance


def _gear(stiffness: float, gap: float, load: float, loss: float) -> Advance:
    """Twist of a shaft, speeds of motor and load; the action is the motor's torque."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        twist, motor, driven = x.unbind(-1)
        torque = stiffness * twist.sign() * (twist.abs() - gap).clamp_min(0.0)
        motor = motor + h * (u[..., 0] - torque - loss * motor) / 0.2
        driven = driven + h * (torque - 0.3 * loss * driven) / load
        return torch.stack([twist + h * (motor - driven), motor, driven], dim=-1)

    return advance


def _heater(power: float, loss: float, switched: bool) -> Advance:
    """Temperatures of a heater and a room above the surroundings; the action is the set-point."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        heater, room = x.unbind(-1)
        away = u[..., 0] - room
        on = (away > 0).to(x) if switched else 0.5 * (1 + (away / 2).tanh())
        exchange = 0.4 * (heater - room)
        heater = heater + h * (power * on - exchange)
        room = room + h * (0.5 * exchange - loss * room * (1 + 0.01 * room))
        return torch.stack([heater, room], dim=-1)

    return advance


def _reactor(rate: float, energy: float, heat: float) -> Advance:
    """Concentration and temperature of A -> B, dimensionless; the action cools."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        c, t = x.unbind(-1)
        speed = rate * c * (energy * t / (1 + 0.1 * t)).exp()
        return torch.stack(
            [c + h * (1 - c - speed), t + h * (heat * speed - t - 0.6 * (t - u[..., 0]))], dim=-1
        )

    return advance


def _oscillator(push: float, stiff: float) -> Advance:
    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        q, v = x.unbind(-1)
        v = v + h * (push * (1 - q.square()) * v - stiff * q + u[..., 0])
        return torch.stack([q + h * v, v], dim=-1)

    return advance


def _links(second: float, damping: float) -> Advance:
    """Angles and rates of two links of 1 m, the first of 1 kg; the action is a torque on it."""

    def advance(x: Tensor, u: Tensor, h: float) -> Tensor:
        q1, q2, w1, w2 = x.unbind(-1)
        sin, cos = (q1 - q2).sin(), (q1 - q2).cos()
        total = 1.0 + second
        first = u[..., 0] - damping * w1 - second * w2.square() * sin - total * 9.81 * q1.sin()
        other = second * (w1.square() * sin - 9.81 * q2.sin()) - damping * w2
        determinant = second * (total - second * cos.square())
        w1, w2 = (
            w1 + h * (second * first - second * cos * other) / determinant,
            w2 + h * (total * other - second * cos * first) / determinant,
        )
        return torch.stack([q1 + h * w1, q2 + h * w2, w1, w2], dim=-1)

    return advance


def _spec(states: list[str], action: str, step: float, **more: Any) -> StateSpec:
    return StateSpec(states, [action], step=step, **more)


_CART = _spec(
    ["x", "angle", "v", "w"], "force", 0.05, angles=["angle"], integrated={"x": "v", "angle": "w"}
)
_TWO = _spec(
    ["q1", "q2", "w1", "w2"],
    "torque",
    0.05,
    angles=["q1", "q2"],
    integrated={"q1": "w1", "q2": "w2"},
)
SYSTEMS = {
    "stick-slip": System(
        _spec(["q", "v"], "belt", 0.1),
        [-0.5, -1.5, -1.0],
        [0.5, 1.5, 1.0],
        _belt(20.0, 0.4, 4.0, 0.4),
        _belt(23.0, 2.0, 0.0, 0.0),
    ),
    "cart-pole": System(
        _CART,
        [-1.0, -3.14, -1.5, -4.0, -6.0],
        [1.0, 3.14, 1.5, 4.0, 6.0],
        _cart_pole(0.5, 0.5, 0.6, 0.1, 1.0),
        _cart_pole(0.58, 0.43, 0.66, 0.0, 0.0),
    ),
    "bouncing": System(
        _spec(["z", "v"], "thrust", 0.05),
        [0.0, -3.0, 0.0],
        [1.5, 3.0, 6.0],
        _ball(0.5, 0.15, 0.8),
        _ball(0.57, 0.0, None),
    ),
    "backlash": System(
        _spec(["twist", "motor", "load"], "torque", 0.05),
        [-0.6, -2.0, -2.0, -2.0],
        [0.6, 2.0, 2.0, 2.0],
        _gear(15.0, 0.2, 0.6, 0.2),
        _gear(11.0, 0.0, 0.7, 0.0),
    ),
    "thermostat": System(
        _spec(["heater", "room"], "set", 0.5),
        [10.0, 10.0, 15.0],
        [60.0, 30.0, 25.0],
        _heater(20.0, 0.1, switched=True),
        _heater(16.0, 0.12, switched=False),
    ),
    "smooth cart-pole": System(
        _CART,
        [-1.0, -3.14, -1.5, -4.0, -6.0],
        [1.0, 3.14, 1.5, 4.0, 6.0],
        _cart_pole(0.5, 0.5, 0.6, 0.4, 0.0),
        _cart_pole(0.58, 0.43, 0.66, 0.0, 0.0),
    ),
    "reactor": System(
        _spec(["c", "t"], "coolant", 0.2),
        [0.1, 0.0, -1.0],
        [1.0, 4.0, 1.0],
        _reactor(0.1, 1.0, 6.0),
        _reactor(0.13, 0.85, 5.5),
    ),
    "oscillator": System(
        _spec(["q", "v"], "force", 0.1),
        [-2.0, -3.0, -2.0],
        [2.0, 3.0, 2.0],
        _oscillator(1.0, 1.0),
        _oscillator(0.8, 1.2),
    ),
    "two links": System(
        _TWO,
        [-2.0, -2.0, -3.0, -3.0, -6.0],
        [2.0, 2.0, 3.0, 3.0, 6.0],
        _links(0.7, 0.15),
        _links(0.6, 0.0),
    ),
}
