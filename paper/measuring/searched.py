"""What is optimised: the truth, the physics, and how far a trial is from the best."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
import torch
from ax.api.configs import RangeParameterConfig
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor
from torch.quasirandom import SobolEngine

from paper.pairs.functions import pair


@dataclass(frozen=True)
class Range:
    """A parameter, in the units of the search space."""

    name: str
    lower: float
    upper: float
    scaling: Literal["linear", "log"] = "linear"

    def config(self) -> RangeParameterConfig:
        """It as Ax's client takes it."""
        return RangeParameterConfig(
            name=self.name,
            bounds=(self.lower, self.upper),
            parameter_type="float",
            scaling=self.scaling,
        )

    def at(self, unit: Tensor) -> Tensor:
        """From the unit interval."""
        if self.scaling == "log":
            return self.lower * (self.upper / self.lower) ** unit
        return self.lower + (self.upper - self.lower) * unit


@dataclass(frozen=True)
class Problem:
    """Something to minimise, with what is believed of it.

    Attributes:
        ranges: The parameters.
        truth: Metrics by their names, ``N`` each, of ``N x d``; the first is the objective.
        physics: f_p by metric, as ``gpadjust.ax`` takes it.
        objective: As Ax's client takes it.
        sign: -1 if the objective is to be large.
        limit: What the second metric must not exceed, if there is one.
    """

    ranges: tuple[Range, ...]
    truth: Callable[[Tensor], dict[str, Tensor]]
    physics: Mapping[str, Any]
    objective: str
    sign: float = 1.0
    limit: float | None = None

    @property
    def constraints(self) -> list[str]:
        """The outcome constraints, as Ax's client takes them."""
        return [] if self.limit is None else [f"{self.metrics[1]} <= {self.limit}"]

    @property
    def metrics(self) -> list[str]:
        """Their names."""
        return [*self.truth(self.points(1))]

    def points(self, n: int) -> Tensor:
        """The first ``n`` points of a Sobol sequence in the search space, ``n x d``."""
        unit = SobolEngine(len(self.ranges), scramble=True, seed=0).draw(n).double()
        return self.scaled(unit)

    def scaled(self, unit: Tensor) -> Tensor:
        """From the unit cube to the search space."""
        columns = zip(self.ranges, unit.unbind(-1), strict=True)
        return torch.stack([each.at(column) for each, column in columns], dim=-1)

    def measure(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """A trial, without noise."""
        X = torch.tensor([[parameters[each.name] for each in self.ranges]], dtype=torch.float64)
        return {name: value.item() for name, value in self.truth(X).items()}

    def values(self, metrics: Mapping[str, Any]) -> Any:
        """What is minimised; infinite where the constraint is broken."""
        objective, *others = map(np.asarray, metrics.values())
        value = self.sign * objective
        return value if self.limit is None else np.where(others[0] <= self.limit, value, np.inf)


def problem(name: str) -> Problem:
    """The problem of a given name."""
    return _reactor() if name == "reactor" else _pair(name)


@cache
def scale(name: str, num_random: int) -> tuple[float, float]:
    """The best value of a problem, and how far the median of random (feasible) points is off."""
    system = problem(name)
    unit = SobolEngine(len(system.ranges), scramble=True, seed=0).draw(num_random).double()
    values = system.values({k: v.numpy() for k, v in system.truth(system.scaled(unit)).items()})
    feasible = np.isfinite(values)

    def at(u: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        X = system.scaled(torch.from_numpy(u).clamp(0, 1).unsqueeze(0))
        return [v.numpy()[0] for v in system.truth(X).values()]

    def room(u: NDArray[np.float64]) -> float:
        return 0.0 if system.limit is None else float(system.limit - at(u)[1])

    limits = [] if system.limit is None else [{"type": "ineq", "fun": room}]
    best = float(values[feasible].min())
    for start in unit[np.argsort(values)[:20]].numpy():
        found = minimize(
            lambda u: system.sign * at(u)[0],
            start,
            method="SLSQP",
            bounds=[(0.0, 1.0)] * len(system.ranges),
            constraints=limits,
            options={"ftol": 1e-12, "maxiter": 500},
        )
        if room(found.x) > -1e-9:
            best = min(best, float(found.fun))
    return best, float(np.median(values[feasible])) - best


def _pair(name: str) -> Problem:
    """A function of high fidelity to minimise, by that of low fidelity."""
    functions = pair(name)
    ranges = tuple(
        Range(f"x{i + 1}", *bounds) for i, bounds in enumerate(functions.bounds.mT.tolist())
    )
    return Problem(
        ranges,
        lambda X: {"value": functions.truth(X).squeeze(-1)},
        {"value": functions.smooth_physics()},
        "-value",
    )


def _reactor() -> Problem:
    """The yield of a batch reactor, A to B to C, with a limit to its by-product."""
    return Problem(
        (
            Range("temperature", 40.0, 120.0),
            Range("time", 0.1, 20.0, "log"),
            Range("catalyst", 0.2, 2.0),
        ),
        lambda X: dict(zip(("output", "impurity"), reactor(*X.unbind(-1)), strict=True)),
        {"output": output, "impurity": share_of_c},
        "output",
        sign=-1.0,
        limit=0.08,
    )


_GAS = 8.314e-3  # kJ / (mol K)
_STEPS = 100  # of the true rates, in equal parts of the batch's time


def reactor(temperature: Tensor, time: Tensor, catalyst: Tensor) -> tuple[Tensor, Tensor]:
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

    h = time / _STEPS
    a, b = torch.ones_like(time), torch.zeros_like(time)
    for i in range(_STEPS):  # Heun's method
        da, db = rates(i * h, a, b)
        ea, eb = rates((i + 1) * h, a + h * da, b + h * db)
        a, b = a + h * (da + ea) / 2, b + h * (db + eb) / 2
    return b, 1 - a - b


def textbook(temperature: Tensor, time: Tensor, catalyst: Tensor) -> tuple[Tensor, Tensor]:
    """Two first-order reactions in a row, with constants from elsewhere, as :func:`reactor`."""
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
    return (energy / _GAS * (1 / 353.15 - 1 / kelvin)).exp()
