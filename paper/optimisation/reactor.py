"""A batch reactor, A to B to C, and what a textbook says of it."""

from __future__ import annotations

import torch
from torch import Tensor

GAS = 8.314e-3  # kJ / (mol K)
STEPS = 100  # of the true rates, in equal parts of the batch's time


def truth(temperature: Tensor, time: Tensor, catalyst: Tensor) -> tuple[Tensor, Tensor]:
    """What comes out: the shares of A that became B and C.

    The first reaction is of order 1.3, the catalyst fades, and hot product reacts with A.

    Args:
        temperature: In degrees Celsius, ``N``.
        time: In hours, ``N``.
        catalyst: In mol %, ``N``.

    Returns:
        Yield of B and share of C, ``N`` each.
    """
    kelvin = temperature + 273.15
    first = 1.1 * catalyst**0.8 * _arrhenius(kelvin, 58.0)
    second = 0.12 * _arrhenius(kelvin, 92.0)
    side = 0.08 * _arrhenius(kelvin, 75.0)
    fading = 0.15 * _arrhenius(kelvin, 40.0)

    def rates(t: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        to_b = first * (-fading * t).exp() * a.clamp_min(0) ** 1.3
        lost = side * a * b
        return -to_b - lost, to_b - second * b - lost

    h = time / STEPS
    a, b = torch.ones_like(time), torch.zeros_like(time)
    for i in range(STEPS):  # Heun's method
        da, db = rates(i * h, a, b)
        ea, eb = rates((i + 1) * h, a + h * da, b + h * db)
        a, b = a + h * (da + ea) / 2, b + h * (db + eb) / 2
    return b, 1 - a - b


def textbook(temperature: Tensor, time: Tensor, catalyst: Tensor) -> tuple[Tensor, Tensor]:
    """Two first-order reactions in a row, with constants from elsewhere, as :func:`truth`."""
    kelvin = temperature + 273.15
    first = 0.8 * catalyst * _arrhenius(kelvin, 65.0)
    second = 0.08 * _arrhenius(kelvin, 85.0)
    gap = second - first
    gap = torch.where(gap.abs() < 1e-9, torch.full_like(gap, 1e-9), gap)
    a, once = (-first * time).exp(), (-second * time).exp()
    b = first * (a - once) / gap
    return b, 1 - a - b


def output(temperature: Tensor, time: Tensor, catalyst: Tensor) -> Tensor:
    """The textbook's yield of B, as a physics for Ax: its arguments are parameters by name."""
    return textbook(temperature, time, catalyst)[0]


def share_of_c(temperature: Tensor, time: Tensor, catalyst: Tensor) -> Tensor:
    """The textbook's share of the by-product."""
    return textbook(temperature, time, catalyst)[1]


def _arrhenius(kelvin: Tensor, energy: float) -> Tensor:
    """The factor of a rate, 1 at 80 degrees Celsius."""
    return (energy / GAS * (1 / 353.15 - 1 / kelvin)).exp()
