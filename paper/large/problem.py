"""Two systems with six inputs, and what is known of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from paper.pairs.functions import PAIRS

_GRAVITY = 9.81  # m / s^2
_LENGTHS = (0.5, 0.4)  # m
_HALF = torch.tensor([math.pi, math.pi, 5.0, 5.0, 6.0, 3.0], dtype=torch.float64)
NOISE = {"hartmann6": 0.05, "links": 0.1}
"""Standard deviation of the noise, in that of the function."""


class Data(NamedTuple):
    """Observations of a system, and the system.

    Attributes:
        X: ``n x 6``.
        Y: Noisy, ``n x m``.
        f: Without noise, ``n x m``.
        physics: f_p.
    """

    X: Tensor
    Y: Tensor
    f: Tensor
    physics: Callable[[Tensor], Tensor]


def draw(problem: str, n: int, seed: int) -> Data:
    """Draw observations at uniform inputs."""
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 6, generator=generator, dtype=torch.float64)
    if problem == "hartmann6":
        f, physics = _hartmann(X, high=True), _crude_hartmann
    else:
        X = (2 * X - 1) * _HALF
        f, physics = links(X, (1.0, 0.8), damping=0.15, friction=0.5), _crude_links
    noise = torch.randn(f.shape, generator=generator, dtype=torch.float64)
    return Data(X, f + NOISE[problem] * f.std(0) * noise, f, physics)


def links(X: Tensor, masses: tuple[float, float], damping: float, friction: float) -> Tensor:
    """The angular accelerations of an arm of two rods that hang in a vertical plane.

    Args:
        X: Angles (rad, the second relative to the first), angular velocities (rad/s) and torques
            (N m), ``... x 6``.
        masses: In kg; the rods are homogeneous.
        damping: N m s.
        friction: Of Coulomb, smoothed over .3 rad/s, N m.

    Returns:
        rad/s^2, ``... x 2``.
    """
    q1, q2, v1, v2, torque1, torque2 = X.unbind(-1)
    (m1, m2), (l1, l2) = masses, _LENGTHS
    c1, c2 = l1 / 2, l2 / 2
    coupling = m2 * l1 * c2
    a22 = m2 * l2**2 / 3
    a12 = a22 + coupling * q2.cos()
    a11 = m1 * l1**2 / 3 + m2 * l1**2 + a22 + 2 * coupling * q2.cos()
    lower = m2 * c2 * _GRAVITY * (q1 + q2).sin()
    upper = (m1 * c1 + m2 * l1) * _GRAVITY * q1.sin() + lower
    b1 = torque1 + coupling * q2.sin() * (2 * v1 * v2 + v2**2) - upper
    b2 = torque2 - coupling * q2.sin() * v1**2 - lower
    b1 = b1 - damping * v1 - friction * (v1 / 0.3).tanh()
    b2 = b2 - damping * v2 - friction * (v2 / 0.3).tanh()
    determinant = a11 * a22 - a12**2
    return torch.stack(
        [(a22 * b1 - a12 * b2) / determinant, (a11 * b2 - a12 * b1) / determinant], dim=-1
    )


def _crude_links(X: Tensor) -> Tensor:
    """Masses 15 to 19 % off, no friction."""
    return links(X, (0.85, 0.95), damping=0.0, friction=0.0)


def _hartmann(X: Tensor, high: bool) -> Tensor:
    function = PAIRS["hartmann6"].high if high else PAIRS["hartmann6"].low
    return torch.as_tensor(function(X.detach().numpy())).unsqueeze(-1)


def _crude_hartmann(X: Tensor) -> Tensor:
    return _hartmann(X, high=False)
