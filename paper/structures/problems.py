"""Functions of the unit cube, and physics that are right in part."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Problem(NamedTuple):
    """A function of the unit cube and its physics.

    Attributes:
        num_inputs: Number ``d`` of inputs.
        noise: Standard deviation of observations, in those of the function.
        truth: Maps ``n x d`` to ``n``.
        physics: The same.
    """

    num_inputs: int
    noise: float
    truth: Callable[[Tensor], Tensor]
    physics: Callable[[Tensor], Tensor]


def _peak(X: Tensor, middle: float, width: float) -> Tensor:
    return (-0.5 * ((X - middle) / width).square().sum(-1)).exp()


def _beam(X: Tensor, shear: float) -> Tensor:
    """Deflection by length (1 to 3) and height (1 to 2)."""
    length, height = 1 + 2 * X[:, 0], 1 + X[:, 1]
    return length**3 / height**3 + shear * length / height


def _throttle(X: Tensor, exponent: float, leak: float) -> Tensor:
    """Flow by opening and pressure."""
    return (0.1 + 0.9 * X[:, 0]) * (0.2 + X[:, 1]) ** exponent + leak * X[:, 1]


def _uptake(X: Tensor, half: float, inhibition: float) -> Tensor:
    """Rate by two concentrations, of which one inhibits."""
    a, b = 5 * X[:, 0], 3 * X[:, 1]
    return a / (half * (1 + inhibition * b) + a)


def _lens(X: Tensor, thickness: float) -> Tensor:
    """Power of a lens by its two curvatures and its index."""
    one, two, index = 0.5 + X[:, 0], 0.3 + X[:, 1], 0.4 + 0.4 * X[:, 2]
    return index * (one - two + thickness * index / (1 + index) * one * two)


def _pipe(X: Tensor, exponent: float, rough: float) -> Tensor:
    """Loss of pressure by flow, diameter and length."""
    flow, diameter, length = 0.2 + X[:, 0], 0.6 + 0.6 * X[:, 1], 0.3 + X[:, 2]
    return length * flow**exponent / diameter**3 * (1 + rough * flow)


def _exchanger(X: Tensor, loss: float) -> Tensor:
    """Heat by two flows, a difference of temperatures and the area."""
    a, b, difference, area = 0.3 + X[:, 0], 0.3 + X[:, 1], 0.2 + X[:, 2], 0.5 + X[:, 3]
    least = torch.minimum(a, b)
    return least * difference * (1 - (-area / least).exp()) - loss * difference.square()


PROBLEMS = {
    "addend": Problem(
        1, 0.0, lambda X: (8 * X[:, 0]).sin() + 2 * X[:, 0].square(), lambda X: (8 * X[:, 0]).sin()
    ),
    "gain, noise": Problem(
        1, 0.05, lambda X: (0.5 + X[:, 0]) * (7 * X[:, 0]).sin(), lambda X: (7 * X[:, 0]).sin()
    ),
    "decay": Problem(
        1, 0.0, lambda X: (-4 * X[:, 0]).exp() + 0.1 * X[:, 0], lambda X: (-3 * X[:, 0]).exp()
    ),
    "phase": Problem(1, 0.0, lambda X: (9 * X[:, 0] + 0.6).sin(), lambda X: (9 * X[:, 0]).sin()),
    "sign": Problem(
        2,
        0.0,
        lambda X: 0.5 * X[:, 0] - (6 * X[:, 0]).sin() * X[:, 1],
        lambda X: (6 * X[:, 0]).sin() * X[:, 1],
    ),
    "offset": Problem(
        2,
        0.0,
        lambda X: 30 + 1.2 * (5 * X[:, 0] + 3 * X[:, 1]).sin() + X[:, 0],
        lambda X: (5 * X[:, 0] + 3 * X[:, 1]).sin(),
    ),
    "moved peak": Problem(
        2, 0.0, lambda X: _peak(X, 0.6, 0.25) + 0.3 * X[:, 1], lambda X: _peak(X, 0.5, 0.28)
    ),
    "beam": Problem(2, 0.0, lambda X: _beam(X, 1.5), lambda X: _beam(X, 0.0)),
    "throttle, noise": Problem(
        2, 0.05, lambda X: _throttle(X, 0.6, 0.1), lambda X: _throttle(X, 0.5, 0.0)
    ),
    "uptake, noise": Problem(
        2, 0.05, lambda X: _uptake(X, 0.8, 1.0), lambda X: _uptake(X, 0.5, 0.0)
    ),
    "lens": Problem(3, 0.0, lambda X: _lens(X, 0.6), lambda X: _lens(X, 0.0)),
    "pipe, noise": Problem(3, 0.1, lambda X: _pipe(X, 1.8, 0.3), lambda X: _pipe(X, 1.5, 0.0)),
    "exchanger, noise": Problem(
        4, 0.05, lambda X: _exchanger(X, 0.15), lambda X: _exchanger(X, 0.0)
    ),
    "kink": Problem(
        2,
        0.0,
        lambda X: (4 * X[:, 0]).sin() + (X[:, 1] - 0.5).abs(),
        lambda X: (4 * X[:, 0]).sin(),
    ),
}
