"""Functions that are nearly polynomials, and others of low fidelity, in NumPy.

The rest of the pairs is among those of ``paper.multifidelity.functions``. Rosenbrock's, Beale's,
McCormick's, Dixon and Price's and the camel's are textbook functions (Surjanovic and Bingham 2013:
Virtual Library of Simulation Experiments); what is of low fidelity is our own.
"""

from __future__ import annotations

import numpy as np

from paper.multifidelity.functions import FUNCTIONS, Array, Functions


def chebyshev_high(X: Array) -> Array:
    """Chebyshev's polynomial of degree 5, ``N x 1`` to ``N``."""
    x = X[:, 0]
    return 16 * x**5 - 20 * x**3 + 5 * x


def chebyshev_low(X: Array) -> Array:
    """Stretched, with a parabola."""
    return 0.6 * chebyshev_high(0.9 * X) + 0.3 * X[:, 0] ** 2


def growth_high(X: Array) -> Array:
    """An exponential and a cubic, ``N x 1`` to ``N``."""
    x = X[:, 0]
    return np.exp(x) + x**3


def growth_low(X: Array) -> Array:
    """Slower, with a parabola."""
    return 0.7 * growth_high(0.8 * X) - X[:, 0] ** 2


def three_hump_camel_high(X: Array) -> Array:
    """The three-hump camel function, ``N x 2`` to ``N``."""
    x1, x2 = X.T
    return 2 * x1**2 - 1.05 * x1**4 + x1**6 / 6 + x1 * x2 + x2**2


def three_hump_camel_low(X: Array) -> Array:
    """Stretched, with a product."""
    return three_hump_camel_high(0.8 * X) + X[:, 0] * X[:, 1] - 2


def rosenbrock_high(X: Array) -> Array:
    """Rosenbrock's function, ``N x 2`` to ``N``."""
    x1, x2 = X.T
    return 100 * (x2 - x1**2) ** 2 + (1 - x1) ** 2


def rosenbrock_low(X: Array) -> Array:
    """Stretched, with a parabola."""
    return rosenbrock_high(0.85 * X) + 50 * X[:, 0] ** 2 - 10


def beale_high(X: Array) -> Array:
    """Beale's function, ``N x 2`` to ``N``."""
    x1, x2 = X.T
    parts = [(c - x1 + x1 * x2**k) ** 2 for k, c in ((1, 1.5), (2, 2.25), (3, 2.625))]
    return parts[0] + parts[1] + parts[2]


def beale_low(X: Array) -> Array:
    """Stretched, with a product."""
    return beale_high(0.8 * X) + 2 * X[:, 0] * X[:, 1] - 3


def mccormick_high(X: Array) -> Array:
    """McCormick's function, ``N x 2`` to ``N``."""
    x1, x2 = X.T
    return np.sin(x1 + x2) + (x1 - x2) ** 2 - 1.5 * x1 + 2.5 * x2 + 1


def mccormick_low(X: Array) -> Array:
    """A share of it, with a product."""
    return 0.6 * mccormick_high(X) + X[:, 0] * X[:, 1] - 2


def dixon_price_high(X: Array) -> Array:
    """Dixon and Price's function of three inputs, ``N x 3`` to ``N``."""
    x1, x2, x3 = X.T
    return (x1 - 1) ** 2 + 2 * (2 * x2**2 - x1) ** 2 + 3 * (2 * x3**2 - x2) ** 2


def dixon_price_low(X: Array) -> Array:
    """Stretched, with a product and a parabola."""
    return dixon_price_high(0.8 * X) + 3 * X[:, 0] * X[:, 2] - 4 * X[:, 1] ** 2


PAIRS = {
    **FUNCTIONS,
    "chebyshev": Functions(chebyshev_high, chebyshev_low, (-1,), (1,)),
    "growth": Functions(growth_high, growth_low, (-2,), (2,)),
    "three_hump_camel": Functions(three_hump_camel_high, three_hump_camel_low, (-2, -2), (2, 2)),
    "rosenbrock": Functions(rosenbrock_high, rosenbrock_low, (-2, -1), (2, 3)),
    "beale": Functions(beale_high, beale_low, (-1.5, -1.5), (1.5, 1.5)),
    "mccormick": Functions(mccormick_high, mccormick_low, (-1.5, -3), (4, 4)),
    "dixon_price": Functions(dixon_price_high, dixon_price_low, (-1,) * 3, (1,) * 3),
}
