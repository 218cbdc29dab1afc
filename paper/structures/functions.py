"""Textbook functions of high and low fidelity, in NumPy, and the data that are drawn of them.

Sums are taken in an order that keeps committed results the same bit for bit: a last digit that
differs may lead a search for hyper-parameters to another of its optima.

Sources, which the pairs name:

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
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import BlackBoxPhysics

Array = NDArray[np.float64]
Function = Callable[[Array], Array]


@dataclass(frozen=True)
class Pair:
    """A function of high fidelity, the truth, and one of low fidelity, the physics.

    Attributes:
        name: The name in ``PAIRS``.
        high: Maps ``N x d`` to ``N``.
        low: Likewise.
        bounds: Lower and upper bounds of the inputs, ``2 x d``.
    """

    name: str
    high: Function
    low: Function
    bounds: Tensor

    @property
    def d(self) -> int:
        """Number of inputs."""
        return self.bounds.shape[1]

    def truth(self, X: Tensor) -> Tensor:
        """The function of high fidelity at ``n x d`` inputs: ``n x 1``."""
        return torch.from_numpy(self.high(X.numpy())).unsqueeze(-1)

    def physics(self) -> BlackBoxPhysics:
        """The function of low fidelity as f_p, with an empty memo."""
        return BlackBoxPhysics(self.low, gradient=None, name=f"{self.name}, low fidelity")

    def smooth_physics(self) -> BlackBoxPhysics:
        """The same with gradients by finite differences, also at the bounds, where inputs end."""
        lower, upper = self.bounds.numpy()

        def low(X: Array) -> Array:
            return self.low(np.clip(X, lower, upper))

        return BlackBoxPhysics(low, name=f"{self.name}, low fidelity")

    def scaled(self, unit: Tensor) -> Tensor:
        """Map the unit cube to the bounds."""
        return self.bounds[0] + (self.bounds[1] - self.bounds[0]) * unit

    def sobol(self, n: int, seed: int) -> Tensor:
        """The first ``n`` points of a scrambled Sobol sequence in the bounds, ``n x d``."""
        return self.scaled(SobolEngine(self.d, scramble=True, seed=seed).draw(n).double())


def observations(pair: Pair, n: int, seed: int) -> tuple[Tensor, Tensor]:
    """Observe the truth without noise on a random Latin hypercube: ``n x d`` and ``n x 1``."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.stack([torch.randperm(n, generator=generator) for _ in range(pair.d)], dim=-1)
    within = torch.rand(n, pair.d, generator=generator, dtype=torch.float64)
    X = pair.scaled((cells + within) / n)
    return X, pair.truth(X)


def low_inputs(pair: Pair, X: Tensor, n: int, seed: int) -> Tensor:
    """Where the low level is sampled: at ``X``, and on a Sobol sequence up to ``n`` points."""
    return torch.cat([X, pair.sobol(n - len(X), seed)])


def branin(X: Array) -> Array:
    """Branin's function, ``N x 2`` to ``N``."""
    x1, x2 = X.T
    parabola = x2 - 5.1 * (x1**2 / (4 * np.pi**2)) + 5 * x1 / np.pi - 6
    return parabola**2 + 10 * np.cos(x1) * (1 - 1 / (8 * np.pi)) + 10


def _currin(x1: Array, x2: Array) -> Array:
    decay = 1 - np.exp(-0.5 / np.maximum(x2, 1e-8))  # 1 at x2 = 0, the limit
    upper = 2300 * x1**3 + 1900 * x1**2 + 2092 * x1 + 60
    return decay * upper / (100 * x1**3 + 500 * x1**2 + 4 * x1 + 20)


def _around(high: Function, X: Array, x1: Array, x2: Array) -> Array:
    """The mean of four points around each, of which x2 is not below 0."""
    steps = [(step, other) for step in (0.05, -0.05) for other in (0.05, -0.05)]
    around = [high(np.stack([x1 + a, np.maximum(x2 + b, 0.0)], axis=1)) for a, b in steps]
    return np.mean(around, axis=0)


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


def _hartmann(X: Array, low: bool) -> Array:
    """Hartmann's function, scaled; of low fidelity with other weights and exponential."""
    exponents: Array = -(_HARTMANN_A * (X[:, None] - _HARTMANN_P) ** 2).sum(-1)  # N x 4
    at = np.exp(-4 / 9)
    exponentials = (at + at * (exponents + 4) / 9) ** 9 if low else np.exp(exponents)
    weights = np.array([0.5, 0.5, 2.0, 4.0] if low else [1.0, 1.2, 3.0, 3.2])
    return -(1 / 1.94) * (exponentials @ weights + 2.58)


def _park91a(x1: Array, x2: Array, x3: Array, x4: Array) -> Array:
    root = np.sqrt(1 + (x2 + x3**2) * x4 / x1**2)
    return x1 / 2 * (root - 1) + (x1 + 3 * x4) * np.exp(1 + np.sin(x3))


PAIRS: dict[str, Pair] = {}


def _add(
    name: str,
    lower: tuple[float, ...],
    upper: tuple[float, ...],
    high: Callable[..., Any],
    low: Callable[..., Any],
) -> None:
    """Enter a pair.

    Args:
        name: Its name.
        lower: The lower bounds of the inputs, ``d`` numbers.
        upper: The upper bounds.
        high: Of high fidelity, given the ``d`` inputs, ``N`` each.
        low: Of low fidelity, given that of high fidelity, the inputs as ``N x d``, and each input.
    """

    def of_high(X: Array) -> Array:
        found: Array = high(*X.T)
        return found

    def of_low(X: Array) -> Array:
        found: Array = low(of_high, X, *X.T)
        return found

    bounds = torch.tensor([lower, upper], dtype=torch.float64)
    PAIRS[name] = Pair(name, of_high, of_low, bounds)


def _stacked(function: Function) -> Callable[..., Array]:
    """A function of all inputs at once, given each."""
    return lambda *x: function(np.stack(x, axis=1))


_add(  # Dong et al. (2015)
    *("bohachevsky", (-5, -5), (5, 5)),
    lambda x1, x2: (
        x1**2 + 2 * x2**2 - 0.3 * np.cos(3 * np.pi * x1) - 0.4 * np.cos(4 * np.pi * x2) + 0.7
    ),
    lambda high, X, x1, x2: high(X * [0.7, 1.0]) + (x1 * x2 - 12),
)
_add(  # Dong et al. (2015)
    *("booth", (-10, -10), (10, 10)),
    lambda x1, x2: (x1 + 2 * x2 - 7) ** 2 + (2 * x1 + x2 - 5) ** 2,
    lambda high, X, x1, x2: high(X * [0.4, 1.0]) + (1.7 * x1 * x2 - x1 + 2 * x2),
)
_add(  # with a trend; Dong et al. (2015)
    *("branin", (-5, 0), (10, 15)),
    lambda x1, x2: _stacked(branin)(x1, x2) - 22.5 * x2,
    lambda high, X, x1, x2: branin(0.7 * X) - 15.75 * x2 + 20 * (0.9 + x1) ** 2 - 50,
)
# Currin et al. (1988), and Xiong et al. (2013)
_add("currin", (0, 0), (1, 1), _currin, _around)
_add(  # Forrester et al. (2007)
    *("forrester", (0,), (1,)),
    lambda x: (6 * x - 2) ** 2 * np.sin(12 * x - 4),
    lambda high, X, x: 0.5 * high(X) + 10 * (x - 0.5) - 5,
)
_add(  # Park et al. (2017)
    *("hartmann6", (0.1,) * 6, (1,) * 6),
    _stacked(lambda X: _hartmann(X, low=False)),
    lambda high, X, *x: _hartmann(X, low=True),
)
_add(  # Park (1991), and Xiong et al. (2013); the root divides by x1
    *("park91a", (1e-8, 0, 0, 0), (1, 1, 1, 1), _park91a),
    lambda high, X, x1, x2, x3, x4: (
        (1 + np.sin(x1) / 10) * high(X) + (-2 * x1 + x2**2 + x3**2) + 0.5
    ),
)
