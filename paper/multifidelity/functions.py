"""Textbook functions of high and low fidelity, in NumPy.

Sums are taken in an order that keeps committed results the same bit for bit: a last digit that
differs may lead a search for hyper-parameters to another of its optima.

Sources, which the functions name:

- Currin et al. (1988): A Bayesian approach to the design and analysis of computer experiments.
  ORNL-6498, Oak Ridge National Laboratory.
- Dong et al. (2015): Multi-fidelity information fusion based on prediction of kriging. Structural
  and Multidisciplinary Optimization 51, 1267-1280.
- Forrester, Sobester and Keane (2007): Multi-fidelity optimization via surrogate modelling.
  Proceedings of the Royal Society A 463, 3251-3269.
- Park (1991): Tuning complex computer codes to data and optimal designs. Thesis, University of
  Illinois.
- Park, Haftka and Kim (2017): Remarks on multi-fidelity surrogates. Structural and
  Multidisciplinary Optimization 55, 1029-1050.
- Xiong, Qian and Wu (2013): Sequential design and analysis of high-accuracy and low-accuracy
  computer codes. Technometrics 55, 37-46.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Functions(NamedTuple):
    """A function of high fidelity, one of low fidelity, and where their inputs lie.

    Attributes:
        high: Maps ``N x d`` to ``N``.
        low: Likewise.
        lower: The lower bounds of the inputs, ``d`` numbers.
        upper: The upper bounds.
    """

    high: Callable[[Array], Array]
    low: Callable[[Array], Array]
    lower: tuple[float, ...]
    upper: tuple[float, ...]


def bohachevsky_high(X: Array) -> Array:
    """Bohachevsky's function, ``N x 2`` to ``N``; Dong et al. (2015)."""
    x1, x2 = X.T
    waves = 0.3 * np.cos(3 * np.pi * x1), 0.4 * np.cos(4 * np.pi * x2)
    return x1**2 + 2 * x2**2 - waves[0] - waves[1] + 0.7


def bohachevsky_low(X: Array) -> Array:
    """Of low fidelity; Dong et al. (2015)."""
    x1, x2 = X.T
    return bohachevsky_high(X * [0.7, 1.0]) + (x1 * x2 - 12)


def booth_high(X: Array) -> Array:
    """Booth's function, ``N x 2`` to ``N``; Dong et al. (2015)."""
    x1, x2 = X.T
    return (x1 + 2 * x2 - 7) ** 2 + (2 * x1 + x2 - 5) ** 2


def booth_low(X: Array) -> Array:
    """Of low fidelity; Dong et al. (2015)."""
    x1, x2 = X.T
    return booth_high(X * [0.4, 1.0]) + (1.7 * x1 * x2 - x1 + 2 * x2)


def branin(X: Array) -> Array:
    """Branin's function, ``N x 2`` to ``N``."""
    x1, x2 = X.T
    parabola = x2 - 5.1 * (x1**2 / (4 * np.pi**2)) + 5 * x1 / np.pi - 6
    return parabola**2 + 10 * np.cos(x1) * (1 - 1 / (8 * np.pi)) + 10


def branin_high(X: Array) -> Array:
    """Branin's function with a trend, ``N x 2`` to ``N``; Dong et al. (2015)."""
    return branin(X) - 22.5 * X[:, 1]


def branin_low(X: Array) -> Array:
    """Of low fidelity; Dong et al. (2015)."""
    x1, x2 = X.T
    return branin(0.7 * X) - 15.75 * x2 + 20 * (0.9 + x1) ** 2 - 50


def currin_high(X: Array) -> Array:
    """The exponential function of Currin et al. (1988), ``N x 2`` to ``N``."""
    x1, x2 = X.T
    decay = 1 - np.exp(-0.5 / np.maximum(x2, 1e-8))  # 1 at x2 = 0, the limit
    upper = 2300 * x1**3 + 1900 * x1**2 + 2092 * x1 + 60
    return decay * upper / (100 * x1**3 + 500 * x1**2 + 4 * x1 + 20)


def currin_low(X: Array) -> Array:
    """The mean of four points around each, of which x2 is not below 0; Xiong et al. (2013)."""
    x1, x2 = X.T
    around = [
        currin_high(np.stack([x1 + step, np.maximum(x2 + other, 0.0)], axis=1))
        for step in (0.05, -0.05)
        for other in (0.05, -0.05)
    ]
    return np.mean(around, axis=0)


def forrester_high(X: Array) -> Array:
    """The function of Forrester et al. (2007), ``N x 1`` to ``N``."""
    x = X[:, 0]
    return (6 * x - 2) ** 2 * np.sin(12 * x - 4)


def forrester_low(X: Array) -> Array:
    """``A f + B (x - 1/2) + C`` with A = 1/2, B = 10, C = -5; Forrester et al. (2007)."""
    return 0.5 * forrester_high(X) + 10 * (X[:, 0] - 0.5) - 5


def hartmann6_high(X: Array) -> Array:
    """Hartmann's function of six inputs, scaled, ``N x 6`` to ``N``; Park et al. (2017)."""
    return _hartmann6(np.exp(_hartmann6_exponents(X)), np.array([1.0, 1.2, 3.0, 3.2]))


def hartmann6_low(X: Array) -> Array:
    """Other weights, and an approximate exponential about -4; Park et al. (2017)."""
    at = np.exp(-4 / 9)
    exponential = (at + at * (_hartmann6_exponents(X) + 4) / 9) ** 9
    return _hartmann6(exponential, np.array([0.5, 0.5, 2.0, 4.0]))


_HARTMANN_A = np.array(
    [
        [10, 3, 17, 3.5, 1.7, 8],
        [0.05, 10, 17, 0.1, 8, 14],
        [3, 3.5, 1.7, 10, 17, 8],
        [17, 8, 0.05, 10, 0.1, 14],
    ]
)
_HARTMANN_P = np.array(
    [
        [0.1312, 0.1696, 0.5569, 0.0124, 0.8283, 0.5886],
        [0.2329, 0.4135, 0.8307, 0.3736, 0.1004, 0.9991],
        [0.2348, 0.1451, 0.3522, 0.2883, 0.3047, 0.6650],
        [0.4047, 0.8828, 0.8732, 0.5743, 0.1091, 0.0381],
    ]
)


def _hartmann6_exponents(X: Array) -> Array:
    """``N x 4``."""
    exponents: Array = -(_HARTMANN_A * (X[:, None] - _HARTMANN_P) ** 2).sum(-1)
    return exponents


def _hartmann6(exponentials: Array, weights: Array) -> Array:
    return -(1 / 1.94) * (exponentials @ weights + 2.58)


def himmelblau_high(X: Array) -> Array:
    """Himmelblau's function, ``N x 2`` to ``N``; Dong et al. (2015)."""
    x1, x2 = X.T
    return (x1**2 + x2 - 11) ** 2 + (x2**2 + x1 - 7) ** 2


def himmelblau_low(X: Array) -> Array:
    """Of low fidelity; Dong et al. (2015)."""
    x1, x2 = X.T
    return himmelblau_high(X * [0.5, 0.8]) + (x2**3 - (x1 + 1) ** 2)


def park91a_high(X: Array) -> Array:
    """The first function of Park (1991), ``N x 4`` to ``N``."""
    x1, x2, x3, x4 = X.T
    root = np.sqrt(1 + (x2 + x3**2) * x4 / x1**2)
    return x1 / 2 * (root - 1) + (x1 + 3 * x4) * np.exp(1 + np.sin(x3))


def park91a_low(X: Array) -> Array:
    """Of low fidelity; Xiong et al. (2013)."""
    x1, x2, x3, _ = X.T
    return (1 + np.sin(x1) / 10) * park91a_high(X) + (-2 * x1 + x2**2 + x3**2) + 0.5


def park91b_high(X: Array) -> Array:
    """The second function of Park (1991), ``N x 4`` to ``N``."""
    x1, x2, x3, x4 = X.T
    return 2 / 3 * np.exp(x1 + x2) - x4 * np.sin(x3) + x3


def park91b_low(X: Array) -> Array:
    """Of low fidelity; Xiong et al. (2013)."""
    return 1.2 * park91b_high(X) - 1


def six_hump_camelback_high(X: Array) -> Array:
    """The six-hump camel-back function, ``N x 2`` to ``N``; Dong et al. (2015)."""
    x1, x2 = X.T
    one, two = x1**2, x2**2
    return (4 - 2.1 * one + one * one / 3) * one + x1 * x2 + (4 * two - 4) * two


def six_hump_camelback_low(X: Array) -> Array:
    """Of low fidelity; Dong et al. (2015)."""
    return six_hump_camelback_high(0.7 * X) + (X[:, 0] * X[:, 1] - 15)


FUNCTIONS = {
    "bohachevsky": Functions(bohachevsky_high, bohachevsky_low, (-5, -5), (5, 5)),
    "booth": Functions(booth_high, booth_low, (-10, -10), (10, 10)),
    "branin": Functions(branin_high, branin_low, (-5, 0), (10, 15)),
    "currin": Functions(currin_high, currin_low, (0, 0), (1, 1)),
    "forrester": Functions(forrester_high, forrester_low, (0,), (1,)),
    "hartmann6": Functions(hartmann6_high, hartmann6_low, (0.1,) * 6, (1,) * 6),
    "himmelblau": Functions(himmelblau_high, himmelblau_low, (-4, -4), (4, 4)),
    # The root divides by x1.
    "park91a": Functions(park91a_high, park91a_low, (1e-8, 0, 0, 0), (1, 1, 1, 1)),
    "park91b": Functions(park91b_high, park91b_low, (0,) * 4, (1,) * 4),
    "six_hump_camelback": Functions(
        six_hump_camelback_high, six_hump_camelback_low, (-2, -2), (2, 2)
    ),
}
