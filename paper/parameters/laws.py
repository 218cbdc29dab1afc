"""Laws with unknown parameters, and cases of them: inputs, observations, and the true values.

Cases of textbook problems have a system that is not always the law: the line is Plumlee's (2017),
the decay that of Bayarri et al. (2007), with numbers that vary. The others are of a right law, the
parameters of which observations tell apart badly, or which folds; they are drawn from their priors.
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
from torch.quasirandom import SobolEngine

from gpadjust.physics import FunctionPhysics, ParameterValues, Unknown

Values = NDArray[np.float64]
GRAVITY = 9.81
Law = Callable[[Tensor, ParameterValues], Tensor]


@dataclass(frozen=True)
class Problem:
    """A law with unknown parameters, and what is observed of it."""

    law: Law  # the physics, of one output
    unknowns: Mapping[str, Unknown]  # its parameters
    box: tuple[tuple[float, ...], tuple[float, ...]]  # least and largest inputs, `d` each
    number: int  # of observations
    noise: float  # its standard deviation


@dataclass(frozen=True)
class Case:
    """Observations of a system, and a law of it."""

    X: Tensor  # inputs, `n x d`
    system: Tensor  # the system there without noise, `n x 1`; it need not be the law's
    Y: Tensor  # observations, `n x 1`
    physics: FunctionPhysics  # the law
    true: Mapping[str, float]  # the parameters that the system has, in so far as it has any
    noise: float  # the standard deviation of the noise

    @property
    def best(self) -> dict[str, float]:
        """The parameters with which the physics describes the system best, by least squares."""
        unknowns = self.physics.unknowns

        def errors(values: Values) -> Values:
            found = self.physics(self.X, torch.from_numpy(values))
            error: Values = (found - self.system).flatten().numpy()
            return error

        start = unknowns.guess.numpy()
        found = least_squares(errors, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
        return dict(zip(unknowns, found.x.tolist(), strict=True))


def case(name: str, seed: int, number: int | None = None, places: int | None = None) -> Case:
    """Draw the case of a problem and a seed, with another number of inputs, at other places."""
    problem = PROBLEMS[name]
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(problem.box, dtype=torch.float64)
    engine = SobolEngine(len(low), scramble=True, seed=seed if places is None else places)
    X = low + engine.draw(number or problem.number, dtype=torch.float64) * (high - low)
    physics = FunctionPhysics(problem.law, unknowns=problem.unknowns, name=name)
    z = torch.randn(len(problem.unknowns), generator=generator, dtype=torch.float64)
    true = physics.unknowns.to_values(z)
    noise = torch.randn(len(X), 1, generator=generator, dtype=torch.float64)
    system = physics(X, true)
    named = dict(zip(problem.unknowns, true.tolist(), strict=True))
    return Case(X, system, system + problem.noise * noise, physics, named, problem.noise)


def _beam(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the deflection of a cantilever in a joint that gives, by load and length."""
    load, length = X.T
    return 10 * load * (length**3 / (3 * p.EI) + length**2 / p.kr)


def _reaction(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the conversion after an hour by temperature in K, with a rate by Arrhenius."""
    return 1 - (-(p.logA - p.E / (8.314e-3 * X[:, 0])).exp()).exp()


def _creep(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the strain of a spring and a dashpot under a constant load, before rest."""
    return (1 - (-X[:, 0] * p.E / p.eta).exp()) / p.E


def _inhibited(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the rate of an enzyme by its substrate and an inhibitor."""
    substrate, inhibitor = X.T
    return p.V * substrate / (p.K * (1 + inhibitor / p.Ki) + substrate)


def _spectrum(X: Tensor, p: ParameterValues) -> Tensor:
    """Return three peaks."""
    peaks = ((p[f"a{i}"], p[f"c{i}"], p[f"w{i}"]) for i in (1, 2, 3))
    return sum((a * (-0.5 * ((X[:, 0] - c) / w).square()).exp() for a, c, w in peaks), 0 * X[:, 0])


def _pendulum(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the angle by time, of a swing of either sign and phase."""
    return p.swing * (3 * X[:, 0] + p.phase).sin()


def _square(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the blur of a lens that is out of focus either way, by aperture."""
    return (p.focus - 1).square() * X[:, 0] + p.rest


def _alias(X: Tensor, p: ParameterValues) -> Tensor:
    """Return an oscillation that is observed too seldom."""
    return p.size * (p.rate * X[:, 0]).cos()


_PEAKS = {
    **{f"a{i}": Unknown(1.0, factor=1.5) for i in (1, 2, 3)},
    **{f"c{i}": Unknown(i / 4, sd=0.04) for i in (1, 2, 3)},
    **{f"w{i}": Unknown(0.1, factor=1.3) for i in (1, 2, 3)},
}


def _box(low: float, high: float) -> tuple[tuple[float], tuple[float]]:
    return (low,), (high,)


_ENZYME = {
    "V": Unknown(3.0, factor=1.6),
    "K": Unknown(2.0, factor=1.6),
    "Ki": Unknown(1.0, factor=2.0),
}
_BEAM = {"EI": Unknown(10.0, factor=1.5), "kr": Unknown(30.0, factor=1.5)}
_ARRHENIUS = {"logA": Unknown(22.0, sd=2.0), "E": Unknown(63.0, sd=6.0)}
_DASHPOT = {"E": Unknown(2.0, factor=1.8), "eta": Unknown(2.0, factor=1.6)}
_SWING = {"swing": Unknown(0.3, sd=1.0), "phase": Unknown(0.2, bounds=(-math.pi, math.pi))}
_LENS = {"focus": Unknown(1.3, sd=1.0), "rest": Unknown(0.0, sd=1.0)}
_SIZE = Unknown(1.0, sd=0.3)
_RADAR = {"size": _SIZE, "rate": Unknown(20.0, sd=12.0)}
_OSCILLATOR = {"size": _SIZE, "rate": Unknown(6.0, sd=4.0)}
PROBLEMS = {
    "beam": Problem(_beam, _BEAM, ((0.2, 0.8), (1.0, 1.0)), 14, 0.01),
    "reaction": Problem(_reaction, _ARRHENIUS, _box(325.0, 345.0), 12, 0.01),
    "creep": Problem(_creep, _DASHPOT, _box(0.05, 1.0), 13, 0.01),
    "inhibitor": Problem(_inhibited, _ENZYME, ((0.1, 0.0), (1.5, 1.0)), 14, 0.02),
    "spectrum": Problem(_spectrum, _PEAKS, _box(0.0, 1.0), 40, 0.05),
    "pendulum": Problem(_pendulum, _SWING, _box(0.0, 2.0), 12, 0.1),
    "focus": Problem(_square, _LENS, _box(0.0, 2.0), 12, 0.1),
    "radar": Problem(_alias, _RADAR, _box(0.0, 3.0), 12, 0.4),
    "alias": Problem(_alias, _OSCILLATOR, _box(0.0, 3.0), 12, 0.2),
}


def textbook_case(problem: str, seed: int) -> Case:
    """Draw the case of a textbook problem and a seed."""
    draw = np.random.default_rng(seed)
    law, unknowns, X, system, noise, true = _TEXTBOOK[problem](draw)
    generator = torch.Generator().manual_seed(1000 + seed)
    white = torch.randn(system.shape, generator=generator, dtype=torch.float64)
    physics = FunctionPhysics(law, unknowns=unknowns, name="law")
    return Case(X, system, system + noise * white, physics, true, noise)


_Drawn = tuple[Law, dict[str, Unknown], Tensor, Tensor, float, dict[str, float]]


def _right(draw: np.random.Generator) -> _Drawn:
    size, rate = draw.normal(5, 1), math.exp(draw.normal(0, 0.3))
    unknowns = {"size": Unknown(5.0, sd=1.0), "rate": Unknown(1.0, factor=math.exp(0.3))}
    X, true = _grid(0.1, 3, 15), {"size": size, "rate": rate}

    def grown(X: Tensor, p: ParameterValues) -> Tensor:
        return p.size * (1 - (-p.rate * X[:, 0]).exp())

    return grown, unknowns, X, size * (1 - (-rate * X).exp()), 0.1, true


def _smooth(draw: np.random.Generator) -> _Drawn:
    slope, frequency = draw.uniform(2, 5), draw.uniform(4, 7)
    X, unknowns = _grid(0.02, 1, 17), {"slope": Unknown(3.0, sd=2.0)}
    system = slope * X + X * (frequency * X).sin()
    return lambda X, p: p.slope * X[:, 0], unknowns, X, system, 0.02, {}


def _confounded(draw: np.random.Generator) -> _Drawn:
    rate, rest = draw.uniform(1.2, 2.2), draw.uniform(0.5, 2)
    X, unknowns = _grid(0.1, 3, 20), {"rate": Unknown(1.0, factor=2.0)}
    system = 3.5 * (-rate * X).exp() + rest
    return lambda X, p: 5 * (-p.rate * X[:, 0]).exp(), unknowns, X, system, 0.1, {"rate": rate}


def _ball(draw: np.random.Generator) -> _Drawn:
    height, drag = draw.uniform(40, 60), draw.uniform(0.002, 0.02)  # m, 1/m
    X, true = _grid(0.05, 2, 20), {"gravity": GRAVITY, "height": height}
    fallen = (math.sqrt(GRAVITY * drag) * X).cosh().log() / drag
    gravity, start = Unknown(9.0, sd=2.0, unit="m/s²"), Unknown(50.0, sd=20.0, unit="m")

    def fall(X: Tensor, p: ParameterValues) -> Tensor:
        return p.height - 0.5 * p.gravity * X[:, 0].square()

    return fall, {"gravity": gravity, "height": start}, X, height - fallen, 0.05, true


def _grid(low: float, high: float, n: int) -> Tensor:
    return torch.linspace(low, high, n, dtype=torch.float64).unsqueeze(-1)


_TEXTBOOK = {"right": _right, "smooth": _smooth, "confounded": _confounded, "ball": _ball}
