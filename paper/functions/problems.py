"""Functions of the unit cube, and formulas for them.

Textbook pairs of high and low fidelity are mapped to it: Currin et al. (1988, ORNL-6498), its low
level by Xiong, Qian and Wu (2013, Technometrics 55); Forrester, Sobester and Keane (2007,
Proceedings of the Royal Society A 463); the others by Dong et al. (2015, Structural and
Multidisciplinary Optimization 51).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

Function = Callable[[Tensor], Tensor]


class Problem(NamedTuple):
    """A function and a formula for it."""

    num_inputs: int  # number `d` of inputs, in [0, 1]
    truth: Function  # maps `n x d` to `n x 1`
    physics: Function  # the same
    noise: float = 0.0  # standard deviation of observations, in that of the function

    def points(self, n: int, seed: int) -> Tensor:
        """Return the first points of a scrambled Sobol sequence, ``n x d``."""
        engine = SobolEngine(self.num_inputs, scramble=True, seed=seed)
        return engine.draw(n, dtype=torch.float64)


PROBLEMS: dict[str, Problem] = {}


def _add(
    name: str, d: int, truth: Callable[..., Tensor], physics: Callable[..., Tensor],
    noise: float = 0.0,
) -> None:  # fmt: skip
    """Enter a problem; its functions take each input, ``... x n``."""

    def of_points(function: Callable[..., Tensor]) -> Function:
        return lambda X: function(*X.unbind(-1)).unsqueeze(-1)

    PROBLEMS[name] = Problem(d, of_points(truth), of_points(physics), noise)


def _beam(a: Tensor, b: Tensor, shear: float) -> Tensor:
    """Return the deflection by length (1 to 3) and height (1 to 2)."""
    length, height = 1 + 2 * a, 1 + b
    return length**3 / height**3 + shear * length / height


def _throttle(a: Tensor, b: Tensor) -> Tensor:
    """Return the flow by opening and pressure."""
    return (0.1 + 0.9 * a) * (0.2 + b) ** 0.5


def _uptake(a: Tensor, b: Tensor, half: float, inhibition: float) -> Tensor:
    """Return the rate by two concentrations, of which one inhibits."""
    return 5 * a / (half * (1 + inhibition * 3 * b) + 5 * a)


def _lens(a: Tensor, b: Tensor, c: Tensor, thickness: float = 0.0) -> Tensor:
    """Return the power of a lens by its two curvatures and its index."""
    one, two, index = 0.5 + a, 0.3 + b, 0.4 + 0.4 * c
    return index * (one - two + thickness * index / (1 + index) * one * two)


def _pipe(a: Tensor, b: Tensor, c: Tensor, exponent: float = 1.5, rough: float = 0.0) -> Tensor:
    """Return the loss of pressure by flow, diameter and length."""
    flow, diameter, length = 0.2 + a, 0.6 + 0.6 * b, 0.3 + c
    return length * flow**exponent / diameter**3 * (1 + rough * flow)


def _wave(a: Tensor) -> Tensor:
    return (8 * a).sin()


def _growth(a: Tensor) -> Tensor:
    return 1 - (-3 * a).exp()


def _scaled(formula: Callable[..., Tensor], d: int) -> Callable[..., Tensor]:
    """Return 1.3 times a function of ``d`` inputs, plus 0.4 of its standard deviation."""
    points = SobolEngine(d).draw(512, dtype=torch.float64)
    offset = 0.4 * formula(*points.unbind(-1)).std()
    return lambda *x: 1.3 * formula(*x) + offset


for _name, _d, _formula in (
    ("wave", 1, _wave), ("growth", 1, _growth), ("throttle", 2, _throttle), ("lens", 3, _lens),
    ("pipe", 3, _pipe),
):  # fmt: skip
    _add(_name, _d, _formula, _formula, noise=0.1)
    _add(f"scaled {_name}", _d, _scaled(_formula, _d), _formula, noise=0.1)

_add("gain", 1, lambda a: (0.5 + a) * (7 * a).sin(), lambda a: (7 * a).sin(), noise=0.05)
_add("decay", 1, lambda a: (-4 * a).exp() + 0.1 * a, lambda a: (-3 * a).exp())
_add("phase", 1, lambda a: (9 * a + 0.6).sin(), lambda a: (9 * a).sin())
_add(
    *("offset", 2),
    lambda a, b: 30 + 1.2 * (5 * a + 3 * b).sin() + a,
    lambda a, b: (5 * a + 3 * b).sin(),
)
_add("shear", 2, lambda a, b: _beam(a, b, 1.5), lambda a, b: _beam(a, b, 0.0), noise=0.05)
_add("uptake", 2, lambda a, b: _uptake(a, b, 0.8, 1.0), lambda a, b: _uptake(a, b, 0.5, 0.0), 0.05)
_add("kink", 2, lambda a, b: (4 * a).sin() + (b - 0.5).abs(), lambda a, b: (4 * a).sin())
_add("thick lens", 3, lambda a, b, c: _lens(a, b, c, 0.6), _lens)
_add("rough pipe", 3, lambda a, b, c: _pipe(a, b, c, 1.8, 0.3), _pipe, noise=0.1)
_add("line for a wave", 1, _wave, lambda a: a)
_add(
    *("peak for a plane", 2),
    lambda a, b: 2 * a - b + 0.5 * (3 * a * b).sin(),
    lambda a, b: (-((a - 0.7).square() + (b - 0.2).square()) / 0.02).exp(),
    0.05,
)
_add("pipe for a lens", 3, _lens, lambda a, b, c: _pipe(b, c, a))


def _forrester(x: Tensor) -> Tensor:
    return (6 * x - 2) ** 2 * (12 * x - 4).sin()


def _branin(x: Tensor, y: Tensor) -> Tensor:
    parabola = y - 5.1 * x**2 / (4 * math.pi**2) + 5 * x / math.pi - 6
    return parabola**2 + 10 * (1 - 1 / (8 * math.pi)) * x.cos() + 10


def _currin(x: Tensor, y: Tensor) -> Tensor:
    decay = 1 - (-0.5 / y.clamp_min(1e-8)).exp()
    upper = 2300 * x**3 + 1900 * x**2 + 2092 * x + 60
    return decay * upper / (100 * x**3 + 500 * x**2 + 4 * x + 20)


def _around(x: Tensor, y: Tensor) -> Tensor:
    """Return the mean of Currin's function at four points around each."""
    steps = ((0.05, 0.05), (0.05, -0.05), (-0.05, 0.05), (-0.05, -0.05))
    return sum((_currin(x + a, (y + b).clamp_min(0)) / 4 for a, b in steps), 0 * x)


def _bohachevsky(x: Tensor, y: Tensor) -> Tensor:
    waves = 0.3 * (3 * math.pi * x).cos() + 0.4 * (4 * math.pi * y).cos()
    return x**2 + 2 * y**2 - waves + 0.7


def _booth(x: Tensor, y: Tensor) -> Tensor:
    return (x + 2 * y - 7) ** 2 + (2 * x + y - 5) ** 2


def _in_bounds(
    function: Callable[..., Tensor], low: float, high: float, low_2: float, high_2: float
) -> Callable[..., Tensor]:
    """Return a function of two inputs in their bounds, as one of the unit square."""
    return lambda a, b: function(low + (high - low) * a, low_2 + (high_2 - low_2) * b)


def _branin_high(x: Tensor, y: Tensor) -> Tensor:
    return _branin(x, y) - 22.5 * y


def _branin_low(x: Tensor, y: Tensor) -> Tensor:
    return _branin(0.7 * x, 0.7 * y) - 15.75 * y + 20 * (0.9 + x) ** 2 - 50


def _bohachevsky_low(x: Tensor, y: Tensor) -> Tensor:
    return _bohachevsky(0.7 * x, y) + x * y - 12


def _booth_low(x: Tensor, y: Tensor) -> Tensor:
    return _booth(0.4 * x, y) + 1.7 * x * y - x + 2 * y


_add("forrester", 1, _forrester, lambda x: 0.5 * _forrester(x) + 10 * (x - 0.5) - 5)
_add("currin", 2, _currin, _around)
for _name, _high, _low, _bounds in (
    ("branin", _branin_high, _branin_low, (-5.0, 10.0, 0.0, 15.0)),
    ("bohachevsky", _bohachevsky, _bohachevsky_low, (-5.0, 5.0, -5.0, 5.0)),
    ("booth", _booth, _booth_low, (-10.0, 10.0, -10.0, 10.0)),
):
    _add(_name, 2, _in_bounds(_high, *_bounds), _in_bounds(_low, *_bounds))
