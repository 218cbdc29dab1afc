"""Cases of textbook problems: a physics, observations of a system, and what is asked for.

The line is Plumlee's (2017), the decay that of Bayarri et al. (2007), with numbers that vary.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from gpadjust.physics import FunctionPhysics, ParameterValues, Unknown

Values = NDArray[np.float64]
GRAVITY = 9.81


@dataclass(frozen=True)
class Case:
    """A case of a problem.

    Args:
        law: The physics, of one input and one output.
        unknowns: Its unknown parameters.
        X: Inputs, ``n x 1``.
        system: What the system does there, ``n x 1``, and what is observed but for noise.
        noise: The standard deviation of that.
        true: The parameters that the system has, in so far as it has any.
        seed: Of the noise.
    """

    law: Callable[[Tensor, ParameterValues], Tensor]
    unknowns: Mapping[str, Unknown]
    X: Tensor
    system: Tensor
    noise: float
    true: Mapping[str, float]
    seed: int

    @property
    def physics(self) -> FunctionPhysics:
        """The physics."""
        return FunctionPhysics(self.law, unknowns=self.unknowns, name="law")

    @property
    def observations(self) -> Tensor:
        """What is observed, ``n x 1``."""
        generator = torch.Generator().manual_seed(1000 + self.seed)
        noise = torch.randn(self.system.shape, generator=generator, dtype=torch.float64)
        return self.system + self.noise * noise

    @property
    def best(self) -> dict[str, float]:
        """The parameters with which the physics describes the system best, by least squares."""
        physics, names = self.physics, [*self.unknowns]

        def errors(values: Values) -> Values:
            found = physics(self.X, torch.from_numpy(values))
            error: Values = (found - self.system).flatten().numpy()
            return error

        start = physics.unknowns.guess.numpy()
        found = least_squares(errors, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
        return dict(zip(names, found.x.tolist(), strict=True))


def case(problem: str, seed: int) -> Case:
    """The case of a problem that a seed draws."""
    return _CASES[problem](np.random.default_rng(seed), seed)


def _right(draw: np.random.Generator, seed: int) -> Case:
    size, rate = draw.normal(5, 1), math.exp(draw.normal(0, 0.3))
    unknowns = {"size": Unknown(5.0, sd=1.0), "rate": Unknown(1.0, factor=math.exp(0.3))}
    X = _grid(0.1, 3, 15)
    true = {"size": size, "rate": rate}
    return Case(_growth, unknowns, X, size * (1 - (-rate * X).exp()), 0.1, true, seed)


def _growth(X: Tensor, p: ParameterValues) -> Tensor:
    grown: Tensor = p.size * (1 - (-p.rate * X[:, 0]).exp())
    return grown


def _smooth(draw: np.random.Generator, seed: int) -> Case:
    slope, frequency = draw.uniform(2, 5), draw.uniform(4, 7)
    X = _grid(0.02, 1, 17)
    system = slope * X + X * (frequency * X).sin()
    return Case(_line, {"slope": Unknown(3.0, sd=2.0)}, X, system, 0.02, {}, seed)


def _line(X: Tensor, p: ParameterValues) -> Tensor:
    value: Tensor = p.slope * X[:, 0]
    return value


def _confounded(draw: np.random.Generator, seed: int) -> Case:
    rate, rest = draw.uniform(1.2, 2.2), draw.uniform(0.5, 2)
    X = _grid(0.1, 3, 20)
    system = 3.5 * (-rate * X).exp() + rest
    true = {"rate": rate}
    return Case(_decay, {"rate": Unknown(1.0, factor=2.0)}, X, system, 0.1, true, seed)


def _decay(X: Tensor, p: ParameterValues) -> Tensor:
    value: Tensor = 5 * (-p.rate * X[:, 0]).exp()
    return value


def _ball(draw: np.random.Generator, seed: int) -> Case:
    height, drag = draw.uniform(40, 60), draw.uniform(0.002, 0.02)  # m, 1/m
    X = _grid(0.05, 2, 20)
    fallen = (math.sqrt(GRAVITY * drag) * X).cosh().log() / drag
    unknowns = {
        "gravity": Unknown(9.0, sd=2.0, unit="m/s²"),
        "height": Unknown(50.0, sd=20.0, unit="m"),
    }
    true = {"gravity": GRAVITY, "height": height}
    return Case(_fall, unknowns, X, height - fallen, 0.05, true, seed)


def _fall(X: Tensor, p: ParameterValues) -> Tensor:
    value: Tensor = p.height - 0.5 * p.gravity * X[:, 0].square()
    return value


def _grid(low: float, high: float, n: int) -> Tensor:
    return torch.linspace(low, high, n, dtype=torch.float64).unsqueeze(-1)


_CASES: dict[str, Callable[[np.random.Generator, int], Case]] = {
    "right": _right,
    "smooth": _smooth,
    "confounded": _confounded,
    "ball": _ball,
}
