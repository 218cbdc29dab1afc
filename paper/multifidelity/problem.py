"""The pairs of functions of low and high fidelity, and the data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import BlackBoxPhysics
from paper.multifidelity.functions import FUNCTIONS


@dataclass(frozen=True)
class Pair:
    """A function of high fidelity, the truth, and one of low fidelity, the physics.

    Attributes:
        name: The name in ``FUNCTIONS``.
        high: Maps ``N x d`` to ``N``.
        low: Likewise.
        bounds: Lower and upper bounds of the inputs, ``2 x d``.
    """

    name: str
    high: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    low: Callable[[NDArray[np.float64]], NDArray[np.float64]]
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

    def scaled(self, unit: Tensor) -> Tensor:
        """Map the unit cube to the bounds."""
        return self.bounds[0] + (self.bounds[1] - self.bounds[0]) * unit

    def sobol(self, n: int, seed: int) -> Tensor:
        """The first ``n`` points of a scrambled Sobol sequence in the bounds, ``n x d``."""
        return self.scaled(SobolEngine(self.d, scramble=True, seed=seed).draw(n).double())


def pair(name: str) -> Pair:
    """The pair of a given name.

    Raises:
        ValueError: If there is none.
    """
    if name not in FUNCTIONS:
        raise ValueError(f"There is no pair {name!r}; there are {', '.join(FUNCTIONS)}.")
    of = FUNCTIONS[name]
    return Pair(name, of.high, of.low, torch.tensor([of.lower, of.upper], dtype=torch.float64))


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
